"""Boxes enclose what they should, and rays meet them where they begin."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenes.boxes import bounding_box, first_hit, overlaps, transformed_box
from scenes.layout import pose
from tests.helpers.scenes import SEEDS


def random_boxes(rng: np.random.Generator, count: int) -> np.ndarray:
    """Boxes (count, 2, 3) about points of -3..3, none thinner than 0.2."""
    middle = rng.uniform(-3, 3, (count, 3))
    half = rng.uniform(0.1, 1.0, (count, 3))
    return np.stack([middle - half, middle + half], axis=1)


@given(seed=SEEDS)
def test_transformed_box_is_the_smallest_around_a_turned_one(seed):
    rng = np.random.default_rng(seed)
    (box,) = random_boxes(rng, 1)
    matrix = pose(*rng.uniform(-2, 2, 3), rng.uniform(-np.pi, np.pi))
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2], 1] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    moved = (corners @ matrix.T)[:, :3]
    np.testing.assert_allclose(transformed_box(box, matrix), [moved.min(axis=0), moved.max(axis=0)], atol=1e-12)


@given(seed=SEEDS)
def test_bounding_box_holds_all_and_overlaps_each(seed):
    boxes = random_boxes(np.random.default_rng(seed), 5)
    around = bounding_box(boxes)
    assert (around[0] <= boxes[:, 0]).all() and (around[1] >= boxes[:, 1]).all()
    assert all(overlaps(box, around[None]) for box in boxes)
    assert not overlaps(around + 1.01 * (around[1] - around[0]), boxes)


@given(seed=SEEDS, clearance=st.floats(0, 0.5))
def test_clearance_is_kept_outside_of_grown_boxes(seed, clearance):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 3)
    point = rng.uniform(-4, 4, 3)
    inside = ((point > boxes[:, 0] - clearance) & (point < boxes[:, 1] + clearance)).all(axis=1)
    around = np.stack([point - clearance, point + clearance])
    assert overlaps(around, boxes) == overlaps(np.stack([around, boxes[0] + 99]), boxes) == inside.any()


@given(seed=SEEDS)
def test_first_hit_is_where_a_ray_enters(seed):
    rng = np.random.default_rng(seed)
    boxes = random_boxes(rng, 4)
    origin = np.array([9.0, 0, 0])
    targets = rng.uniform(-3, 3, (20, 3))
    shares = first_hit(origin, targets, boxes)
    steps = np.linspace(0, 3, 3001)
    for target, share in zip(targets, shares, strict=True):
        points = origin + steps[:, None] * (target - origin)
        inside = ((points[:, None] > boxes[:, 0]) & (points[:, None] < boxes[:, 1])).all(axis=2).any(axis=1)
        assert share <= steps[inside].min(initial=np.inf) + 1e-9  # no later than the first step inside
        if np.isfinite(share):
            entry = origin + share * (target - origin)
            outside = np.maximum(boxes[:, 0] - entry, entry - boxes[:, 1]).max(axis=1)
            assert outside.min() == pytest.approx(0, abs=1e-9)  # on a box, and in none
    assert (first_hit(origin, targets, np.empty((0, 2, 3))) == np.inf).all()
