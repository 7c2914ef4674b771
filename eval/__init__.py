"""Metrics, the evaluation harness, and pictures."""
