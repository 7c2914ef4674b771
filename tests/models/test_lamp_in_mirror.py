"""A lamp in a mirror: its light is emission, so that no denoiser spreads it."""

import numpy as np
import pytest

from datasets.channels import CHANNELS, USUAL_CHANNELS
from datasets.clip import Clip
from datasets.frame import Frame, read_frame
from eval.stress.check import ROUNDING, range_violation
from models.registry import DENOISERS, channels_read
from render.clip import Sampling, write_clip
from scenes.animation import Scene, Shape, Track
from tests.helpers.denoisers import each
from tests.helpers.frames import prepared, run
from tests.helpers.mirrors import CAMERA, FRAMES, SILVER, SIZE, panel, placed, room

RADIANCE = 60.0


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> list[Frame]:
    """A mirror that shows a black lamp and the dim wall behind it."""
    picture, box, wall = room(SILVER).shapes
    mesh = placed(panel(1, 1), [-2.5, -1, 4])
    mesh.invert()
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0, 0, 0]}}
    lamp = Shape("lamp", mesh, black, radiance=Track.constant([RADIANCE] * 3))
    path = tmp_path_factory.mktemp("data") / "test" / "room" / "000"
    channels = tuple(name for name in CHANNELS if name in {*channels_read(), *USUAL_CHANNELS})
    write_clip(path, Scene((picture, box, wall, lamp), CAMERA), (FRAMES, *SIZE), Sampling(1, 1, 2), 0, channels)
    return [read_frame(Clip(path), index, channels) for index in range(FRAMES)]


def test_its_light_is_emission(frames):
    for frame in frames:
        shows_lamp = frame.mesh_id == 4 + 4  # of four meshes the last one, in a mirror
        assert shows_lamp.any()
        np.testing.assert_allclose(frame.emission[shows_lamp.expand_as(frame.emission)], RADIANCE, rtol=1e-3)


@pytest.mark.parametrize("name", each(DENOISERS))
def test_no_denoiser_spreads_it(frames, name):
    denoiser = prepared(name)
    given = frames[:1] if denoiser.offline else frames
    outputs = run(denoiser, given)
    brightest = max(float(frame.irradiance("total").max()) for frame in frames)
    assert brightest < 2 * RADIANCE
    if denoiser.convex:
        assert range_violation(denoiser, given, outputs) <= ROUNDING
    for frame, output in zip(given, outputs, strict=True):
        if denoiser.filters_emission:
            assert output.max() < 2 * RADIANCE
        else:
            assert (output - frame.emission).max() < 2 * brightest
