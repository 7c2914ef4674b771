"""The extension for Blender, installed from its zip: its button denoises frames of Cycles, beside Cycles' own OIDN."""

import json
import os
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest

from datasets.tonemap import display, psnr
from denoise.exr_image import ExrImage
from provenance import ROOT
from scenes.camera import STILL, View, motion_vectors, pixel_centres

BLENDER = ROOT / ".venv-blender" / "bin" / "python"
SCRIPT = Path(__file__).with_name("press_button.py")
FRAMES = 10  # of the first shot
LAST = FRAMES + 4
HEIGHT, WIDTH = 135, 240
REFERENCE_SPP = 64
COMPARED = range(1, FRAMES + 1, 3)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not BLENDER.exists(), reason="needs Blender's Python module: `make blender`"),
]


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("extension") / "onespp.zip"
    subprocess.run([sys.executable, "-m", "runtime.blender", path], cwd=ROOT, check=True)
    return path


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    """Runs press_button.py in a user's folder of its own; returns what it printed as errors."""
    user = tmp_path_factory.mktemp("user")

    def run(*arguments: object) -> str:
        command = [str(BLENDER), str(SCRIPT), *map(str, arguments)]
        environment = os.environ | {"BLENDER_USER_RESOURCES": str(user)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0 or "RuntimeError: Error: " in done.stderr, done.stderr
        return done.stderr

    return run


@pytest.fixture(scope="module")
def rendered(archive, press, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("rendered")
    press("render", archive, out, FRAMES, f"{WIDTH}x{HEIGHT}", REFERENCE_SPP)
    return out


def name(frame: int) -> str:
    return f"{frame:04d}.exr"


def image(path: Path, layer: str = "") -> np.ndarray:
    """Radiance (H, W, 3) of a layer."""
    return ExrImage(path).stacked([f"{layer}{c}" for c in "RGB"]).astype(np.float64)


def notes(folder: Path) -> list[dict]:
    """How each frame was denoised."""
    return [json.loads(ExrImage(folder / name(frame)).header["onespp"]) for frame in range(1, LAST + 1)]


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_the_archive_is_for_this_platform(archive):
    files = zipfile.ZipFile(archive)
    manifest = tomllib.loads(files.read("blender_manifest.toml").decode())
    [wheel] = manifest["wheels"]
    assert wheel.removeprefix("./") in files.namelist() and "__init__.py" in files.namelist()
    assert len(manifest["platforms"]) == 1 and manifest["permissions"].keys() == {"files"}


def test_frames_are_denoised_while_rendering(rendered, capsys):
    """The button's frames, and Cycles' own OIDN on frames with the same noise."""
    rows = []
    for frame in COMPARED:
        shown = display(image(rendered / "reference" / name(frame), "ViewLayer.Combined."), 1.0)
        images = {
            "noisy": image(rendered / "frames" / name(frame), "ViewLayer.Combined."),
            "Cycles' OIDN": image(rendered / "oidn" / name(frame), "ViewLayer.Combined."),
            "one": image(rendered / "frames_denoised" / name(frame)),
        }
        same = image(rendered / "oidn" / name(frame), "ViewLayer.Noisy Image.")
        np.testing.assert_array_equal(images["noisy"], same)
        assert np.isfinite(images["one"]).all()
        rows.append([psnr(float(((display(each, 1.0) - shown) ** 2).mean())) for each in images.values()])
    with capsys.disabled():
        print(f"\nPSNR in dB against {REFERENCE_SPP} spp: frame, {', '.join(images)}")
        for frame, row in zip(COMPARED, rows, strict=True):
            print(frame, *(f"{value:.2f}" for value in row))
    noisy, oidn, ours = np.array(rows).T
    assert (ours - noisy).min() > 8
    assert ours[-1] > ours[0] + 1 and ours[-1] > oidn[-1]


def test_cuts_begin_a_new_history(rendered, press):
    begins = [note["begin"] for note in notes(rendered / "frames_denoised")]
    shot = ["continued"] * (FRAMES - 1)
    assert begins == ["gap", *shot, "camera", "continued", "cut", "continued"]
    # The first frame after a cut is what it is by itself.
    alone = rendered / "alone"
    alone.mkdir()
    for frame in (FRAMES + 1, FRAMES + 3):
        os.link(rendered / "frames" / name(frame), alone / name(frame))
    press("finish", alone)
    for frame in (FRAMES + 1, FRAMES + 3):
        files = [rendered / folder / name(frame) for folder in ("frames_denoised", "alone_denoised")]
        np.testing.assert_array_equal(*map(image, files))


def test_cameras_and_motion_agree(rendered):
    """Where nothing but the camera moves, depth and cameras give the motion vectors of Cycles."""
    K = np.diag([WIDTH, HEIGHT, 1])
    views = [
        View(K @ note["K"], np.array(note["camera_to_world"]), STILL) for note in notes(rendered / "frames_denoised")
    ]
    for frame in (3, FRAMES):
        exr = ExrImage(rendered / "frames" / name(frame))
        depth = exr.stacked(["ViewLayer.Depth.Z"])[..., 0].astype(np.float64)
        depth[depth > 1e9] = 0
        vector = exr.stacked(["ViewLayer.Vector.X", "ViewLayer.Vector.Y"]) * [1, -1]
        ids = np.ones(depth.shape, np.int64)
        expected = motion_vectors(pixel_centres(HEIGHT, WIDTH), depth, ids, views[frame - 1], views[frame - 2])
        error = np.linalg.norm(vector - expected, axis=-1)[depth > 0]
        assert np.median(np.linalg.norm(expected, axis=-1)) > 0.2 and np.median(error) < 0.001


def test_finished_folders_resume_to_the_same_bytes(rendered, press):
    """A frame that is lost, one that is not a whole file, and one that was rendered again, with those after it."""
    frames, denoised = copytree(rendered / "frames", rendered / "copy"), rendered / "copy_denoised"
    before = contents(frames)
    press("finish", frames)
    expected = contents(rendered / "frames_denoised")
    assert contents(denoised) == expected and contents(frames) == before
    ages = {path.name: path.stat().st_mtime_ns for path in denoised.iterdir()}
    (denoised / name(5)).unlink()
    (denoised / name(FRAMES + 2)).write_bytes(expected[name(FRAMES + 2)][:-100])
    (frames / name(LAST)).touch()
    press("finish", frames)
    np.testing.assert_array_equal(*(image(folder / name(LAST)) for folder in (denoised, rendered / "frames_denoised")))
    assert contents(denoised) | {name(LAST): expected[name(LAST)]} == expected, "its note has the time of the frame"
    again = {path.name for path in denoised.iterdir() if path.stat().st_mtime_ns != ages[path.name]}
    assert again == {name(frame) for frame in (*range(5, FRAMES + 1), FRAMES + 2, LAST)}
    press("finish", frames, "no")
    assert contents(frames) == before, "of frames that are finished already, nothing is deleted"


def test_half_written_frames_are_refused_and_placeholders_ignored(rendered, press):
    frames, denoised = copytree(rendered / "frames", rendered / "broken"), rendered / "broken_denoised"
    (frames / name(2)).write_bytes(b"")
    content = (frames / name(4)).read_bytes()
    (frames / name(4)).write_bytes(content[: len(content) // 2])
    assert f"{name(4)} is incomplete" in press("finish", frames)
    assert sorted(path.name for path in denoised.iterdir()) == [name(1), name(3)]


def test_rendered_frames_are_deleted_if_asked_for(rendered, press):
    frames, denoised = copytree(rendered / "frames", rendered / "deleted"), rendered / "deleted_denoised"
    press("finish", frames, "no")
    assert not any(frames.iterdir())
    assert contents(denoised) == contents(rendered / "frames_denoised")
    press("finish", frames)
    assert len(list(denoised.iterdir())) == LAST
