"""The package for Mitsuba: guides and motion are those of our own renderer, on every variant, and denoising works."""

import importlib
import os
import re
import subprocess
import sys
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest

from datasets.channels import MIRRORED
from render import look_through, materials, stage
from render.backend import mi
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes import camera
from scenes.camera import axis_rotation, pixel_centres
from scenes.registry import build_scene
from tests.helpers.c_runtime import FOLDER

HEIGHT, WIDTH = 36, 48
AT_EDGES = 0.01  # share of pixels whose rays may meet another of two surfaces that touch
LAMP = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90)}
BOX = {
    "type": "scene",
    "floor": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, -2, 0]).scale([4, 1, 4])},
    "wall": {
        "type": "cube",
        "to_world": mi.ScalarTransform4f().translate([0, 0, 5]).scale([4, 4, 1]),
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.3, 0.2]}},
    },
    "block": {"type": "cube", "to_world": mi.ScalarTransform4f().translate([1, -0.5, 1]).scale(0.5)},
    "ball": {"type": "sphere", "center": [-1, 0, 1], "radius": 0.6},
    "lamp": LAMP | {"emitter": {"type": "area", "radiance": {"type": "rgb", "value": 9.0}}},
}
GUIDES_ALONE = {"type": "onespp_guides", "look_through": False}
CHANNELS = {"albedo": 3, "emission": 3, "normal": 3, "depth": 1, "roughness": 1, "shape": 1, "primitive": 1}


@pytest.fixture(scope="module")
def package(unpacked):
    """onespp_mitsuba."""
    added = [str(unpacked), str(FOLDER / "mitsuba")]
    sys.path[:0] = added
    yield importlib.import_module("onespp_mitsuba")
    sys.path[:] = [path for path in sys.path if path not in added]


def test_limits_are_those_of_our_renderer(package):
    """The package stands alone, so its constants are copies."""
    ours = {name: value for module in (look_through, materials, stage, camera) for name, value in vars(module).items()}
    modules = [importlib.import_module(f"onespp_mitsuba.{name}") for name in ("sight", "bsdfs", "camera")]
    copies = {name: value for module in modules for name, value in vars(module).items() if name.isupper()}
    shared = copies.keys() & ours.keys()
    assert len(shared) >= 9
    assert {name: copies[name] for name in shared} == {name: ours[name] for name in shared}


def sensor_at(camera_to_world: np.ndarray, x_fov: float = 60.0, size: tuple[int, int] = (HEIGHT, WIDTH)):
    film = {"type": "hdrfilm", "height": size[0], "width": size[1], "component_format": "float32"}
    pose = mi.ScalarTransform4f(camera_to_world.tolist())
    return mi.load_dict({"type": "perspective", "fov": x_fov, "fov_axis": "x", "to_world": pose, "film": film})


def before_the_box(x: float = 0.0, turn: float = 0.0) -> np.ndarray:
    """camera_to_world (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = axis_rotation(1, turn)
    pose[:3, 3] = (x, 0.5, -4)
    return pose


def staged(name: str) -> tuple:
    """A scene of ours as a Stage, and Mitsuba's sensor for its first view."""
    stage = Stage(build_scene(name, 0, 4), HEIGHT, WIDTH)
    view = stage.view(0)
    return stage, sensor_at(view.camera_to_world, np.degrees(2 * np.arctan(WIDTH / 2 / abs(view.K[0, 0]))))


def channels(scene, sensor, integrator: dict, seed: int = 0, spp: int = 1) -> dict[str, np.ndarray]:
    """The image, as `light`, and all guides, (H, W, C)."""
    image = np.array(mi.load_dict(integrator).render(scene, sensor, seed, spp))
    counts = {"light": image.shape[2] - sum(CHANNELS.values()), **CHANNELS}
    ends = np.cumsum([*counts.values()])
    return dict(zip(counts, np.split(image, ends[:-1], axis=2), strict=True))


@pytest.mark.parametrize(
    "name", ["extremes-mirrors", *(pytest.param(name, marks=pytest.mark.slow) for name in ("cornell_box", "room-3"))]
)
def test_guides_are_those_of_our_renderer(package, name):
    """In first hits and behind mirrors and glass."""
    stage, sensor = staged(name)
    expected = render_gbuffer(stage, stage.view(0))
    for looks_through in (False, True):
        found = channels(stage.mitsuba_scene, sensor, GUIDES_ALONE | {"look_through": looks_through})
        for ours in ("albedo", "normal", "depth", "roughness"):
            own = expected.get(MIRRORED[ours], expected[ours]) if looks_through else expected[ours]
            differs = (np.abs(found[ours] - own) > 2e-3 * max(1, np.abs(own).max())).any(axis=2)
            assert differs.mean() <= AT_EDGES, (ours, looks_through)
    emission = channels(stage.mitsuba_scene, sensor, GUIDES_ALONE)["emission"]
    seen_directly = (expected["emission"] > 0) & (emission > 0)
    np.testing.assert_allclose(emission[seen_directly], expected["emission"][seen_directly], rtol=1e-3)


def flow_of(package, scene, now, sensor, before) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    found = channels(scene, sensor, GUIDES_ALONE)
    guides = (found[name][..., 0] for name in ("depth", "shape", "primitive"))
    return package.flow_between(now, before, *guides), found


def points_seen(found: dict[str, np.ndarray], pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    """World positions (H, W, 3)."""
    x, y = np.moveaxis((pixel_centres(HEIGHT, WIDTH) - K[:2, 2]) / K[[0, 1], [0, 1]], -1, 0)
    return found["depth"] * (np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3].T) + pose[:3, 3]


def pixels_of(points: np.ndarray, pose: np.ndarray, K: np.ndarray) -> np.ndarray:
    inside = (points - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(all="ignore"):  # background
        return (inside @ K.T)[..., :2] / inside[..., 2:]


def test_flow_of_a_camera_and_of_moving_and_deforming_shapes(package):
    """That of their points, projected. Flow counts from the frame before."""
    scene = mi.load_dict(BOX, optimize=False)
    poses = before_the_box(), before_the_box(0.1, 0.02)
    parameters = mi.traverse(scene)
    vertices = np.array(parameters["block.vertex_positions"]).reshape(-1, 3)
    before = package.Snapshot(sensor_at(poses[0]), scene)
    sheared = vertices + 0.2 * vertices[:, 1:2] * (1, 0, 0.5) + (0.1, 0, 0)
    parameters["block.vertex_positions"] = mi.Float(sheared.ravel())
    lifted = mi.ScalarTransform4f().translate([0.05, 0.1, 0])
    parameters["ball.to_world"] = mi.Transform4f(lifted.matrix) @ parameters["ball.to_world"]
    parameters.update()
    sensor = sensor_at(poses[1])
    now = package.Snapshot(sensor, scene)
    flow, found = flow_of(package, scene, now, sensor, before)
    K = now.camera.K
    then = points_seen(found, poses[1], K)
    ids = {shape.id(): number for number, shape in enumerate(scene.shapes(), 1)}
    shape = found["shape"][..., 0]
    ball, block = (shape == ids[name] for name in ("ball", "block"))
    assert ball.sum() > 20 and block.sum() > 20
    then[ball] -= (0.05, 0.1, 0)
    then[block] -= (0.1, 0, 0)
    then[block] -= 0.2 * then[block][:, 1:2] * (1, 0, 0.5)
    expected = pixel_centres(HEIGHT, WIDTH) - pixels_of(then, poses[0], K)
    hit = found["depth"][..., 0] > 0
    np.testing.assert_allclose(flow[hit], expected[hit], atol=2e-3)
    assert np.abs(flow[hit]).mean() > 0.5


def test_what_does_not_move_has_no_flow(package):
    sensor = sensor_at(before_the_box())
    scene = mi.load_dict(BOX)
    snapshot = package.Snapshot(sensor, scene)
    flow, _ = flow_of(package, scene, snapshot, sensor, package.Snapshot(sensor, scene))
    np.testing.assert_allclose(flow, 0, atol=1e-9)


def test_shapes_in_mirrors_have_numbers_and_poses_of_their_own(package):
    stage, sensor = staged("extremes-mirrors")
    first = channels(stage.mitsuba_scene, sensor, GUIDES_ALONE)
    found = channels(stage.mitsuba_scene, sensor, GUIDES_ALONE | {"look_through": True})
    is_first = first["depth"] == found["depth"]
    poses = np.random.default_rng(0).normal(size=stage.view(0).object_to_world.shape)
    shapes, visible_poses = package.denoiser.visible_shapes(found, poses)
    assert (shapes == found["shape"])[is_first].all() and (shapes > len(poses))[~is_first].mean() > 0.9
    hit = shapes > 0
    same = visible_poses[shapes[hit].astype(int) - 1] == poses[found["shape"][hit].astype(int) - 1]
    assert same.all() and 0.05 < is_first.mean() < 0.95


def psnr(image: np.ndarray, reference: np.ndarray) -> float:
    displayed = [np.clip(each, 0, 1) ** (1 / 2.2) for each in (image, reference)]
    return -10 * np.log10(np.mean((displayed[0] - displayed[1]) ** 2))


@pytest.fixture(scope="module")
def walk(package) -> dict[str, float]:
    """PSNR of the last of some frames, with a camera and a block that move: noisy, and denoised in several ways."""
    path = GUIDES_ALONE | {"light": {"type": "path", "max_depth": 4}}
    scene = mi.load_dict(BOX, optimize=False)
    parameters = mi.traverse(scene)
    rest = np.array(parameters["block.vertex_positions"]).reshape(-1, 3)
    size = (2 * WIDTH, 2 * HEIGHT)
    makes = {"temporal": True, "each by itself": False, "as OptiX": True}
    denoisers = {name: package.Denoiser(size, albedo=True, normals=True, temporal=makes[name]) for name in makes}
    before = None
    for frame in range(8):
        parameters["block.vertex_positions"] = mi.Float((rest + np.array([0.02 * frame, 0, 0])).ravel())
        parameters.update()
        sensor = sensor_at(before_the_box(0.02 * frame), size=size[::-1])
        found = channels(scene, sensor, path, seed=frame)
        now = package.Snapshot(sensor, scene)
        guides = {name: found[name] for name in ("depth", "roughness", "shape", "primitive", "emission")}
        args = found["light"], found["albedo"], found["normal"]
        planes = (found[name][..., 0] for name in ("depth", "shape", "primitive"))
        flow = package.flow_between(now, before, *planes) if before else np.zeros((*size[::-1], 2))
        outputs = {"noisy": found["light"]}
        for name in ("temporal", "each by itself"):
            outputs[name] = denoisers[name](*args, sensor=sensor, scene=scene, **guides)
        to_sensor = sensor.world_transform().inverse()
        tensors = [mi.TensorXf(each.astype(np.float32)) for each in (*args, flow)]
        outputs["as OptiX"] = denoisers["as OptiX"](*tensors[:3], to_sensor, tensors[3], tensors[0])
        before = now
    reference = channels(scene, sensor, path, seed=99, spp=512)["light"]
    return {name: psnr(np.array(output), reference) for name, output in outputs.items()}


def test_denoising_improves_and_history_too(walk):
    assert walk["each by itself"] > walk["noisy"] + 5
    assert walk["temporal"] > walk["each by itself"] + 2
    assert walk["as OptiX"] > walk["each by itself"] + 2


def test_a_bitmap_gives_what_tensors_do(package):
    scene = mi.load_dict(BOX)
    sensor = sensor_at(before_the_box())
    integrator = mi.load_dict(GUIDES_ALONE | {"light": {"type": "direct"}})
    image = np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=1))
    bitmap = sensor.film().bitmap()
    new = lambda: package.Denoiser((WIDTH, HEIGHT), albedo=True, normals=True, temporal=True)  # noqa: E731
    by_name = new()(bitmap, **package.GUIDES, sensor=sensor)
    found = channels(scene, sensor, GUIDES_ALONE | {"light": {"type": "direct"}})
    guides = {name: found[name] for name in ("depth", "roughness", "shape", "primitive", "emission")}
    by_tensor = new()(image[..., :3], found["albedo"], found["normal"], sensor=sensor, **guides)
    np.testing.assert_array_equal(np.array(by_name), np.array(by_tensor))
    half = mi.Bitmap(np.zeros((HEIGHT, WIDTH, 3), np.float16))
    with pytest.raises(ValueError, match="scene: the bitmap holds float16; set component_format"):
        new()(half, **package.GUIDES, sensor=sensor, scene=scene)
    with pytest.raises(ValueError, match="depth_ch: the bitmap has no channel 'far'; it has <root>, albedo"):
        new()(bitmap, "albedo", "normal", depth_ch="far", sensor=sensor)


def test_alpha_and_one_channel_are_kept_and_reset_forgets(package):
    rng = np.random.default_rng(0)
    noisy = rng.exponential(1, (HEIGHT, WIDTH, 4)).astype(np.float32)
    still = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    denoiser = package.Denoiser((WIDTH, HEIGHT), temporal=True)
    first = np.array(denoiser(noisy, flow=still))
    np.testing.assert_array_equal(first[..., 3], noisy[..., 3])
    again = np.array(denoiser(noisy, flow=still))
    denoiser.reset()
    assert np.abs(again - first).max() > 1e-3
    np.testing.assert_array_equal(np.array(denoiser(noisy, flow=still)), first)
    assert np.array(denoiser(noisy[..., :1], flow=still)).shape == (HEIGHT, WIDTH, 1)


def test_background_stays_as_it_is(package):
    """As the noisy image has it: by the normals alone, as OptiX is called, and by depth."""
    noisy = np.random.default_rng(0).exponential(1, (HEIGHT, WIDTH, 3)).astype(np.float32)
    normals = np.zeros_like(noisy)
    normals[8:, :, 2] = -1
    still = np.zeros((HEIGHT, WIDTH, 2), np.float32)
    by_depth = {"depth": 2 * np.abs(normals[..., 2]), "sensor": sensor_at(before_the_box())}
    for guides in ({}, by_depth):
        found = np.array(package.Denoiser((WIDTH, HEIGHT), normals=True)(noisy, normals=normals, flow=still, **guides))
        np.testing.assert_allclose(found[:8], noisy[:8], rtol=1e-6)
        assert found[8:].std() < 0.5 * noisy[8:].std()


def test_an_error_leaves_the_history(package):
    scene, sensor = mi.load_dict(BOX), sensor_at(before_the_box())
    found = channels(scene, sensor, GUIDES_ALONE | {"light": {"type": "direct"}})
    still = {"normals": found["normal"], "flow": np.zeros((HEIGHT, WIDTH, 2))}
    guides = {name: found[name] for name in ("depth", "shape", "primitive")} | {"sensor": sensor, "scene": scene}
    denoisers = [package.Denoiser((WIDTH, HEIGHT), normals=True, temporal=True) for _ in range(2)]
    for _ in range(2):
        expected, actual = (denoiser(found["light"], **still) for denoiser in denoisers)
        with pytest.raises(ValueError, match="samples"):
            denoisers[1](found["light"], **still, **guides, samples=0.0)
    np.testing.assert_array_equal(np.array(actual), np.array(expected))


IMAGE = np.ones((HEIGHT, WIDTH, 3), np.float32)
BAD_CALLS = {
    "size": ({"noisy": IMAGE[1:]}, ValueError, r"noisy: expected shape \(36, 48, 1\) or .*, got \(35, 48, 3\)"),
    "channels": ({"flow": IMAGE}, ValueError, r"flow: expected shape \(36, 48, 2\), got \(36, 48, 3\)"),
    "missing": ({"albedo": None}, ValueError, "albedo is missing: the denoiser was made with albedo=True"),
    "not expected": ({"normals": IMAGE}, ValueError, "normals is not expected"),
    "no sensor": ({"depth": IMAGE[..., 0]}, ValueError, "depth: it needs `sensor`, and normals"),
    "bytes": ({"noisy": IMAGE.astype(np.uint8)}, TypeError, "noisy: expected floats, got ndarray of uint8"),
    "no flow": ({"flow": None}, ValueError, "flow: it is missing"),
    "no such guide": ({"velocity": IMAGE}, ValueError, "no such guides: velocity"),
}


@pytest.mark.parametrize("case", BAD_CALLS)
def test_errors_name_the_argument(package, case):
    changes, kind, message = BAD_CALLS[case]
    denoiser = package.Denoiser((WIDTH, HEIGHT), albedo=True, temporal=True)
    good = {"noisy": IMAGE, "albedo": IMAGE, "flow": np.zeros((HEIGHT, WIDTH, 2), np.float32)}
    denoiser(**good)
    with pytest.raises(kind, match=message):
        denoiser(**(good | changes))


def test_a_sensor_of_another_size_is_refused(package):
    denoiser = package.Denoiser((WIDTH, HEIGHT), normals=True)
    sensor = sensor_at(before_the_box(), size=(2 * HEIGHT, 2 * WIDTH))
    with pytest.raises(ValueError, match=r"sensor: its film is \(72, 96\), the images are \(36, 48\)"):
        denoiser(IMAGE, normals=IMAGE, depth=IMAGE[..., 0], flow=IMAGE[..., :2], sensor=sensor)


def test_errors_of_integrator_and_sensor(package):
    with pytest.raises(RuntimeError, match="expected one nested integrator that samples rays"):
        mi.load_dict({"type": "onespp_guides", "light": {"type": "ptracer"}})
    lens = mi.load_dict({"type": "thinlens", "aperture_radius": 1.0, "focus_distance": 3.0})
    with pytest.raises(ValueError, match="sensor: depth of field blurs"):
        package.Snapshot(lens)


# What a variant computes: guides of a small frame, and what the denoiser makes of numbers that are the same for all.
VARIANT = """
import sys
import mitsuba as mi, numpy as np
from onespp_mitsuba import Denoiser
mi.set_variant(sys.argv[1])
path = {"type": "path", "max_depth": 3}
box = mi.cornell_box()
box["small-box"]["bsdf"] = {"type": "conductor"}
box["sensor"]["film"] = {"type": "hdrfilm", "width": 24, "height": 20, "rfilter": {"type": "gaussian"}}
scene = mi.load_dict(box)
integrator = mi.load_dict({"type": "onespp_guides", "light": path})
image = np.array(mi.render(scene, integrator=integrator, spp=4))
rng = np.random.default_rng(0)
denoiser, outputs = Denoiser((24, 20), temporal=True), []
for _ in range(3):
    noisy = mi.TensorXf(rng.exponential(1, (20, 24, 3)).astype(np.float32))
    outputs.append(np.array(denoiser(noisy, flow=mi.TensorXf(np.zeros((20, 24, 2), np.float32)))))
np.savez(sys.argv[2], image=image, outputs=outputs)
"""


@pytest.fixture(scope="module")
def environment(unpacked) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join([str(unpacked), str(FOLDER / "mitsuba")])}


@pytest.fixture(scope="module")
def by_variant(environment, tmp_path_factory) -> Callable[[str], dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("variants")

    @cache
    def arrays_of(variant: str) -> dict[str, np.ndarray]:
        command = [sys.executable, "-c", VARIANT, variant, str(folder / f"{variant}.npz")]
        subprocess.run(command, check=True, env=environment, timeout=300)
        return dict(np.load(folder / f"{variant}.npz"))

    return arrays_of


SHAPE_CHANNEL = 14  # its numbers follow the order in which a variant loads shapes


@pytest.mark.parametrize(
    ("variant", "tolerance"),
    [("scalar_rgb", 1e-4), pytest.param("llvm_ad_spectral", 0.02, marks=pytest.mark.slow)],
)
def test_variants_agree(by_variant, variant, tolerance):
    """On guides but for rays along edges, and on the denoised images exactly; spectra round colours."""
    ours, theirs = by_variant("llvm_ad_rgb"), by_variant(variant)
    guides = [np.delete(each["image"], [0, 1, 2, SHAPE_CHANNEL], axis=2) for each in (ours, theirs)]
    differs = (np.abs(guides[0] - guides[1]) > tolerance * np.maximum(1, np.abs(guides[0]))).any(axis=2)
    assert differs.mean() < 0.05
    means = [each["image"][..., :3].clip(0, 0.3).mean() for each in (ours, theirs)]  # of independent samples
    assert means[0] == pytest.approx(means[1], rel=0.1)
    np.testing.assert_array_equal(theirs["outputs"], ours["outputs"])


def test_the_example_of_the_page(environment, tmp_path):
    [code] = re.findall(r"```python\n(.*?)```", (FOLDER / "mitsuba" / "README.md").read_text(), re.DOTALL)
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, env=environment, timeout=300)
    assert len(list(tmp_path.glob("*.exr"))) == 8


@pytest.mark.slow
def test_the_turntable_turns_evenly(environment, tmp_path):
    """Around a cube: after 90 degrees, and only then, it looks as before."""
    xml = """<scene version="3.0.0"><sensor type="perspective">
    <transform name="to_world"><lookat origin="0,1,-4" target="0,0,0" up="0,1,0"/></transform></sensor>
    <shape type="cube"/><emitter type="constant"/></scene>"""
    (tmp_path / "scene.xml").write_text(xml)
    command = [sys.executable, str(FOLDER / "mitsuba" / "turntable.py"), "scene.xml", "out", "4", "30", "32", "24"]
    subprocess.run(command, cwd=tmp_path, check=True, env=environment, timeout=300)
    images = [np.array(mi.Bitmap(str(tmp_path / "out" / f"{frame:04}.exr"))) for frame in range(4)]
    assert images[0].shape == (24, 32, 3) and all(np.isfinite(image).all() for image in images)
    assert np.abs(images[0] - images[1]).max() > 0.1
    from_first = [np.abs(image - images[0]).mean() for image in images]
    assert from_first[3] < 0.3 * min(from_first[1:3])
