"""Frames with two independent sample buffers."""

from dataclasses import replace

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from datasets.frame import Frame
from tests.helpers.frames import flat_frame


def with_buffers(a: Tensor, b: Tensor, **channels: Tensor) -> Frame:
    """A wall whose direct irradiance has sample buffers A and B (1, 3, H, W), at 8 samples per pixel."""
    frame = flat_frame(*a.shape[-2:], irradiance=(a + b) / 2)
    buffers = {"direct_buffers": torch.stack([a, b], dim=1), "indirect_buffers": torch.zeros(1, 2, *a.shape[1:])}
    return replace(frame.with_channels(buffers | channels), spp=torch.full((1, 1, 1, 1), 8.0))


@st.composite
def any_images(draw: st.DrawFn, count: int, levels: list[float]) -> list[Tensor]:
    """Mesh ids (1, 1, H, W) of a small size and `count` images (1, 3, H, W) of light, each up to one of the levels."""
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))
    size = (draw(st.integers(1, 12)), draw(st.integers(1, 12)))
    highest = [draw(st.sampled_from(levels)) for _ in range(count)]
    mesh_id = torch.randint(0, 3, (1, 1, *size), generator=generator).float()
    return [mesh_id, *(level * torch.rand(1, 3, *size, generator=generator) for level in highest)]


def noisy_buffers(truth: Tensor, deviation: float, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Two independent unbiased estimates, never negative, with noise relative to the truth."""
    shape = 1 / deviation**2
    a, b = torch.from_numpy(np.random.default_rng(seed).gamma(shape, 1 / shape, (2, *truth.shape))).float() * truth
    return a, b
