"""Hit distances of noisy samples: plates in front of a wall in closed form, by the same samples as the noise."""

import numpy as np
import pytest
from scipy.stats import kstest

from render.first_bounce import hit_channels
from render.path import PathTracer, SampleRange
from render.stage import Stage
from scenes.registry import build_scene
from tests.helpers.plates import DISTANCE, TO_THE_EYE, TO_THE_WALL, frames_of, plate

HEIGHT = 2.0  # of the lamp over the wall
SIDE = 0.8  # of the lamp
WALL = plate("a wall", 20, (0, 0, 0), faces=TO_THE_EYE)
LAMP = plate("c lamp", SIDE, (2.5, 0, HEIGHT), radiance=50, faces=TO_THE_WALL)


def of_frame(frame, realisation=0):
    """Of the wall: distances to what paths hit, to blockers and to the lamp, the lamp's angle, direct light; (N,)."""
    channels = [frame[name][realisation] for name in ("hit_distance", "light_distance", "light_angle", "direct")]
    return np.moveaxis(np.concatenate(channels, axis=-1)[frame["mesh_id"][..., 0] == 1], -1, 0)[:5]


@pytest.mark.parametrize("blocker_height", [0.5, 1.5])
def test_blockers_follow_similar_triangles(blocker_height):
    """Along every shadow ray, as high in proportion as over the wall; and light comes by the same rays."""
    (frame,) = frames_of(WALL, plate("b blocker", 1.2, (1.6, 0, blocker_height)), LAMP, frames=1)
    _, blocked, light, _, direct = of_frame(frame)
    shaded = blocked > 0
    assert 20 < shaded.sum() < 0.5 * shaded.size
    np.testing.assert_allclose(blocked[shaded] / light[shaded], blocker_height / HEIGHT, rtol=1e-3)
    assert (direct[(light > 0) & ~shaded] > 0).all()
    assert (direct[shaded] > 0).mean() < 0.15  # by rays of the BSDF that find the lamp alone


def test_lamps_are_as_far_and_as_large_as_they_look():
    (frame,) = frames_of(WALL, LAMP, frames=1)
    hit, blocked, light, angle, _ = of_frame(frame)
    assert not blocked.any() and light.min() >= HEIGHT
    solid_angle = SIDE**2 * (HEIGHT / light) / light**2
    np.testing.assert_allclose(angle, np.sqrt(solid_angle / 12), rtol=1e-4)
    assert (hit == 0).mean() > 0.8 and hit.max() > HEIGHT  # but for the lamp there is nothing


def test_paths_hit_a_ceiling_as_cosine_weighted_directions_do():
    """The cosine's square, (height / distance)², is even over [0, 1]."""
    height = DISTANCE + 1
    (frame,) = frames_of(WALL, plate("b ceiling", 4000, (0, 0, height)), frames=1)
    hit, *_ = of_frame(frame)
    assert hit.min() > 0
    assert kstest((height / hit) ** 2, "uniform").pvalue > 1e-3


@pytest.mark.slow
def test_the_sky_is_infinitely_far_away_and_wide():
    (frame,) = frames_of(WALL, sky=np.ones((4, 8, 3)), frames=1)
    hit, blocked, light, angle, _ = of_frame(frame)
    assert not hit.any() and not blocked.any() and not light.any()
    lit = angle > 0
    assert 0.3 < lit.mean() < 0.7  # by that half of the sky which the wall faces
    np.testing.assert_allclose(12 * np.median(angle[lit]) ** 2, 4 * np.pi, rtol=0.3)


def test_means_count_the_samples_that_met_something():
    stage = Stage(build_scene("cornell_box", 3, 24), 16, 16)
    tracer = PathTracer(stage)
    first, second = (hit_channels(tracer, stage.view(0), [SampleRange(7, 1, first)]) for first in (0, 1))
    for name, means in hit_channels(tracer, stage.view(0), [SampleRange(7, 2)]).items():
        pair = np.stack([first[name], second[name]])
        np.testing.assert_allclose(means, np.ma.masked_equal(pair, 0).mean(axis=0).filled(0), rtol=1e-6)


def test_distances_are_in_world_units():
    """Of scenes that the stage shrinks for Mitsuba, too."""
    large = 1e4
    lamp = plate("c lamp", SIDE * large, (0, 0, HEIGHT * large), radiance=1, faces=TO_THE_WALL)
    (frame,) = frames_of(plate("a wall", 20 * large, (0, 0, 0), faces=TO_THE_EYE), lamp, frames=1)
    light = of_frame(frame)[2]
    assert HEIGHT * large * (1 - 1e-3) < light.min() < light.max() < 1.1 * HEIGHT * large
