"""Exported steps equal the denoisers: over sequences, at any size, in every runtime, and for extreme inputs."""

import copy
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.cameras import Cameras
from datasets.frame import BOUNDED
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from models import compiled
from models.compiled.fusion import WINDOWS
from models.denoiser import Denoiser
from models.export import program as programs
from models.export import wskp
from models.export.history import GraphGBuffer, reprojected
from models.export.one import affinity_level, mesh_sums
from models.export.package import EXPORTABLE, Export, largest_difference, load_step, write_export
from models.export.program import play, run_onnx, run_pt2, trace, write_onnx, write_pt2
from models.filters import neighbours
from models.history.geometry import GBuffer, to_previous_camera
from models.history.reprojection import reproject
from models.networks.one import plain_level
from models.registry import create
from models.spec import load
from models.weights import save_weights
from provenance import file_digest
from tests.helpers.exports import check_page
from tests.helpers.frames import flat_frame, run
from tests.helpers.unfold import unfold_fuse

SIZES = ((64, 96), (77, 131))
FRAMES = 10
TOLERANCE = 1e-4
HALF_TOLERANCE = 2e-2  # of a network in float16 against float32
LENGTH = {"wskp3": 3, "one": 6}  # channel of the history; one denoiser of each kind

each_kind = pytest.mark.parametrize("name", LENGTH)

onnx_only = pytest.mark.skipif(
    any(programs.find_spec(package) is None for package in programs.NEEDED["onnx"]),
    reason="needs pip install 'onespp[export]'",
)


def slow_onnx(test):
    return onnx_only(pytest.mark.slow(test))


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Weight files whose filters' weights vary strongly."""
    folder = tmp_path_factory.mktemp("weights")
    files = {}
    for name in EXPORTABLE:
        torch.manual_seed(0)
        denoiser = create(name)
        with torch.no_grad():
            for layer in [denoiser.network.leave] if name == "one" else denoiser.network[-1].branches:
                layer.weight *= 10
        files[name] = folder / f"{name}.safetensors"
        save_weights(denoiser, name, {}, files[name])
    return files


def sequence(size, first=0, frames=FRAMES):
    return [synthetic_frame(index, *size) for index in range(first, first + frames)]


def pair(weights, name, warp="inside"):
    """The step and the denoiser."""
    return (load_step(name, weights[name], torch.float32, warp), load(name, weights[name], torch.float32))


def outputs_of(step, frames, compute=None):
    """All outputs of each frame, by default of the step itself."""
    with torch.no_grad():
        return [outputs for _, outputs in play(step, frames, compute or step)]


def check_equal(step, denoiser: Denoiser, frames, compute=None, tolerance=TOLERANCE):
    """The radiance of every frame equals the denoiser's."""
    outputs = outputs_of(step, frames, compute)
    for actual, expected in zip(outputs, run(denoiser, frames), strict=True):
        assert largest_difference(actual["radiance"], expected) < tolerance


def camera_of(cameras: Cameras):
    return cameras.K[0].float(), cameras.camera_to_world[0].float()


@pytest.mark.parametrize("warp", ["inside", "outside"])
@pytest.mark.parametrize("name", EXPORTABLE)
def test_steps_equal_the_denoisers(weights, name, warp):
    step, denoiser = pair(weights, name, warp)
    for size in (*SIZES, (13, 17), (2, 2), (1, 5), (1, 1), (130, 17)):
        check_equal(step, denoiser, sequence(size, frames=5))


@each_kind
def test_cuts_and_size_changes_reset_the_state(weights, name):
    """The first frame after a cut equals the first frame of a sequence, exactly."""
    step, denoiser = pair(weights, name)
    shots = [*sequence((24, 32), 0, 3), *sequence((24, 32), 40, 3), *sequence((20, 30), 43, 2)]
    check_equal(step, denoiser, shots)
    after_cut = outputs_of(step, shots[:4])[3]
    (first,) = outputs_of(step, [shots[3]])
    assert (after_cut["new_history"][:, LENGTH[name]] == 1).all()
    for output, tensor in first.items():
        assert torch.equal(after_cut[output], tensor)


@each_kind
def test_background_is_emission_and_does_not_bleed(weights, name):
    step, denoiser = pair(weights, name)
    frames = sequence((48, 64), frames=3)
    sky = frames[0].depth == 0
    assert 0 < sky.float().mean() < 1
    glowing = [frame.with_channels({"direct": torch.where(frame.depth == 0, 1e4, frame.direct)}) for frame in frames]
    output = outputs_of(step, glowing[:1])[0]["radiance"]
    assert torch.equal(output[sky.expand_as(output)], frames[0].emission[sky.expand_as(output)])
    check_equal(step, denoiser, glowing)


@each_kind
def test_frames_of_background_alone_black_frames_and_radiance_that_is_not_finite(weights, name):
    step, denoiser = pair(weights, name)
    frame = flat_frame(20, 24)
    zero = torch.zeros(1, 1, 20, 24)
    sky = frame.with_channels({"depth": zero, "mesh_id": zero, "emission": frame.direct * 3})
    black = frame.with_channels({"direct": 0 * frame.direct})
    broken = frame.with_channels({"direct": frame.direct.clone()})
    broken.direct[0, :, 5, 6] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    broken.direct[0, :, 9, 3] = 6e4
    for frames in ([sky, frame, frame], [black, frame, black], [frame, sky, black], [frame, broken, frame]):
        check_equal(step, denoiser, frames)


@each_kind
def test_surfaces_count_as_at_most_100(weights, name):
    step, denoiser = pair(weights, name)
    frames = sequence((24, 32), frames=3)
    for channel in {*BOUNDED} & {port.name for port in step.images}:
        for frame in frames:
            frame.channel(channel)[..., 5:7, 6:9] = 1e35
    outputs = outputs_of(step, frames)
    assert all(torch.isfinite(tensor).all() for each in outputs for tensor in each.values())
    check_equal(step, denoiser, frames)


def test_sample_counts_that_change_from_frame_to_frame(weights):
    counted = zip(sequence((13, 17), frames=3), (4.0, 1.0, 16.0), strict=True)
    frames = [replace(frame, spp=torch.full((1, 1, 1, 1), samples)) for frame, samples in counted]
    check_equal(*pair(weights, "one"), frames)


@settings(max_examples=40, deadline=None)
@given(height=st.integers(1, 9), width=st.integers(1, 9), step=st.integers(1, 12), seed=st.integers(0, 9999))
def test_neighbour_sums_equal_the_filters(height, width, step, seed):
    """Over background and meshes, with bright pixels and the whole range of sharpness and importance."""
    torch.manual_seed(seed)
    size = (height, width)
    surface = (torch.rand(1, 1, *size) > 0.2).float()
    image = torch.exp(4 * torch.randn(1, 3, *size)) * surface
    maps = torch.randn(1, 8, *size), torch.exp(3 * torch.randn(1, 1, *size)), *(20 * torch.rand(2, 1, 1, *size) - 10)
    mesh_id = torch.randint(0, 3, (1, 1, *size)).float()
    filtered = affinity_level(image, *maps, surface, mesh_id + 1, step)
    torch.testing.assert_close(filtered, plain_level(image, *maps, surface, mesh_id, step), rtol=1e-5, atol=0)
    with compiled.disabled():
        expected = neighbours.mesh_sums(image, mesh_id, step)
    torch.testing.assert_close(mesh_sums(image, mesh_id + 1, step), expected, rtol=1e-5, atol=0)


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    motion=st.tuples(st.integers(-48, 48), st.integers(-48, 48)),
    seed=st.integers(0, 9999),
)
def test_reprojection_equals_that_of_the_history(height, width, motion, seed):
    """On walls of a few meshes, where many pixels have no valid tap among 2 x 2, or none at all."""
    torch.manual_seed(seed)
    meshes = [torch.randint(0, 4, (1, 1, height, width)) for _ in range(2)]
    frame = flat_frame(height, width, (motion[0] / 16, motion[1] / 16), mesh_id=meshes[0])
    surfaces = replace(GBuffer.of(frame), mesh_id=meshes[1].float())
    history = torch.rand(1, 4, height, width)
    expected, has_history = reproject(frame, history, surfaces)
    previous = GraphGBuffer(surfaces.depth, surfaces.normal, surfaces.mesh_id, *camera_of(frame.previous))
    now = GraphGBuffer(frame.depth, frame.normal, frame.mesh_id.int(), *camera_of(frame.now))
    matrices = to_previous_camera(frame.now, frame.previous, 0).float()
    actual = reprojected(history, now, previous, matrices, frame.motion)
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-5)
    assert not actual[~has_history.expand_as(actual)].any()


@pytest.mark.parametrize("spread", [1.0, 30.0, 1e4])
def test_windows_are_exact_for_any_logits(spread):
    """Against unfolding and softmax in float64; a window without any surface adds 0."""
    torch.manual_seed(0)
    image = 10 * torch.rand(1, 3, 23, 31) ** 4
    importance = spread * torch.randn(1, len(WINDOWS), 23, 31)
    mixture = torch.randn_like(importance)
    surface = (torch.rand(1, 1, 23, 31) > 0.3).float()
    with torch.no_grad():
        output = wskp.fuse(image, importance, mixture, surface)
    expected = unfold_fuse(image.double(), importance.double(), mixture.double(), surface=surface)
    torch.testing.assert_close(output.double(), expected, rtol=1e-5, atol=1e-6)


def test_only_the_network_is_in_float16(weights):
    """Images stay in float32: radiance may exceed the range of float16, and histories keep their precision."""
    half = load_step("wskp3", weights["wskp3"], torch.float16, "inside")
    whole = load_step("wskp3", weights["wskp3"], torch.float32, "inside")
    frames = [frame.with_channels({"direct": frame.direct * 1e5}) for frame in sequence((40, 48), frames=6)]
    for a, b in zip(outputs_of(half, frames), outputs_of(whole, frames), strict=True):
        assert torch.equal(a["new_history"], b["new_history"]) and torch.equal(a["new_scale"], b["new_scale"])
        assert largest_difference(a["radiance"], b["radiance"]) < HALF_TOLERANCE
        assert b["radiance"].max() > 65504


@pytest.fixture(scope="module", params=["wskp3", "one"])
def written(request, weights, tmp_path_factory):
    """A denoiser of each kind as ONNX, in a folder of its name."""
    name = request.param
    folder = tmp_path_factory.mktemp("export") / name
    write_export(Export(name, weights[name], "onnx", "float32", "inside"), sequence((40, 56), frames=3), folder)
    return folder


@slow_onnx
def test_onnx_equals_the_denoiser_at_two_sizes(weights, written):
    step, denoiser = pair(weights, written.name)
    for size in SIZES:
        check_equal(step, denoiser, sequence(size), run_onnx(written / f"{written.name}.onnx"))


@slow_onnx
def test_the_manifest_describes_the_files(weights, written):
    import onnx

    manifest = json.loads((written / "manifest.json").read_text())
    files = {str(path.relative_to(written)) for path in written.rglob("*") if path.is_file()}
    assert set(manifest["sha256"]) == files - {"manifest.json"}
    assert all(file_digest(written / name) == digest for name, digest in manifest["sha256"].items())
    assert manifest["weights_sha256"] == file_digest(weights[written.name])
    assert manifest["largest_difference"]["from_onespp"] < TOLERANCE
    model = onnx.load(written / f"{written.name}.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert manifest["operators"]["total"] == len(model.graph.node) == sum(manifest["operators"]["kinds"].values())
    assert [*manifest["operators"]["branches"]] == (["then_branch", "else_branch"] if written.name == "wskp3" else [])
    for key, values in (("inputs", model.graph.input), ("outputs", model.graph.output)):
        shapes = {v.name: [d.dim_value or d.dim_param for d in v.type.tensor_type.shape.dim] for v in values}
        assert {port["name"]: port["shape"] for port in manifest[key]} == shapes
    names = {port["name"] for key in ("inputs", "outputs") for port in manifest[key]}
    assert {each["from"] for each in manifest["state"]} | {each["input"] for each in manifest["state"]} <= names


@slow_onnx
def test_the_instructions_reproduce_the_golden_frames(written):
    check_page(written, np.ascontiguousarray, TOLERANCE)


def files_of(step, folder):
    """The step as ONNX and pt2 files, each as a callable."""
    program = trace(step, synthetic_frame(0, 24, 32))
    write_onnx(program, step, folder / "step.onnx")
    write_pt2(program, step, folder / "step.pt2")
    return run_onnx(folder / "step.onnx"), run_pt2(folder / "step.pt2")


@pytest.mark.slow
@each_kind
def test_operators_are_named_alike_in_every_process(weights, tmp_path, name):
    """By words, without the addresses at which Python's functions are in memory."""
    step, _ = pair(weights, name)
    operators = write_pt2(trace(step, synthetic_frame(0, 24, 32)), step, tmp_path / "step.pt2")
    assert {"aten.conv2d.default", "sym_max", "getitem"} <= operators["kinds"].keys()
    assert all(re.fullmatch(r"[\w.]+", kind) for kind in operators["kinds"])


@slow_onnx
@pytest.mark.parametrize("name", EXPORTABLE)
def test_every_format_equals_the_denoiser(weights, tmp_path, name):
    """With the warp inside and outside, as ONNX and pt2, and with a float16 network."""
    for warp in ("inside", "outside"):
        step, denoiser = pair(weights, name, warp)
        for compute in files_of(step, tmp_path):
            for size in SIZES:
                check_equal(step, denoiser, sequence(size), compute)
    if torch.float16 not in denoiser.refuses:
        half = load_step(name, weights[name], torch.float16, "outside")
        write_onnx(trace(half, synthetic_frame(0, 24, 32)), half, tmp_path / "half.onnx")
        check_equal(half, denoiser, sequence(SIZES[1]), run_onnx(tmp_path / "half.onnx"), HALF_TOLERANCE)


@slow_onnx
def test_extreme_logits_take_the_slower_branch_in_files(weights, tmp_path):
    denoiser = load("wskp3", weights["wskp3"], torch.float32)
    with torch.no_grad():
        denoiser.network[-1].merged.weight[:6] *= 300
        if hasattr(denoiser.network[-1].merged, "pair"):
            denoiser.network[-1].merged.pair()
    step = wskp.WSKPStep(copy.deepcopy(denoiser), "outside")
    for compute in files_of(step, tmp_path):
        check_equal(step, denoiser, sequence((40, 56), frames=3), compute, 10 * TOLERANCE)


def test_what_cannot_be_exported(weights, tmp_path, monkeypatch):
    def refused(match, name, weights, to="pt2", precision="float32", folder="out"):
        with pytest.raises(BadInput, match=match):
            write_export(Export(name, weights, to, precision, "inside"), sequence((8, 8), frames=1), Path(folder))

    monkeypatch.chdir(tmp_path)
    refused("'svgf' cannot be exported; wskp3, wskp6, one can", "svgf", weights["wskp3"])
    refused("holds weights of 'wskp3', not of 'wskp6'", "wskp6", weights["wskp3"])
    refused(r"One does not compute in torch\.float16", "one", weights["one"], precision="float16")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    for folder in ("mine", "mine/thesis.txt"):
        refused("is not an earlier export: choose another", "wskp3", weights["wskp3"], folder=folder)
    for folder in (".", ".."):
        refused("is the current folder or contains it", "wskp3", weights["wskp3"], folder=folder)
    monkeypatch.setattr(programs, "find_spec", lambda package: None if package == "onnxscript" else object())
    refused(r"needs onnxscript: pip install 'onespp\[export\]'", "wskp3", weights["wskp3"], "onnx")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]
