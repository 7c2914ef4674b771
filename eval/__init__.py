"""Metrics, the evaluation harness, and pictures."""

import torch  # noqa: F401 - before flip_evaluator, which then takes PyTorch's threads instead of a pool of its own
