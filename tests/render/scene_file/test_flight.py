"""Flights through free space, checked against boxes in closed form."""

from dataclasses import replace

import numpy as np
import pytest

from render.scene_file.flight import Space, fly, start_at, upright
from render.stage import Stage
from scenes.animation import Camera, Scene, StockLight, StockShape, Track
from scenes.camera import Y_UP, look_at

FRAMES = 12
SEEDS = range(8)
GREY = {"type": "diffuse"}
SKY = StockLight("day", {"type": "constant"})
CAMERA = Camera(Track.constant([0.0, 0.5, 3.0]), Track.constant([0.0, 0.5, 2.0]), Track.constant(50.0))
BOXES = [((0.0, 0, 0), (0.5, 0.5, 0.5)), ((1.2, 0, 1.0), (0.3, 1.0, 0.3)), ((-1.5, 0.5, -1.0), (0.4, 0.4, 0.4))]
ROOM = ((0.0, 0, 0), (4.0, 2.0, 4.0))


def cube(name: str, centre, half, turn=None, scale: float = 1.0) -> StockShape:
    matrix = np.diag([*half, 1.0])
    matrix[:3, 3] = centre
    matrix = (np.eye(4) if turn is None else turn) @ np.diag([scale] * 3 + [1.0]) @ matrix
    return StockShape(name, {"type": "cube", "to_world": matrix}, {"type": "twosided", "bsdf": GREY})


def scene(boxes, camera=CAMERA, turn=None, scale: float = 1.0) -> Scene:
    shapes = [cube(f"box {index}", *box, turn, scale) for index, box in enumerate(boxes)]
    return Scene((), camera, stock=tuple(shapes), lights=(SKY,))


def moved(camera: Camera, turn=None, scale: float = 1.0) -> Camera:
    turn = np.eye(3) if turn is None else turn[:3, :3]

    def placed(track: Track, factor: float) -> Track:
        return replace(track, keys=track.keys @ turn.T * factor)

    return replace(camera, eye=placed(camera.eye, scale), target=placed(camera.target, scale), up=placed(camera.up, 1))


def stage_of(made: Scene) -> Stage:
    return Stage(made, 12, 16)


def distance_to_box(points: np.ndarray, centre, half) -> np.ndarray:
    """From points (N, 3) to the surface of a box, from outside or from inside."""
    q = np.abs(points - np.array(centre)) - np.array(half)
    return np.where((q < 0).all(axis=1), -q.max(axis=1), np.linalg.norm(np.maximum(q, 0), axis=1))


def fine(camera: Camera) -> np.ndarray:
    return np.array([camera.eye.at(frame) for frame in np.linspace(0, FRAMES - 1, 400)])


@pytest.fixture(scope="module")
def stages():
    return {"outdoors": stage_of(scene(BOXES)), "in a room": stage_of(scene([ROOM, *BOXES]))}


@pytest.mark.parametrize("place", ["outdoors", "in a room"])
def test_flights_keep_their_distance_and_are_smooth(stages, place):
    boxes = BOXES if place == "outdoors" else [ROOM, *BOXES]
    clearance = start_at(Space(stages[place]), CAMERA).clearance
    assert clearance > 0.05
    moves = 0
    for seed in SEEDS:
        camera = fly(stages[place], CAMERA, FRAMES, seed, from_here=seed % 2 == 0)
        points = fine(camera)
        for box in boxes:
            assert distance_to_box(points, *box).min() > 0.9 * clearance  # rays feel for corners between them
            inside = (np.abs(points - np.array(box[0])) < box[1]).all(axis=1)
            assert inside.all() or not inside.any()
            assert inside.all() == (box == ROOM)
        eyes = np.array([camera.eye.at(frame) for frame in range(FRAMES)])
        directions = np.array([camera.target.at(frame) for frame in range(FRAMES)]) - eyes
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        steps = np.linalg.norm(np.diff(eyes, axis=0), axis=1)
        moves += steps.max() > 0.01
        assert steps.max() < 0.2
        assert np.linalg.norm(np.diff(eyes, 2, axis=0), axis=1).max() <= 0.5 * steps.max()
        assert np.linalg.norm(np.diff(directions, 2, axis=0), axis=1).max() < 0.01
    assert moves > len(SEEDS) / 2


def test_flights_begin_with_the_files_view_and_depend_on_the_seed_alone(stages):
    stage, other = stages["outdoors"], stage_of(scene(BOXES))
    views = []
    for seed in SEEDS:
        camera = fly(stage, CAMERA, FRAMES, seed, from_here=True)
        now, file = (each.view(0, 12, 16) for each in (scene([], camera), scene([], CAMERA)))
        np.testing.assert_allclose(now.camera_to_world, file.camera_to_world, atol=1e-12)
        np.testing.assert_array_equal(now.K, file.K)
        again = fly(other, CAMERA, FRAMES, seed, from_here=True)
        np.testing.assert_array_equal(fine(camera), fine(again))
        np.testing.assert_array_equal(camera.target.keys, again.target.keys)
        views.append(fine(camera)[-1])
    assert len({tuple(view) for view in views}) == len(SEEDS)
    starts = [fly(stage, CAMERA, FRAMES, seed, from_here=False).eye.at(0) for seed in SEEDS]
    assert len({tuple(start) for start in starts}) > len(SEEDS) / 2


TO_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("scale", [1e-2, pytest.param(1e2, marks=pytest.mark.slow)])
def test_units_do_not_matter(stages, scale):
    camera = moved(CAMERA, scale=scale)
    stage = stage_of(scene([ROOM, *BOXES], camera, scale=scale))
    for seed in SEEDS:
        plain = fly(stages["in a room"], CAMERA, FRAMES, seed, from_here=False)
        other = fly(stage, camera, FRAMES, seed, from_here=False)
        np.testing.assert_allclose(fine(other) / scale, fine(plain), atol=1e-4)
        np.testing.assert_allclose(other.target.at(5) / scale, plain.target.at(5), atol=1e-3)


def test_z_may_be_up():
    camera = moved(CAMERA, TO_Z_UP)
    stage = stage_of(scene([ROOM, *BOXES], camera, TO_Z_UP))
    for seed in SEEDS:
        flown = fly(stage, camera, FRAMES, seed, from_here=False)
        np.testing.assert_array_equal(flown.up.at(0), [0, 0, 1])
        points = fine(flown) @ TO_Z_UP[:3, :3]  # its inverse is its transpose
        assert all(distance_to_box(points, *box).min() > 0.02 for box in [ROOM, *BOXES])
        directions = flown.target.at(0) - flown.eye.at(0)
        assert abs(directions[2]) < 0.9 * np.linalg.norm(directions)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.0), (0.0, 0.5, 0.5), (1e3, 1e3, 1e3)])
def test_odd_places_are_survived(eye):
    """Inside a box, on its edge and far away from all."""
    camera = replace(CAMERA, eye=Track.constant(eye), target=Track.constant(np.add(eye, [0.0, 0.1, -1.0])))
    stage = stage_of(scene(BOXES, camera))
    for from_here in (True, False):
        flown = fly(stage, camera, FRAMES, 3, from_here)
        assert np.isfinite(fine(flown)).all()
        assert all(np.isfinite(scene([], flown).view(frame, 4, 4).camera_to_world).all() for frame in range(FRAMES))
    if not np.any(eye):
        assert (np.abs(fine(fly(stage, camera, FRAMES, 3, True))) < 0.5).all()


@pytest.mark.parametrize("is_said", [True, False])
@pytest.mark.parametrize("forward", [[0, -3, -2], [-1, 3, -1.5], [-2, -3, 0], [0, -3, 2]])
def test_the_worlds_up_is_that_of_steep_cameras(forward, is_said):
    """By the file, or else by the axes of its image, but for the last: z upwards fits that, too."""
    eye, forward = np.zeros(3), np.array(forward, np.float64)
    camera = Camera.at_rest(eye, forward, 50.0, Y_UP if is_said else look_at(eye, forward)[:3, 1])
    expected = Y_UP if is_said or forward[2] < 2 else [0, 0, 1]
    np.testing.assert_array_equal(upright(camera).up.at(0), expected)


def test_a_rolled_camera_stays_rolled():
    rolled = replace(CAMERA, up=Track.constant([0.5, 1.0, 0.0]))
    assert upright(rolled) is rolled
    tilted = replace(CAMERA, target=Track.constant([0.0, -1.0, 2.0]), up=Track.constant([0.0, 0.55, -0.83]))
    plain, other = (scene([], each).view(0, 4, 4).camera_to_world for each in (tilted, upright(tilted)))
    np.testing.assert_allclose(plain, other, atol=1e-12)
