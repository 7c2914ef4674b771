"""Frames with two independent sample buffers."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from tests.helpers.frames import flat_frame


def with_buffers(a: Tensor, b: Tensor, **channels: Tensor) -> Frame:
    """A wall whose direct irradiance has sample buffers A and B (1, 3, H, W), at 8 samples per pixel."""
    frame = flat_frame(*a.shape[-2:], irradiance=(a + b) / 2)
    buffers = {"direct_halves": torch.stack([a, b], dim=1), "indirect_halves": torch.zeros(1, 2, *a.shape[1:])}
    return replace(frame.with_channels(buffers | channels), spp=torch.full((1, 1, 1, 1), 8.0))


def noisy_buffers(truth: Tensor, deviation: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two independent unbiased estimates, never negative, with noise relative to the truth."""
    shape = 1 / deviation**2
    a, b = torch.from_numpy(np.random.default_rng(seed).gamma(shape, 1 / shape, (2, *truth.shape))).float() * truth
    return a, b
