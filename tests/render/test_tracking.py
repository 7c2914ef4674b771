"""Motion of shadows and reflections in scenes where similar triangles tell it, and that it costs no other channel."""

import numpy as np
import pytest

from tests.helpers.mirrors import SILVER
from tests.helpers.plates import DISTANCE, FOCAL, frames_of, plate

STEP = 0.1
WALL = plate("a wall", 20, (0, 0, 0))
MIRROR = plate("a mirror", 20, (0, 0, 0), SILVER)


def tracked(frame, name, mesh):
    """Vectors (N, 2) of a channel that differ from motion, on the mesh of that number."""
    differs = np.abs(frame[name] - frame["motion"]).max(axis=-1) > 1e-3
    return frame[name][differs & (frame["mesh_id"][..., 0] == mesh)]


@pytest.mark.parametrize(
    "eye_slides, lamp_slides",
    [(0.0, 0.0), (0.05, STEP), *(pytest.param(*each, marks=pytest.mark.slow) for each in ((0.0, STEP), (0.05, 0.0)))],
)
def test_a_shadow_follows_similar_triangles(lamp_slides, eye_slides):
    """The lamp is twice as far from the wall as the blocker; both may slide, and the eye."""
    blocker = plate("b blocker", 0.6, (1.5, 0, 1), slides=STEP)
    lamp = plate("c lamp", 0.05, (3, 0, 2), radiance=100, slides=lamp_slides)
    for frame in frames_of(WALL, blocker, lamp, eye_slides=eye_slides)[1:]:
        shadow = tracked(frame, "shadow_motion", 1)
        assert len(shadow) > 20
        back = -(2 * STEP - lamp_slides)  # of the shadow, to where it was
        expected = [(back + eye_slides) * FOCAL / DISTANCE, 0]
        np.testing.assert_allclose(shadow, np.broadcast_to(expected, shadow.shape), atol=2e-3)


def test_a_shadow_stays_on_its_surface_while_the_camera_alone_moves():
    for frame in frames_of(WALL, plate("b", 0.6, (1.5, 0, 1)), plate("c", 0.05, (3, 0, 2), radiance=1), eye_slides=0.1):
        assert np.array_equal(frame["shadow_motion"], frame["motion"])


@pytest.mark.parametrize("eye_slides", [0.0, 0.05])
def test_a_reflection_moves_as_what_stands_behind_the_mirror(eye_slides):
    """The image of what is 1 in front of the mirror stands 1 behind it."""
    thing = plate("b thing", 1.0, (1.5, 0, 1), slides=STEP)
    for frame in frames_of(MIRROR, thing, plate("c lamp", 0.5, (0, 3, 6), radiance=1), eye_slides=eye_slides)[1:]:
        visible = tracked(frame, "reflection_motion", 1)
        back = (eye_slides - STEP) * FOCAL / (DISTANCE + 1)
        of_thing = visible[np.abs(visible[:, 0] - back) < 5e-3]
        assert len(of_thing) > 10 and np.abs(of_thing[:, 1]).max() < 5e-3


@pytest.mark.slow
def test_the_sky_s_reflection_moves_with_the_view_alone():
    for frame in frames_of(MIRROR, eye_slides=0.2, sky=np.ones((2, 4, 3)))[1:]:
        assert np.abs(frame["reflection_motion"]).max() < 1e-3 and np.abs(frame["motion"][..., 0]).min() > 1


def test_diffuse_surfaces_reflect_nothing_in_particular():
    for frame in frames_of(WALL, plate("b", 0.5, (2, 0, 2), radiance=1), eye_slides=0.1):
        assert np.array_equal(frame["reflection_motion"], frame["motion"])
