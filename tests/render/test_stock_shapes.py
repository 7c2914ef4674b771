"""Shapes, maps and lights as scene files describe them: what is visible of them, and how they move and change."""

from dataclasses import replace

import numpy as np
import pytest

from errors import BadInput
from render.backend import dr, mi
from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Camera, FreeMotion, KeyframedTrack, Scene, StockLight, StockShape, Track
from scenes.camera import move, pixel_centres, unproject
from tests.helpers.rendering import assert_same_mean, first_gbuffer, posed_surfaces, rgb, stock_images

SIZE = 24
WHITE = {"type": "diffuse", "reflectance": rgb(0.8, 0.8, 0.8)}
SKY = StockLight("sky", {"type": "constant", "radiance": rgb(1, 1, 1)})
CAMERA = Camera(Track.constant([0.5, 1.0, 6.0]), Track.constant([0.0, 0.0, 0.0]), Track.constant(50.0))


def placed(x: float, y: float = 0.0, z: float = 0.0, scale: float = 1.0) -> np.ndarray:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = [x, y, z]
    return matrix


GROUP = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.5, "bsdf": WHITE}}
KINDS = {
    "sphere": {"type": "sphere", "center": [-2.0, 0.0, 0.0], "radius": 0.6},
    "rectangle": {"type": "rectangle", "to_world": placed(-0.7, 0, 0, 0.5)},
    "disk": {"type": "disk", "to_world": placed(0.6, 0, 0, 0.5)},
    "cylinder": {"type": "cylinder", "to_world": placed(1.6, -0.4, 0, 0.4)},
    "cube": {"type": "cube", "to_world": placed(0.0, -1.4, 0, 0.4)},
    "instance": {"type": "instance", "group": GROUP, "to_world": placed(-1.2, 1.4)},
    "instance-2": {"type": "instance", "group": GROUP, "to_world": placed(1.2, 1.4, 0, 1.2)},
}


def kinds(motion: FreeMotion | None = None) -> Scene:
    shapes = [StockShape(name, described, None if "inst" in name else WHITE) for name, described in KINDS.items()]
    if motion:
        shapes = [replace(shape, motion=motion) for shape in shapes]
    return Scene((), CAMERA, stock=tuple(shapes), lights=(SKY,))


def test_every_kind_of_shape_is_seen_by_its_own_id():
    stage = Stage(kinds(), 64, 64)
    mesh_id = render_gbuffer(stage, stage.view(0))["mesh_id"]
    assert set(np.unique(mesh_id)) == set(range(len(KINDS) + 1))
    for index, name in enumerate(KINDS):
        if name == "cylinder":
            continue  # its ends are open
        box = stage.shapes[index].bbox()
        middle = (np.array(box.min) + np.array(box.max)).ravel() / 2
        view = stage.view(0)
        visible = view.K @ (np.linalg.inv(view.camera_to_world) @ [*middle, 1])[:3]
        column, row = (visible[:2] / visible[2]).astype(int)
        assert mesh_id[row, column, 0] == index + 1, name


def test_moving_shapes_are_where_their_motion_vectors_say():
    """Of shapes of every kind, turned and shifted: a vector leads to the same shape, at the depth that it has there."""
    turn = KeyframedTrack(np.array([[0.0, 0, 0], [0.05, 0.1, -0.08]]), times=np.array([0.0, 1.0]))
    shift = KeyframedTrack(np.array([[0.0, 0, 0], [0.1, -0.05, 0.2]]), times=np.array([0.0, 1.0]))
    stage = Stage(kinds(FreeMotion(np.array([0.2, 0.1, 0.0]), shift, turn)), 96, 96)
    before = render_gbuffer(stage, stage.view(0))
    now, previous, depth, mesh_id, motion = posed_surfaces(stage, 1)
    centres = pixel_centres(96, 96)
    assert np.abs(motion[mesh_id > 0]).max() > 1
    target = np.clip(np.floor(centres + motion).astype(int), 0, 95)
    found = before["mesh_id"][target[..., 1], target[..., 0], 0]
    assert (found == mesh_id)[mesh_id > 0].mean() > 0.93  # else it was hidden, or lies on an edge
    points = move(unproject(centres, depth, now), mesh_id, now, previous)
    expected = (points - previous.camera_to_world[:3, 3]) @ previous.camera_to_world[:3, 2]
    same = (found == mesh_id) & (mesh_id > 0)
    apart = np.abs(before["depth"][target[..., 1], target[..., 0], 0] - expected)[same]
    assert np.median(apart) < 0.01 and np.median(np.abs(expected - depth)[same]) > 0.1


def test_radiance_is_that_of_mitsuba_with_all_kinds_of_lights():
    """Beside our path tracer Mitsuba's own: points, spots, directions, textured emitters and a sky, masks and maps."""
    lights = (
        StockLight("point", {"type": "point", "position": [0.0, 2.0, 2.0], "intensity": rgb(3, 2, 1)}),
        StockLight("spot", {"type": "spot", "to_world": placed(0.5, 0.0, 5.0) @ np.diag([1.0, 1, -1, 1])}),
        StockLight("sun", {"type": "directional", "direction": [0.3, -1.0, -0.4], "irradiance": rgb(1, 1, 2)}),
        StockLight("sky", {"type": "constant", "radiance": rgb(0.2, 0.3, 0.4)}),
    )
    checks = {"type": "checkerboard", "color0": rgb(0.2, 0.2, 0.2), "color1": rgb(0.9, 0.6, 0.3)}
    disk = {"type": "disk", "to_world": placed(0, 0, -1, 3)}
    lamp = StockShape("lamp", disk, WHITE, {"type": "area", "radiance": checks})
    holes = {"type": "mask", "opacity": 0.5, "nested": WHITE}
    veil = StockShape("veil", {"type": "rectangle", "to_world": placed(0, -1, 1.5, 0.7)}, holes)
    stage = Stage(Scene((), CAMERA, 4, stock=(*kinds().stock, lamp, veil), lights=lights), SIZE, SIZE)
    stage.pose(5)
    tracer = PathTracer(stage)
    emission = render_gbuffer(stage, stage.view(5))["emission"]
    ray = stage.rays(stage.view(5))
    ours = [np.add(*tracer.radiance(ray, seed, 32)) + emission for seed in range(24)]
    assert_same_mean(np.array(ours), stock_images(stage, 4, 24, 32))


def test_lights_and_emitters_change_by_their_gain():
    gain = KeyframedTrack(np.array([1.0, 0.25]), times=np.array([0.0, 4.0]))
    lamp = StockShape("lamp", KINDS["disk"], WHITE, {"type": "area", "radiance": rgb(4, 3, 2)}, gain=gain)
    sky = StockLight("sky", {"type": "constant", "radiance": rgb(1, 1, 1)}, gain=gain)
    stage = Stage(Scene((), CAMERA, stock=(lamp,), lights=(sky,)), 16, 16)
    first = render_gbuffer(stage, stage.view(0))["emission"]
    stage.pose(4)
    last = render_gbuffer(stage, stage.view(4))["emission"]
    assert first.max() == 4
    np.testing.assert_allclose(last, first / 4, rtol=1e-6)


def test_what_cannot_move_or_change_is_refused():
    gain = KeyframedTrack(np.array([1.0, 0.5]), times=np.array([0.0, 1.0]))
    checks = {"type": "area", "radiance": {"type": "checkerboard"}}
    with pytest.raises(BadInput, match="'lamp' cannot change"):
        Stage(Scene((), CAMERA, stock=(StockShape("lamp", KINDS["disk"], WHITE, checks, gain=gain),)), 4, 4)


@pytest.mark.parametrize(
    "twosided, behind", [(False, False), *(pytest.param(True, behind, marks=pytest.mark.slow) for behind in (0, 1))]
)
def test_normals_are_those_that_a_mirror_with_the_same_map_has(twosided, behind):
    """Half vectors between where light comes from and where the BSDF itself reflects it to, of normals and of heights.

    Mirrors have a back only if they are two-sided.
    """
    rng = np.random.default_rng(3)
    tilts = rng.uniform(-0.3, 0.3, (8, 8, 2))
    normals = np.concatenate([tilts, np.sqrt(1 - (tilts**2).sum(-1, keepdims=True))], axis=-1)
    texture = {"type": "bitmap", "raw": True, "data": np.float32(normals / 2 + 0.5)}
    mapped = {"type": "normalmap", "normalmap": texture, "nested": {"type": "conductor"}}
    texture = {"type": "bitmap", "raw": True, "data": np.float32(rng.uniform(0, 0.2, (8, 8, 1)))}
    raised = {"type": "bumpmap", "texture": texture, "scale": 0.5, "nested": {"type": "conductor"}}
    eye = Track.constant([0.2, 0.1, -4.0 if behind else 4.0])
    camera = Camera(eye, Track.constant([0.0, 0, 0]), Track.constant(25.0))
    squares = tuple(
        StockShape(
            name,
            {"type": "rectangle", "to_world": placed(x, scale=0.5)},
            {"type": "twosided", "bsdf": bsdf} if twosided else bsdf,
        )
        for name, x, bsdf in (("mapped", -0.5, mapped), ("raised", 0.5, raised))
    )
    stage = Stage(Scene((), camera, stock=squares), 20, 20)
    view = stage.view(0)
    buffer = render_gbuffer(stage, view)
    normal = buffer["normal"].reshape(-1, 3)
    ray = stage.rays(view)
    si = stage.mitsuba_scene.ray_intersect(ray)
    sample, weight = si.bsdf().sample(mi.BSDFContext(), si, 0.5, mi.Point2f(0.5, 0.5), si.is_valid())
    valid = np.array(si.is_valid() & dr.any(weight > 0))
    half = np.array(si.to_world(sample.wo)) - np.array(ray.d)
    half = (half / np.linalg.norm(half, axis=0)).T
    assert all(valid[buffer["mesh_id"].ravel() == number].sum() > 100 for number in (1, 2))
    np.testing.assert_allclose(normal[valid], half[valid], atol=2e-3)


def test_holes_of_masks_are_seen_through():
    """What is behind is in the G-buffer, at its own depth; where the mask is opaque it hides it."""
    opacity = {"type": "bitmap", "raw": True, "filter_type": "nearest", "data": np.float32([[[0.0], [1.0]]])}
    holes = {"type": "mask", "opacity": opacity, "nested": WHITE}
    veil = StockShape("veil", {"type": "rectangle", "to_world": placed(0, 0, 1)}, holes)
    green = {"type": "diffuse", "reflectance": rgb(0.1, 0.7, 0.1)}
    wall = StockShape("wall", {"type": "rectangle", "to_world": placed(0, 0, 0, 4)}, green)
    camera = Camera(Track.constant([0.0, 0, 5.0]), Track.constant([0.0, 0, 0]), Track.constant(20.0))
    buffer = first_gbuffer(Scene((), camera, stock=(veil, wall), lights=(SKY,)), 8, 8)
    assert (buffer["mesh_id"][:, :4] == 2).all() and (buffer["mesh_id"][:, 4:] == 1).all()
    np.testing.assert_allclose(buffer["depth"][:, :4], 5, rtol=1e-5)
    np.testing.assert_allclose(buffer["depth"][:, 4:], 4, rtol=1e-5)
    np.testing.assert_allclose(buffer["albedo"][2, 1], [0.1, 0.7, 0.1], rtol=1e-5)


@pytest.mark.parametrize("light", ["to_world", "direction"])
def test_directions_of_lights_do_not_depend_on_the_size(light):
    """A sun above a wall that faces up, a thousand times smaller."""
    down = mi.ScalarTransform4f().look_at([0, 1, 0], [0, 0, 0.5], [1, 0, 0])
    places = {"to_world": np.array(down.matrix), "direction": [0.0, -1.0, 0.5]}
    sun = StockLight("sun", {"type": "directional", light: places[light], "irradiance": rgb(1, 1, 1)})
    towards = np.array([0, 1, -0.5]) / np.hypot(1, 0.5)
    for size in (1.0, 1e-3):
        up = np.array(mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(size).matrix)
        floor = StockShape("floor", {"type": "rectangle", "to_world": up}, WHITE)
        eye = Track.constant([0.0, 2 * size, 0.1 * size])
        camera = Camera(eye, Track.constant([0.0, 0, 0]), Track.constant(20.0))
        stage = Stage(Scene((), camera, stock=(floor,), lights=(sun,)), 8, 8)
        si = stage.mitsuba_scene.ray_intersect(stage.rays(stage.view(0)))
        sampled, irradiance = stage.lights.sample_direction(si, mi.Point2f(0.5, 0.5), si.is_valid())
        lit = si.is_valid() & ~stage.mitsuba_scene.ray_test(si.spawn_ray_to(sampled.p))
        assert dr.all(lit)
        np.testing.assert_allclose(stage.image(sampled.d), np.broadcast_to(towards, (8, 8, 3)), atol=1e-5)
        np.testing.assert_allclose(stage.image(irradiance), 1, rtol=1e-3)


@pytest.mark.parametrize("factor", [1e-3, pytest.param(1e4, marks=pytest.mark.slow)])
def test_the_size_of_a_scene_changes_nothing_but_its_depth(factor):
    """Scenes measured in millimetres or in kilometres: points, spots and skies shine alike."""

    def of_size(size: float) -> tuple[dict, np.ndarray]:
        grown = np.diag([size] * 3 + [1.0])
        places = {name: {"to_world": grown @ kind.get("to_world", np.eye(4))} for name, kind in KINDS.items()}
        shapes = [replace(shape, geometry=shape.geometry | places[shape.name]) for shape in kinds().stock]
        point = {"type": "point", "position": [0.0, 2.0 * size, 2.0 * size], "intensity": rgb(*[5 * size**2] * 3)}
        camera = Camera(Track.constant(CAMERA.eye.at(0) * size), CAMERA.target, CAMERA.x_fov)
        stage = Stage(Scene((), camera, stock=tuple(shapes), lights=(StockLight("point", point), SKY)), SIZE, SIZE)
        view = stage.view(0)
        return render_gbuffer(stage, view), np.add(*PathTracer(stage).radiance(stage.rays(view), 1, 64))

    plain, shown = of_size(1.0)
    scaled, shown_scaled = of_size(factor)
    same = (plain["mesh_id"] == scaled["mesh_id"])[..., 0]
    assert same.mean() > 0.98
    same &= plain["mesh_id"][..., 0] > 0
    np.testing.assert_allclose(scaled["depth"][same] / factor, plain["depth"][same], rtol=1e-3)
    assert np.median(np.abs(shown_scaled - shown)[same] / (shown[same] + 0.1)) < 0.02


def test_relief_and_hair_of_tiny_scenes_are_those_of_large_ones(tmp_path):
    """Heights scale with the scene, though Mitsuba measures them apart from it, and so does the thickness of curves."""
    waves = np.float32(0.5 + 0.4 * np.sin(np.linspace(0, 25, 64)))[None, :, None].repeat(4, axis=0)

    def seen(size: float) -> tuple[float, float]:
        points = [f"{x * size} {y * size} 0 {0.3 * size}" for x, y in ((-1.5, 0), (-0.5, 0.5), (0.5, 0.5), (1.5, 0))]
        curve = tmp_path / f"{size}.txt"
        curve.write_text("\n".join(points))
        height = {"type": "bitmap", "data": waves, "raw": True}
        relief = {"type": "bumpmap", "scale": 0.1 * size, "nested": WHITE, "height": height}
        card = StockShape("card", {"type": "rectangle", "to_world": placed(0, 0, 0, size)}, relief)
        hair = StockShape("hair", {"type": "bsplinecurve", "filename": str(curve)}, WHITE)
        camera = Camera(Track.constant([0.0, 0.0, 5 * size]), CAMERA.target, Track.constant(40.0))
        normals = first_gbuffer(Scene((), camera, stock=(card,), lights=(SKY,)), SIZE, SIZE)["normal"]
        ids = first_gbuffer(Scene((), camera, stock=(hair,), lights=(SKY,)), SIZE, SIZE)["mesh_id"]
        return float(normals[..., 0].std()), float((ids > 0).mean())

    tiny, plain = seen(0.01), seen(1.0)
    assert plain[0] > 0.1 and plain[1] > 0.01
    assert tiny == pytest.approx(plain, rel=0.02)
