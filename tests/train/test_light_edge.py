"""Wandering edges of light: between 1 and the factor, in the middle when they pass it, and only ahead of nothing."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from train.augmentation import LightEdge


@given(st.integers(0, 2**32 - 1), st.integers(0, 11))
def test_light_lies_between_one_and_the_factor(seed, frame):
    edge = LightEdge.random(np.random.default_rng(seed), 12)
    light = edge.light(frame, 20, 30)
    assert light.shape == (20, 30) and light.dtype == torch.float32
    assert (light >= min(1, edge.factor) - 1e-6).all() and (light <= max(1, edge.factor) + 1e-6).all()


def test_an_edge_arrives_passes_the_middle_and_is_gone():
    edge = LightEdge(factor=0.25, angle=np.pi / 2, speed=4.0, passes=5.0, softness=0.1)
    before, middle, after = (edge.light(frame, 21, 9) for frame in (0, 5, 10))
    assert torch.allclose(before, torch.ones(21, 9), atol=1e-6)
    assert torch.allclose(after, torch.full((21, 9), 0.25), atol=1e-6)
    assert (
        torch.allclose(middle[10], torch.full((9,), 0.625)) and (middle[:10] < 0.3).all() and (middle[11:] > 0.9).all()
    )


def test_it_moves_along_its_angle():
    edge = LightEdge(factor=3.0, angle=0.0, speed=2.0, passes=2.0, softness=0.2)
    first, second = (edge.light(frame, 5, 41) for frame in (2, 3))
    assert torch.allclose(first[:, :-2], second[:, 2:], atol=1e-5)
