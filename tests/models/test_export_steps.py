"""Exported steps against our denoisers: equal over sequences, at any size, by any runtime, and at the extremes."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn import functional as F

from datasets.cameras import Cameras
from datasets.clip import Dataset
from datasets.frame import read_frame
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from models import compiled
from models.compiled.fusion import WINDOWS
from models.denoiser import Denoiser
from models.export import program as programs
from models.export.box_windows import BoxWindows
from models.export.neighbours import affinity_level, mesh_sums
from models.export.package import Export, largest_difference, write_export
from models.export.playing import play
from models.export.program import trace, write_onnx, write_pt2
from models.export.registry import STEPS, load_step
from models.export.reprojection import View, expectation, fetch, places, table_of
from models.export.runtime import run_onnx, run_pt2
from models.filters import neighbours
from models.history.geometry import GBuffer, to_previous_camera
from models.history.reprojection import reproject
from models.networks.affinity import plain_level
from models.registry import create
from models.spec import load
from models.weights import save_weights
from provenance import file_digest
from tests.helpers.exports import check_page
from tests.helpers.frames import flat_frame, run
from tests.helpers.unfold import unfold_kernel

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


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Files of weights that make the windows' weights differ by much."""
    folder = tmp_path_factory.mktemp("weights")
    files = {}
    for name in STEPS:
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


def differences(step, frames, compute, ours: Denoiser):
    """Largest differences of each frame's radiance from ours."""
    with torch.no_grad():
        outputs = [outputs["radiance"] for _, outputs in play(step, frames, compute)]
    return [largest_difference(theirs, mine) for theirs, mine in zip(outputs, run(ours, frames), strict=True)]


def camera_of(cameras: Cameras):
    return cameras.K[0].float(), cameras.camera_to_world[0].float()


@pytest.mark.parametrize("warp", ["inside", "outside"])
@pytest.mark.parametrize("name", STEPS)
def test_a_step_is_our_denoiser(weights, name, warp):
    step = load_step(name, weights[name], torch.float32, warp)
    ours = load(name, weights[name], torch.float32)
    for size in (*SIZES, (13, 17), (2, 2), (1, 5), (1, 1), (130, 17)):
        assert max(differences(step, sequence(size, frames=5), step, ours)) < TOLERANCE


@each_kind
@pytest.mark.parametrize("warp", ["inside", "outside"])
def test_rendered_frames(tiny, weights, name, warp):
    step = load_step(name, weights[name], torch.float32, warp)
    ours = load(name, weights[name], torch.float32)
    for clip in Dataset(tiny).clips("test"):
        frames = [read_frame(clip, index, ours.reads) for index in range(4)]
        assert max(differences(step, frames, step, ours)) < TOLERANCE


@each_kind
def test_a_cut_starts_anew(weights, name):
    """So does another size. The first frame after it is the first frame of a sequence, exactly."""
    step = load_step(name, weights[name], torch.float32, "inside")
    shots = [*sequence((24, 32), 0, 3), *sequence((24, 32), 40, 3), *sequence((20, 30), 43, 2)]
    ours = load(name, weights[name], torch.float32)
    assert max(differences(step, shots, step, ours)) < TOLERANCE
    with torch.no_grad():
        played = [outputs for _, outputs in play(step, shots, step)]
        ((_, anew),) = play(step, [shots[3]], step)
    assert (played[3]["new_history"][:, LENGTH[name]] == 1).all()
    for name, tensor in anew.items():
        assert torch.equal(played[3][name], tensor)


@each_kind
def test_background_is_emission_and_nothing_gathers_from_it(weights, name):
    step = load_step(name, weights[name], torch.float32, "inside")
    frames = sequence((48, 64), frames=3)
    sky = frames[0].depth == 0
    assert 0 < sky.float().mean() < 1
    glowing = [replace(f, channels={**f.channels, "direct": torch.where(f.depth == 0, 1e4, f.direct)}) for f in frames]
    with torch.no_grad():
        output = next(play(step, glowing, step))[1]["radiance"]
    assert torch.equal(output[sky.expand_as(output)], frames[0].emission[sky.expand_as(output)])
    ours = load(name, weights[name], torch.float32)
    assert max(differences(step, glowing, step, ours)) < TOLERANCE


@each_kind
def test_nothing_but_sky_and_nothing_but_black(weights, name):
    step = load_step(name, weights[name], torch.float32, "inside")
    ours = load(name, weights[name], torch.float32)
    frame = flat_frame(20, 24)
    zero = torch.zeros(1, 1, 20, 24)
    sky = replace(frame, channels={**frame.channels, "depth": zero, "mesh_id": zero, "emission": frame.direct * 3})
    black = replace(frame, channels={**frame.channels, "direct": 0 * frame.direct})
    for frames in ([sky, frame, frame], [black, frame, black], [frame, sky, black]):
        assert max(differences(step, frames, step, ours)) < TOLERANCE


@each_kind
def test_what_is_not_finite_counts_as_nothing(weights, name):
    step = load_step(name, weights[name], torch.float32, "inside")
    ours = load(name, weights[name], torch.float32)
    frames = sequence((24, 32), frames=3)
    frames[1].direct[0, :, 5, 6] = torch.tensor([torch.nan, torch.inf, -torch.inf])
    frames[1].indirect[0, :, 5, 6] = 0
    frames[1].direct[0, :, 9, 3] = 6e4
    assert max(differences(step, frames, step, ours)) < TOLERANCE


def test_frames_of_more_samples(weights):
    """And of other numbers from frame to frame."""
    step = load_step("one", weights["one"], torch.float32, "inside")
    frames = [
        replace(frame, spp=torch.full((1, 1, 1, 1), samples))
        for frame, samples in zip(sequence((13, 17), frames=3), (4.0, 1.0, 16.0), strict=True)
    ]
    assert max(differences(step, frames, step, load("one", weights["one"], torch.float32))) < TOLERANCE


@settings(max_examples=40, deadline=None)
@given(height=st.integers(1, 9), width=st.integers(1, 9), step=st.integers(1, 12), seed=st.integers(0, 9999))
def test_neighbours_are_those_of_our_filter(height, width, step, seed):
    """Over backgrounds and meshes, with bright pixels and all that sharpness and importance may be."""
    torch.manual_seed(seed)
    size = (height, width)
    surface = (torch.rand(1, 1, *size) > 0.2).float()
    image = torch.exp(4 * torch.randn(1, 3, *size)) * surface
    said = torch.randn(1, 8, *size), torch.exp(3 * torch.randn(1, 1, *size)), *(20 * torch.rand(2, 1, 1, *size) - 10)
    filtered = affinity_level(image, *said, surface, step)
    torch.testing.assert_close(filtered, plain_level(image, *said, surface, step), rtol=1e-5, atol=0)
    mesh_id = torch.randint(0, 3, (1, 1, *size)).float()
    with compiled.disabled():
        expected = neighbours.mesh_sums(image, mesh_id, step)
    torch.testing.assert_close(mesh_sums(image, mesh_id + 1, step), expected, rtol=1e-5, atol=0)


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    dx=st.integers(-48, 48).map(lambda n: n / 16),
    dy=st.integers(-48, 48).map(lambda n: n / 16),
    seed=st.integers(0, 9999),
)
def test_taps_are_those_of_our_reprojection(height, width, dx, dy, seed):
    """On walls of a few meshes, where many pixels find nothing among 2 x 2 taps, or nothing at all."""
    torch.manual_seed(seed)
    meshes = [torch.randint(0, 4, (1, 1, height, width)) for _ in range(2)]
    frame = flat_frame(height, width, (dx, dy), mesh_id=meshes[0])
    surfaces = replace(GBuffer.of(frame), mesh_id=meshes[1].float())
    history = torch.rand(1, 4, height, width)
    expected, found = reproject(frame, history, surfaces)
    pixels = places(height, width)
    then = View(surfaces.depth, surfaces.normal, surfaces.mesh_id, *camera_of(frame.previous))
    now = View(frame.depth, frame.normal, frame.mesh_id.int(), *camera_of(frame.now))
    matrices = to_previous_camera(frame.now, frame.previous, 0).float()
    fetched = fetch(table_of(history, then, pixels), expectation(now, matrices, pixels), frame.motion, pixels)
    torch.testing.assert_close(fetched, expected, rtol=1e-5, atol=1e-5)
    assert not fetched[~found.expand_as(fetched)].any()


@pytest.mark.parametrize("spread", [1.0, 30.0, 1e4])
def test_windows_are_exact_for_any_logits(spread):
    """Against unfolding and softmax in float64, in which surfaces are left out by logits of -1e9."""
    torch.manual_seed(0)
    image = 10 * torch.rand(1, 3, 23, 31) ** 4
    importance = spread * torch.randn(1, len(WINDOWS), 23, 31)
    mixture = torch.randn_like(importance)
    surface = (torch.rand(1, 1, 23, 31) > 0.3).float()
    with torch.no_grad():
        output = BoxWindows(WINDOWS)(image, importance, mixture, surface)
    masked = torch.where(surface > 0, importance, -1e9).double()
    parts = [unfold_kernel(image.double(), masked[:, [i]], k) for i, k in enumerate(WINDOWS)]
    counts = [F.max_pool2d(surface, k, 1, k // 2) for k in WINDOWS]  # a window without any surface adds 0
    shares = torch.softmax(mixture.double(), dim=1)
    expected = sum(shares[:, [i]] * part * count for i, (part, count) in enumerate(zip(parts, counts, strict=True)))
    torch.testing.assert_close(output.double(), expected, rtol=1e-5, atol=1e-6)


def test_float16_in_the_network_alone(weights):
    """Images stay in float32: radiance may exceed what float16 holds, and histories do not suffer."""
    half = load_step("wskp3", weights["wskp3"], torch.float16, "inside")
    whole = load_step("wskp3", weights["wskp3"], torch.float32, "inside")
    frames = [replace(f, channels={**f.channels, "direct": f.direct * 1e5}) for f in sequence((40, 48), frames=6)]
    with torch.no_grad():
        pairs = zip(play(half, frames, half), play(whole, frames, whole), strict=True)
        for (_, a), (_, b) in pairs:
            assert torch.equal(a["new_history"], b["new_history"]) and torch.equal(a["new_scale"], b["new_scale"])
            assert largest_difference(a["radiance"], b["radiance"]) < HALF_TOLERANCE
            assert b["radiance"].max() > 65504


@pytest.fixture(scope="module", params=["wskp3", pytest.param("one", marks=pytest.mark.slow)])
def written(request, weights, tmp_path_factory):
    """A denoiser of each kind as ONNX, moving its history itself; the folder has its name."""
    name = request.param
    folder = tmp_path_factory.mktemp("export") / name
    write_export(Export(name, weights[name], "onnx", "float32", "inside"), sequence((40, 56), frames=3), folder)
    return folder


@onnx_only
def test_onnx_equals_ours_at_two_sizes(weights, written):
    name = written.name
    step = load_step(name, weights[name], torch.float32, "inside")
    ours = load(name, weights[name], torch.float32)
    compute = run_onnx(written / f"{name}.onnx")
    for size in SIZES:
        assert max(differences(step, sequence(size), compute, ours)) < TOLERANCE


@onnx_only
def test_the_manifest_tells_what_is_there(weights, written):
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
    for told, values in (("inputs", model.graph.input), ("outputs", model.graph.output)):
        shapes = {v.name: [d.dim_value or d.dim_param for d in v.type.tensor_type.shape.dim] for v in values}
        assert {port["name"]: port["shape"] for port in manifest[told]} == shapes
    names = {port["name"] for told in ("inputs", "outputs") for port in manifest[told]}
    assert {each["from"] for each in manifest["state"]} | {each["input"] for each in manifest["state"]} <= names


@onnx_only
def test_golden_frames_come_out_of_the_page_s_own_code(written):
    check_page(written, np.ascontiguousarray, TOLERANCE)


@onnx_only
@pytest.mark.slow
@pytest.mark.parametrize("name", STEPS)
def test_every_format_equals_ours(weights, tmp_path, name):
    """Both ways to warp, as ONNX and pt2; in float16, too."""
    ours = load(name, weights[name], torch.float32)
    for warp in ("inside", "outside"):
        step = load_step(name, weights[name], torch.float32, warp)
        program = trace(step, synthetic_frame(0, 24, 32))
        write_onnx(program, step, tmp_path / "step.onnx")
        write_pt2(program, tmp_path / "step.pt2")
        for compute in (run_onnx(tmp_path / "step.onnx"), run_pt2(tmp_path / "step.pt2")):
            for size in SIZES:
                assert max(differences(step, sequence(size), compute, ours)) < TOLERANCE
    if torch.float16 not in ours.refuses:
        half = load_step(name, weights[name], torch.float16, "outside")
        write_onnx(trace(half, synthetic_frame(0, 24, 32)), half, tmp_path / "half.onnx")
        assert max(differences(half, sequence(SIZES[1]), run_onnx(tmp_path / "half.onnx"), ours)) < HALF_TOLERANCE


@onnx_only
@pytest.mark.slow
def test_extreme_logits_take_the_careful_branch_in_files(weights, tmp_path):
    denoiser = load("wskp3", weights["wskp3"], torch.float32)
    with torch.no_grad():
        denoiser.network[-1].merged.weight[:6] *= 300
        if hasattr(denoiser.network[-1].merged, "pair"):
            denoiser.network[-1].merged.pair()
    step = STEPS["wskp3"](copy.deepcopy(denoiser), "outside")
    program = trace(step, synthetic_frame(0, 24, 32))
    write_onnx(program, step, tmp_path / "step.onnx")
    write_pt2(program, tmp_path / "step.pt2")
    for compute in (run_onnx(tmp_path / "step.onnx"), run_pt2(tmp_path / "step.pt2")):
        assert max(differences(step, sequence((40, 56), frames=3), compute, denoiser)) < 10 * TOLERANCE


def test_what_cannot_be_exported(weights, tmp_path, monkeypatch):
    frames = sequence((8, 8), frames=1)
    with pytest.raises(BadInput, match="'svgf' cannot be exported; wskp3, wskp6, one can"):
        write_export(Export("svgf", weights["wskp3"], "pt2", "float32", "inside"), frames, tmp_path / "out")
    with pytest.raises(BadInput, match="holds weights of 'wskp3', not of 'wskp6'"):
        write_export(Export("wskp6", weights["wskp3"], "pt2", "float32", "inside"), frames, tmp_path / "out")
    with pytest.raises(BadInput, match=r"One does not compute in torch\.float16"):
        write_export(Export("one", weights["one"], "pt2", "float16", "inside"), frames, tmp_path / "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("all of it")
    with pytest.raises(BadInput, match="holds something else"):
        write_export(Export("wskp3", weights["wskp3"], "pt2", "float32", "inside"), frames, tmp_path / "mine")
    monkeypatch.setattr(programs, "find_spec", lambda package: None if package == "onnxscript" else object())
    with pytest.raises(BadInput, match=r"needs onnxscript: pip install 'onespp\[export\]'"):
        write_export(Export("wskp3", weights["wskp3"], "onnx", "float32", "inside"), frames, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine"]
