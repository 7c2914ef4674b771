"""Close-ups show a part of their room, finer."""

import numpy as np
import pytest

from scenes.camera import directions, pixel_centres, project
from scenes.registry import build_scene
from scenes.rooms import MAX_ZOOM, MIN_ZOOM, OFF_CENTRE

FRAMES = 5
SIZE = 64


@pytest.mark.parametrize("number", range(3))
def test_a_closeup_is_a_part_of_its_room_s_picture(number):
    whole = build_scene(f"room-{number}", 0, FRAMES)
    part = build_scene(f"closeup-{number}", 0, FRAMES)
    assert [shape.name for shape in whole.shapes] == [shape.name for shape in part.shapes]
    times = []
    for frame in range(FRAMES):
        a, b = (scene.view(frame, SIZE, SIZE) for scene in (whole, part))
        assert np.array_equal(a.camera_to_world[:3, 3], b.camera_to_world[:3, 3])
        assert np.array_equal(a.object_to_world, b.object_to_world)
        towards = directions(pixel_centres(SIZE, SIZE), b)
        seen = project(towards, np.zeros((SIZE, SIZE), bool), a)
        # Its middle is at the same place of the room's picture all the time, which a lens that is aimed aside distorts.
        middle = seen[SIZE // 2 - 1 : SIZE // 2 + 1, SIZE // 2 - 1 : SIZE // 2 + 1].mean(axis=(0, 1)) / (SIZE / 2) - 1
        assert np.abs(middle).max() < OFF_CENTRE + 0.05
        times.append((b.K[0, 0] / a.K[0, 0], *middle))
    assert MIN_ZOOM <= times[0][0] <= MAX_ZOOM
    np.testing.assert_allclose(times, np.broadcast_to(times[0], (FRAMES, 3)), atol=0.02)


def test_numbers_draw_different_parts():
    zooms = {
        build_scene(f"closeup-{n}", 0, 2).view(0, 8, 8).K[0, 0] / build_scene(f"room-{n}", 0, 2).view(0, 8, 8).K[0, 0]
        for n in range(2)
    }
    assert len(zooms) == 2
    assert build_scene("closeup-1", 5, 1).view(0, 8, 8).K[0, 0] == build_scene("closeup-1", 6, 1).view(0, 8, 8).K[0, 0]
