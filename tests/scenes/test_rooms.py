"""Rooms are deterministic, full and free of collisions; flights cross free space; frames are no night and no glare."""

from functools import cache

import numpy as np
import pytest
import trimesh

from datasets.tonemap import clip_exposure, display, luminance
from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Scene, Shape
from scenes.camera import directions, pixel_centres, project
from scenes.registry import build_scene
from scenes.rooms import MAX_ZOOM, MIN_ZOOM, OFF_CENTRE
from tests.helpers.rendering import posed_surfaces
from tests.helpers.scenes import FRAMES

FEW = range(6)
MANY = range(1000, 1100)
CLOSEUP_FRAMES = 5
CLOSEUP_SIZE = 64


@cache
def build_room(number: int) -> Scene:
    return build_scene(f"room-{number}", 0, FRAMES)


def owner(name: str) -> str:
    """What a shape belongs to: its thing's number, or itself."""
    head = name.split("-")[0]
    return head if head.isdigit() else name


def things(scene: Scene) -> dict[str, list[Shape]]:
    """The shapes of every thing, by its number."""
    owned: dict[str, list[Shape]] = {}
    for shape in scene.shapes:
        if owner(shape.name).isdigit():
            owned.setdefault(owner(shape.name), []).append(shape)
    return owned


def lights(scene: Scene) -> list[Shape]:
    return [shape for shape in scene.shapes if shape.radiance is not None]


@pytest.mark.parametrize("number", [0, *(pytest.param(n, marks=pytest.mark.slow) for n in (*FEW[1:], *MANY))])
def test_room(number):
    scene = build_room(number)
    assert 15 <= len(things(scene)) <= 60
    assert 1 <= len(lights(scene)) + (scene.sky is not None) <= 5
    assert len({shape.name for shape in scene.shapes}) == len(scene.shapes)
    for shape in lights(scene):
        radiance = np.stack([shape.radiance.at(frame) for frame in range(FRAMES)])
        assert (radiance > 0).any(axis=1).all() and radiance.max() < 65504

    for frame in (0, FRAMES // 2, FRAMES - 1) if scene.moves() else (0,):
        manager = trimesh.collision.CollisionManager()
        for shape in scene.shapes:
            manager.add_object(shape.name, shape.mesh, shape.motion.matrix(frame))
        _, pairs = manager.in_collision_internal(return_names=True)
        # Building parts join each other, and lamps sit in their fixtures.
        loose = {pair for pair in pairs if any(owner(name).isdigit() for name in pair)}
        assert not {pair for pair in loose if owner(pair[0]) != owner(pair[1]) and "lamp" not in "".join(pair)}
        eye = trimesh.creation.icosphere(1, 0.01)
        matrix = np.eye(4)
        matrix[:3, 3] = scene.camera.eye.at(frame)
        assert manager.min_distance_single(eye, matrix) > 0.1

    eyes = np.stack([scene.camera.eye.at(frame) for frame in np.linspace(0, FRAMES - 1, 8 * FRAMES)])
    walls = np.stack([shape.mesh.bounds for shape in scene.shapes if shape.name.startswith(("wall", "floor"))])
    assert (eyes > walls[:, 0].min(axis=0) + 0.1).all()
    assert (eyes[:, [0, 2]] < walls[:, 1].max(axis=0)[[0, 2]] - 0.1).all()


def test_same_number_same_room_whatever_the_seed():
    a = build_room(3)
    b = build_scene("room-3", 77, FRAMES)
    for x, y in zip(a.shapes, b.shapes, strict=True):
        assert x.name == y.name and np.array_equal(x.mesh.vertices, y.mesh.vertices)
        assert np.array_equal(x.motion.matrix(5), y.motion.matrix(5))
    assert np.array_equal(a.view(7, 9, 9).camera_to_world, b.view(7, 9, 9).camera_to_world)
    assert build_scene("room--3", 0, FRAMES).shapes[0].mesh.bounds.tolist() != a.shapes[0].mesh.bounds.tolist()


def test_rooms_differ():
    assert len({tuple(build_room(number).shapes[0].mesh.bounds.ravel()) for number in FEW}) == len(FEW)
    kinds = {shape.bsdf["type"] for number in FEW for shape in build_room(number).shapes}
    assert {"diffuse", "twosided", "roughplastic", "principled", "roughconductor"} <= kinds


@pytest.mark.slow
def test_half_of_the_rooms_move():
    """Also in some lights change, the camera stops, the sky is visible or glass is."""
    rooms = [build_room(number) for number in MANY]
    facts = {
        "two things move": [sum(parts[0].motion.varies() for parts in things(s).values()) >= 2 for s in rooms],
        "lights change": [any(light.radiance.varies() or light.motion.varies() for light in lights(s)) for s in rooms],
        "camera stops": [s.camera.eye.last < FRAMES - 1 for s in rooms],
        "sky": [s.sky is not None for s in rooms],
        "glass": [any("dielectric" in shape.bsdf["type"] for shape in s.shapes) for s in rooms],
    }
    shares = {name: np.mean(values) for name, values in facts.items()}
    assert 0.4 <= shares["two things move"] <= 0.65
    assert all(shares[name] >= 0.03 for name in shares)
    assert all(shares[name] <= 0.5 for name in ("lights change", "camera stops", "sky"))


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 3, 5])
def test_frames_are_neither_night_nor_glare(number):
    size = 48
    stage = Stage(build_room(number), size, size)
    tracer = PathTracer(stage)
    images, emissions = [], []
    for frame in (0, FRAMES - 1):
        stage.pose(frame)
        view = stage.view(frame)
        images.append(np.add(*tracer.radiance(stage.rays(view), frame, 64)))
        emissions.append(render_gbuffer(stage, view)["emission"])
    exposure = clip_exposure(luminance(np.stack(images)))
    for image, emission in zip(images, emissions, strict=True):
        shown = display((image + emission).astype(np.float64), exposure)
        assert 0.08 < shown.mean() < 0.9
        assert (shown.min(axis=-1) >= 1).mean() < 0.3 and (shown.max(axis=-1) < 0.02).mean() < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("number", FEW[:4])
def test_nothing_moves_faster_than_twenty_pixels_of_256(number):
    """Motion of visible surfaces, with a margin for those nearer than the centres of things, which were aimed at."""
    size = 64
    stage = Stage(build_room(number), size, size)
    for frame in (1, FRAMES // 2, FRAMES - 1):
        *_, motion = posed_surfaces(stage, frame)
        assert np.percentile(np.abs(motion).max(axis=-1), 95) < 1.5 * 20 / 256 * size


@pytest.mark.parametrize("number", [0, *(pytest.param(number, marks=pytest.mark.slow) for number in (1, 2))])
def test_a_closeup_is_a_part_of_its_room_s_picture(number):
    whole = build_scene(f"room-{number}", 0, CLOSEUP_FRAMES)
    part = build_scene(f"closeup-{number}", 0, CLOSEUP_FRAMES)
    assert [shape.name for shape in whole.shapes] == [shape.name for shape in part.shapes]
    times = []
    for frame in range(CLOSEUP_FRAMES):
        a, b = (scene.view(frame, CLOSEUP_SIZE, CLOSEUP_SIZE) for scene in (whole, part))
        assert np.array_equal(a.camera_to_world[:3, 3], b.camera_to_world[:3, 3])
        assert np.array_equal(a.object_to_world, b.object_to_world)
        towards = directions(pixel_centres(CLOSEUP_SIZE, CLOSEUP_SIZE), b)
        visible = project(towards, np.zeros((CLOSEUP_SIZE, CLOSEUP_SIZE), bool), a)
        # Its middle stays at one position of the room's image, but for the distortion of an off-centre lens.
        half = CLOSEUP_SIZE // 2
        middle = visible[half - 1 : half + 1, half - 1 : half + 1].mean(axis=(0, 1)) / half - 1
        assert np.abs(middle).max() < OFF_CENTRE + 0.05
        times.append((b.K[0, 0] / a.K[0, 0], *middle))
    assert MIN_ZOOM <= times[0][0] <= MAX_ZOOM
    np.testing.assert_allclose(times, np.broadcast_to(times[0], (CLOSEUP_FRAMES, 3)), atol=0.02)


@pytest.mark.slow
def test_numbers_draw_different_parts():
    zooms = {
        build_scene(f"closeup-{n}", 0, 2).view(0, 8, 8).K[0, 0] / build_scene(f"room-{n}", 0, 2).view(0, 8, 8).K[0, 0]
        for n in range(2)
    }
    assert len(zooms) == 2
    assert build_scene("closeup-1", 5, 1).view(0, 8, 8).K[0, 0] == build_scene("closeup-1", 6, 1).view(0, 8, 8).K[0, 0]
