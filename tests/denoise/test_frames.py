"""Frames of foreign files have the channels of our own: given, derived or replaced."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets.frame import Frame
from denoise.analysis import analyse
from denoise.foreign_frame import open_passes, read_foreign_frame
from denoise.frames import FrameBuilder, camera_conventions
from denoise.sequence import sequence_of
from denoise.sources import find_sources
from scenes.camera import STILL, View, intrinsics, look_at, pixel_centres, unproject
from tests.denoise.conftest import READS
from tests.helpers import foreign


def frames_of(folder: Path) -> list[Frame]:
    files = sequence_of({"colour": [str(folder / "*.exr")]})
    sources = find_sources(open_passes(files[0], header_only=True), {})
    builder = FrameBuilder(analyse([files], sources, READS, None).conventions, READS, "test")
    return [builder.build(read_foreign_frame(each, sources)[0]) for each in files]


def header_of(frame: Frame) -> dict[str, np.ndarray]:
    return {"worldToNDC": foreign.world_to_ndc(foreign.view(frame), *frame.size)}


@pytest.mark.parametrize("kind", ["depth", "distance"])
def test_depth_and_the_headers_camera_give_motion_and_normals(box, tmp_path, kind):
    for index, frame in enumerate(box):
        eye = foreign.view(frame).camera_to_world[:3, 3]
        distance = np.linalg.norm(foreign.positions(frame) - eye, axis=-1, keepdims=True)
        layer = {"Z": foreign.image(frame, "depth")} if kind == "depth" else {"distance.Y": distance}
        foreign.write(tmp_path / f"{index}.exr", {"RGB": foreign.beauty(frame)} | layer, header_of(frame))
    for built, frame in zip(frames_of(tmp_path)[1:], box[1:], strict=True):
        torch.testing.assert_close(built.depth, frame.depth, rtol=1e-4, atol=0)
        torch.testing.assert_close(built.motion, frame.motion, rtol=0, atol=0.02)
        alike = (built.normal * frame.normal).sum(dim=1) > 0.99
        assert alike.float().mean() > 0.95  # all but edges
    first, second, *_ = frames_of(tmp_path)
    assert second.follows(first.moment) and not first.follows(second.moment)


def test_positions_give_our_cameras(box, tmp_path):
    foreign.write_sequence(tmp_path, box, foreign.pbrt)
    for built, frame in zip(frames_of(tmp_path)[1:], box[1:], strict=True):
        torch.testing.assert_close(built.now.camera_to_world, frame.now.camera_to_world, rtol=0, atol=1e-4)
        torch.testing.assert_close(built.motion, frame.motion, rtol=0, atol=0.02)
        torch.testing.assert_close(built.view_normal(), frame.view_normal(), rtol=0, atol=1e-2)


def test_a_dolly_moves_the_parallel_camera(box, tmp_path):
    """Without cameras, the parallel view moves by the median change of depth."""
    foreign.write_sequence(tmp_path, box, foreign.blender)
    for before, now in pairwise(frames_of(tmp_path)):
        assert now.follows(before.moment)
        step = now.now.camera_to_world[0, :3, 3] - now.previous.camera_to_world[0, :3, 3]
        expected = float((step * now.now.camera_to_world[0, :3, 2]).sum())
        assert abs(expected) == pytest.approx(float(step.norm()), abs=1e-9)
        assert abs(expected - float(before.depth.median() - now.depth.median())) < 0.02 * float(now.depth.median())


def test_what_is_background(tmp_path):
    sky = np.zeros((3, 4, 1))
    sky[0] = 1
    colour = np.full((3, 4, 3), 2.0)
    normal = np.where(sky > 0, 0, [0.0, 0, 1])
    cases = {
        "zero": {"Z": np.where(sky > 0, 0, 5.0)},
        "infinite": {"Z": np.where(sky > 0, np.inf, 5.0)},
        "blender": {"Z": np.where(sky > 0, 1e10, 5.0)},
        "alpha": {"A": 1 - sky},
        "normals": {"N.XYZ": normal, "albedo.RGB": 0.5 * np.abs(normal)},
        "positions": {"P.XYZ": np.where(sky > 0, 0, [1.0, 2, 3])},
    }
    for name, layers in cases.items():
        foreign.write(tmp_path / name / "1.exr", {"RGB": colour} | layers)
        (frame,) = frames_of(tmp_path / name)
        there = torch.from_numpy(sky[..., 0] == 0)
        assert torch.equal(frame.depth[0, 0] > 0, there), name
        assert torch.equal(frame.mesh_id[0, 0] == 1, there)
        assert (frame.direct[0, 0] == 2 * there).all() and (frame.emission[0, 0] == 2 * ~there).all()
        assert (frame.normal[0].norm(dim=0) == there).all()


def test_emission_of_surfaces_is_separated(spheres, tmp_path):
    lamp = np.zeros((40, 56, 3))
    lamp[30:35, 10:20] = 7
    layers = foreign.blender(spheres[0]) | {"ViewLayer.Emit.RGB": lamp}
    layers["ViewLayer.Noisy Image.RGBA"][..., :3] += lamp
    foreign.write(tmp_path / "1.exr", layers)
    (frame,) = frames_of(tmp_path)
    assert frame.emission[0, 0, 32, 15] == 7
    torch.testing.assert_close(frame.direct[0, :, 32, 15], (spheres[0].direct + spheres[0].indirect)[0, :, 32, 15])


def test_albedo_is_clamped_and_bad_motion_is_zero(spheres, tmp_path):
    layers = foreign.blender(spheres[1])
    layers["ViewLayer.Denoising Albedo.RGB"][30, 20] = [-1, 0.5, 3]
    layers["ViewLayer.Vector.XYZW"][30, 20] = np.inf
    foreign.write(tmp_path / "1.exr", foreign.blender(spheres[0]))
    foreign.write(tmp_path / "2.exr", layers)
    frame = frames_of(tmp_path)[1]
    assert frame.albedo[0, :, 30, 20].tolist() == [0, 0.5, 1]
    assert frame.motion[0, :, 30, 20].tolist() == [0, 0]


def test_positions_are_preferred_to_the_headers_camera(box, tmp_path):
    foreign.write(tmp_path / "1.exr", foreign.pbrt(box[0]), header_of(box[1]))
    files = sequence_of({"colour": [str(tmp_path / "1.exr")]})
    pixels, _ = read_foreign_frame(files[0], find_sources(open_passes(files[0]), {}))
    assert camera_conventions(pixels).cameras == "positions"


@pytest.mark.parametrize(("named", "layer"), [({}, "rl.beauty"), ({"colour": "rl.albedo"}, "rl.albedo")])
def test_the_other_sample_buffer_has_the_layer_of_the_colour(tmp_path, named, layer):
    layers = {"rl.albedo.RGB": np.ones((4, 4, 3)), "rl.beauty.RGB": np.zeros((4, 4, 3))}
    paths = {name: [str(foreign.write(tmp_path / name / "1.exr", layers))] for name in ("colour", "buffer_b")}
    sources = find_sources(open_passes(sequence_of(paths)[0], header_only=True), named)
    assert sources.quantities["colour"].layer.name == sources.quantities["buffer_b"].layer.name == layer


@pytest.mark.parametrize("first", ["at the origin", "before a wall"])
def test_positions_in_the_world_of_any_first_frame(tmp_path, first):
    size = 24, 32
    depth = np.random.default_rng(0).uniform(2, 9, size)
    for index in range(3):
        eye = np.array([0.3 * index, 0, 0]) + (first == "before a wall")
        camera = View(intrinsics(60.0, *size), look_at(eye, eye - [0.0, 0.0, 1.0]), STILL)
        is_flat = index == 0 and first == "before a wall"
        points = unproject(pixel_centres(*size), np.full(size, 5.0) if is_flat else depth, camera)
        foreign.write(tmp_path / f"{index}.exr", {"RGB": np.ones((*size, 3)), "P.XYZ": points})
    *_, before, last = frames_of(tmp_path)
    torch.testing.assert_close(last.now.camera_to_world[0], torch.from_numpy(camera.camera_to_world), rtol=0, atol=1e-3)
    assert last.follows(before.moment)


def test_frames_without_a_camera_have_no_history(tmp_path):
    """Walls alone, and no motion: nothing says that they are at rest."""
    size = 24, 32
    depth = np.random.default_rng(0).uniform(2, 9, size)
    for index in range(4):
        eye = np.array([5.0 + index, 0, 0])
        camera = View(intrinsics(60.0, *size), look_at(eye, eye - [0.0, 0.0, 1.0]), STILL)
        points = unproject(pixel_centres(*size), depth if index < 2 else np.full(size, 5.0), camera)
        foreign.write(tmp_path / f"{index}.exr", {"RGB": np.ones((*size, 3)), "P.XYZ": points})
    follows = [now.follows(before.moment) for before, now in pairwise(frames_of(tmp_path))]
    assert follows == [True, False, False]


def test_a_camera_without_depth_gives_no_motion(box, tmp_path):
    for index, frame in enumerate(box[:2]):
        foreign.write(tmp_path / f"{index}.exr", {"RGB": foreign.beauty(frame)}, header_of(frame))
    files = sequence_of({"colour": [str(tmp_path / "*.exr")]})
    analysis = analyse([files], find_sources(open_passes(files[0]), {}), READS, None)
    assert not analysis.conventions.has_history
    assert ("motion", "none: no history, every frame by itself") in analysis.report
