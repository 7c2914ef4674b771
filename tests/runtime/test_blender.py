"""The parts of the extension for Blender that need no Blender: OpenEXR files, passes, and the supersampled albedo."""

import importlib
import os
import sys
import types
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from provenance import ROOT
from scenes.camera import axis_rotation

EXTENSION = ROOT / "runtime" / "blender" / "extension"
SIZE = (37, 50)
LAYERS = {
    "Combined": "RGBA",
    "Depth": "Z",
    "Normal": "XYZ",
    "Vector": "XYZW",
    "Denoising Albedo": "RGB",
    "Emission": "RGB",
}


@pytest.fixture(scope="module")
def extension():
    """Its modules by name: the package itself would import Blender."""
    package = types.ModuleType("onespp_extension")
    package.__path__ = [str(EXTENSION)]
    sys.modules[package.__name__] = package
    yield lambda name: importlib.import_module(f"onespp_extension.{name}")
    for name in [name for name in sys.modules if name.startswith("onespp_extension")]:
        del sys.modules[name]


def layers(rng: np.random.Generator, size: tuple[int, int] = SIZE) -> dict[str, np.ndarray]:
    """Planes of all passes, whose values take all bits and partly repeat; the first rows are background."""
    planes = {f"ViewLayer.{name}.{c}": rng.random(size, np.float32) for name, parts in LAYERS.items() for c in parts}
    for plane in planes.values():
        plane[-9:] = np.float32(0.5)
    planes["ViewLayer.Depth.Z"][:5] = 1e10
    return planes


def write(path: Path, parts: list[dict[str, np.ndarray]], compression=OpenEXR.ZIP_COMPRESSION) -> Path:
    header = {"compression": compression, "type": OpenEXR.scanlineimage, "cycles.ViewLayer.samples": "4"}
    parts = [dict(part) for part in parts]  # OpenEXR puts objects of its own in place of arrays
    if len(parts) == 1:
        OpenEXR.File(header, parts[0]).write(str(path))
    else:
        OpenEXR.File([OpenEXR.Part(dict(header), part, f"part{i}") for i, part in enumerate(parts)]).write(str(path))
    return path


@pytest.mark.parametrize("codec", ["NO", "ZIPS", "ZIP"])
@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.uint32])
def test_it_reads_what_openexr_writes(extension, tmp_path, codec, dtype):
    """In one part as before Blender 5, and in several."""
    planes = {name: (1000 * plane.clip(0, 9)).astype(dtype) for name, plane in layers(np.random.default_rng(0)).items()}
    planes["ViewLayer.Depth.Z"][:5] = 7
    names = sorted(planes)
    halves = [{name: planes[name] for name in part} for part in (names[::2], names[1::2])]
    for parts in ([planes], halves):
        path = write(tmp_path / "it.exr", parts, getattr(OpenEXR, f"{codec}_COMPRESSION"))
        reader = extension("exr").ExrReader(path)
        assert sorted(reader.channels) == names and reader.attribute("cycles.ViewLayer.samples") == "4"
        found = reader.planes(names[3:9])
        assert sorted(found) == names[3:9]
        for name, plane in found.items():
            np.testing.assert_array_equal(plane, planes[name].astype(np.float32))


@pytest.mark.parametrize("size", [(1, 1), (16, 3), (37, 50)])
def test_openexr_reads_what_it_writes(extension, tmp_path, size):
    rng = np.random.default_rng(1)
    planes = {"R": rng.random(size, np.float32), "G": np.zeros(size, np.float16), "A": np.ones(size, np.float32)}
    extension("exr").write_exr(tmp_path / "it.exr", planes, {"onespp": "a note"})
    file = OpenEXR.File(str(tmp_path / "it.exr"), separate_channels=True)
    assert file.header()["onespp"] == "a note" and [path.name for path in tmp_path.iterdir()] == ["it.exr"]
    for name, plane in planes.items():
        pixels = file.channels()[name].pixels
        assert pixels.dtype == plane.dtype
        np.testing.assert_array_equal(pixels, plane)


def test_incomplete_files_are_refused_wherever_they_end(extension, tmp_path):
    content = write(tmp_path / "it.exr", [layers(np.random.default_rng(2))]).read_bytes()
    exr = extension("exr")
    for end in (0, 3, 8, 100, 600, len(content) // 2, len(content) - 1):
        (tmp_path / "part.exr").write_bytes(content[:end])
        with pytest.raises(exr.BadFrame, match=r"part\.exr is incomplete"):
            reader = exr.ExrReader(tmp_path / "part.exr")
            reader.planes(reader.channels)


def test_other_codecs_are_named(extension, tmp_path):
    path = write(tmp_path / "it.exr", [layers(np.random.default_rng(3))], OpenEXR.PIZ_COMPRESSION)
    with pytest.raises(extension("exr").BadFrame, match="codec PIZ: choose ZIP"):
        extension("exr").ExrReader(path)


def test_passes_become_what_the_runtime_takes(extension, tmp_path):
    planes = layers(np.random.default_rng(4))
    frame = extension("cycles_frame").read_cycles_frame(write(tmp_path / "it.exr", [planes]))
    light, seen = (
        np.stack([planes[f"ViewLayer.{name}.{c}"] for c in "RGB"], axis=-1) for name in ("Combined", "Emission")
    )
    assert frame.samples == 4 and frame.size == SIZE
    np.testing.assert_array_equal(frame.emission[5:], seen[5:])
    np.testing.assert_array_equal(frame.color[5:], (light - seen)[5:])
    np.testing.assert_array_equal(frame.emission[:5], light[:5])
    assert (
        not any(image[:5].any() for image in (frame.color, frame.normal, frame.depth)) and (frame.albedo[:5] == 1).all()
    )
    np.testing.assert_allclose(np.linalg.norm(frame.normal[5:], axis=-1), 1, rtol=1e-5)
    np.testing.assert_array_equal(frame.motion[..., 1], -planes["ViewLayer.Vector.Y"])


def test_albedo_that_is_no_number_is_black(extension, tmp_path):
    planes = layers(np.random.default_rng(4))
    planes["ViewLayer.Denoising Albedo.G"][7, 3] = np.nan
    planes["ViewLayer.Denoising Albedo.R"][7, 3] = np.inf
    frame = extension("cycles_frame").read_cycles_frame(write(tmp_path / "it.exr", [planes]))
    assert (frame.albedo[7, 3, :2] == 0).all() and np.isfinite(frame.albedo).all()


def test_the_pose_of_a_sheared_camera_is_rigid(extension):
    camera = extension("camera")
    turned = np.eye(4)
    turned[:3, :3] = axis_rotation(1, 0.7) @ axis_rotation(0, 0.3)
    expected = turned @ np.diag([-1, 1, -1, 1])
    np.testing.assert_allclose(camera.pose(turned @ np.diag([2, 2, 2, 1])), expected, atol=1e-12)
    found = camera.pose(np.diag([1, 1, 3, 1]) @ turned)[:3, :3]
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
    with pytest.raises(extension("exr").BadFrame, match="scaled by 0"):
        camera.pose(np.zeros((4, 4)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Vector": None}, "lacks the passes Vector: set them .* motion blur"),
        ({"Depth": "Other"}, "lacks the passes"),
        ({"*": "Other"}, "the view layers Other, ViewLayer: only one"),
    ],
)
def test_passes_that_lack_are_named(extension, tmp_path, changes, message):
    planes = layers(np.random.default_rng(5))
    for name in list(planes):
        layer = name.split(".")[1]
        if "*" in changes:
            planes[name.replace("ViewLayer", "Other")] = planes[name]
        elif layer in changes:
            plane = planes.pop(name)
            if changes[layer]:
                planes[name.replace(layer, changes[layer])] = plane
    path = write(tmp_path / "it.exr", [planes])
    with pytest.raises(extension("exr").BadFrame, match=message):
        extension("cycles_frame").read_cycles_frame(path)


def checker(phase: float, rng: np.random.Generator, jitter: float) -> np.ndarray:
    """Albedo (H, W, 3) of a pattern at `phase` pixels to the right, sampled at random places of each pixel."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5 + jitter * rng.uniform(-0.5, 0.5, (2, *SIZE))
    bright = np.sin((x - phase) * 0.9) * np.sin(y * 0.7) > 0
    return np.where(bright, 0.8, 0.1)[..., None].repeat(3, axis=-1).astype(np.float32)


def frame_of(extension, albedo: np.ndarray, shift: float):
    flat = np.ones((*SIZE, 1), np.float32)
    motion = np.zeros((*SIZE, 2), np.float32) - np.float32([shift, 0])
    color = 2 * albedo
    return extension("cycles_frame").CyclesFrame(
        color, albedo, flat.repeat(3, -1), flat, motion, 0 * color, flat[..., 0], 1.0
    )


def test_the_mean_albedo_is_nearer_to_that_of_many_samples(extension):
    """While the surface moves by a fraction of a pixel a frame; the light on it stays as it was."""
    supersampling = extension("supersampling")
    rng = np.random.default_rng(6)
    shift = 0.37
    mean = None
    for index in range(8):
        frame = frame_of(extension, checker(shift * index, rng, 1), shift)
        mean = mean.add(frame) if mean else supersampling.AlbedoMean.begin(frame)
    expected = np.mean([checker(shift * 7, rng, 1) for _ in range(256)], axis=0)
    inside = (slice(4, -4), slice(8, -4))
    before, after = (((each - expected)[inside] ** 2).mean() for each in (frame.albedo, mean.mean))
    assert after < before / 2
    smooth = supersampling.with_albedo(frame, mean.mean)
    np.testing.assert_allclose(smooth.color / smooth.albedo, 2, rtol=1e-4)


def test_surfaces_that_come_into_view_begin_with_their_own_albedo(extension):
    """From outside the image, and where there was background; motion may be no number."""
    supersampling = extension("supersampling")
    rng = np.random.default_rng(7)
    first, second = (frame_of(extension, checker(0, rng, 1), 0) for _ in range(2))
    first.depth[10:20], second.motion[:5], second.motion[5] = 0, 1e9, np.nan
    mean = supersampling.AlbedoMean.begin(first).add(second)
    for rows in (slice(0, 5), slice(11, 19)):
        np.testing.assert_array_equal(mean.mean[rows], second.albedo[rows])
    assert (mean.frames[20:] == 2).all() and np.isfinite(mean.mean).all()


def still_camera(extension):
    return extension("camera").Camera("", np.array([[-1, 0, 0.5], [0, -1, 0.5], [0, 0, 1]]), np.eye(4))


def test_a_frame_rendered_again_has_those_after_it_denoised_again(extension, unpacked, tmp_path, monkeypatch):
    """Also in a run after one that was interrupted, and where the new file is older than the denoised one."""
    monkeypatch.syspath_prepend(unpacked)
    camera = still_camera(extension)

    def path_of(number: int) -> Path:
        return tmp_path / f"{number}.exr"

    def run(most: int = 9) -> list[int]:
        animation = extension("animation").Animation(path_of, tmp_path / "denoised", detects_cuts=False)
        done = []
        for number in range(1, 6):
            if len(done) < most and not animation.is_finished(number):
                animation.denoise(number, camera)
                done.append(number)
        return done

    for number in range(1, 6):
        write(path_of(number), [layers(np.random.default_rng(number))])
    assert run() == [1, 2, 3, 4, 5] and run() == []
    write(path_of(2), [layers(np.random.default_rng(9))])
    os.utime(path_of(2), (0, 0))
    assert run(most=2) == [2, 3] and run() == [4, 5] and run() == []


def test_files_of_others_are_not_replaced(extension, unpacked, tmp_path, monkeypatch):
    """As are its own, damaged ones too."""
    monkeypatch.syspath_prepend(unpacked)
    rendered = write(tmp_path / "0001.exr", [layers(np.random.default_rng(8))])
    camera = still_camera(extension)
    animation = extension("animation").Animation(lambda _: rendered, tmp_path / "denoised")
    target = animation.denoised(1)
    animation.denoise(1, camera)
    expected = target.read_bytes()
    target.write_bytes(expected[:-100])
    animation.denoise(1, camera)
    assert target.read_bytes() == expected
    for content in (rendered.read_bytes(), b"a text"):
        target.write_bytes(content)
        with pytest.raises(extension("exr").BadFrame, match=r"0001\.exr was not written by .* choose another folder"):
            animation.denoise(1, camera)
        assert target.read_bytes() == content
