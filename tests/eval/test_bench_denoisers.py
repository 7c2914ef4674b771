"""The bench of denoisers, in small, and the sequence it is measured on."""

import json
from dataclasses import asdict
from itertools import chain

import numpy as np
import pytest
import torch

import eval.bench.denoisers
from command_line import main
from errors import BadInput
from eval.bench.denoisers import (
    FEWEST_FRAMES,
    TIMED_FRAMES,
    bench_denoisers,
    cost,
    denoiser_peak_mb,
    is_usual,
    macs_per_pixel,
    measure_rows,
    other_ways,
    parse_size,
    size_name,
    thread_counts,
    time_in_turns,
    timed_specs,
    timed_with,
)
from eval.bench.memory import alone
from eval.bench.synthetic_frames import synthetic_frame
from eval.harness import compile_kernels
from eval.selection import cannot_run
from models import compiled
from models.compiled.one import HEAD_CHANNELS, INPUT_CHANNELS
from models.networks.one import One
from models.registry import DENOISERS, create, parse_name, prototype
from models.spec import DenoiserSpec, fastest_precision
from provenance import device_in_words

FIELDS = "denoiser height width dtype threads frames ms_median ms_p10 ms_p90 peak_mb parameters macs_per_pixel"
NOISY = DenoiserSpec.named("noisy")


def test_results_have_the_agreed_form(tmp_path):
    table = bench_denoisers(tmp_path, ["accumulated", "rae"], ["64x32"], threads=[1], measured=2, every_way=True)
    assert "times oidn" in table and "accumulated (PyTorch)" in table
    (path,) = (tmp_path / "bench").iterdir()  # nothing is left of what keeps unfinished races
    results = json.loads(path.read_text())
    assert path.name == "results.json"
    assert (results["schema"], results["device"], results["threads"]) == (1, device_in_words(threads=1), 1)
    assert results["made_by"] == timed_with()
    rows = results["rows"]
    assert all([*row] == FIELDS.split() and (row["width"], row["height"]) == (64, 32) for row in rows)
    usual = fastest_precision("rae")
    oidn = [] if cannot_run(parse_name("oidn")) else [("oidn", "float32")]  # the baseline
    labels = [(row["denoiser"], row["dtype"]) for row in rows]
    others = [("rae", precision) for precision in ("float32", "bfloat16", "float16") if precision != usual]
    expected = [("accumulated", "float32"), ("rae", usual), *oidn, ("accumulated (PyTorch)", "float32"), *others]
    assert labels == expected
    assert [row["peak_mb"] is None for row in rows] == [False] * (2 + len(oidn)) + [True] * 3
    for row in rows:
        assert 0 < row["ms_p10"] <= row["ms_median"] <= row["ms_p90"]
        counts = {"rae": 1_951_935, "oidn": None}
        assert row["parameters"] == counts.get(row["denoiser"], 0)
        assert (row["macs_per_pixel"] is None) == (row["denoiser"] != "rae")
        assert row["frames"] == 2


@pytest.mark.slow
def test_the_head_of_results_is_of_the_most_threads(tmp_path, capsys):
    sizes_and_threads = ["--size", "8x4", "16x8", "--threads", "2", "1"]
    main(["bench", "denoisers", "noisy", "ntd", *sizes_and_threads, "--runs", str(tmp_path)])
    assert "noisy (indirect)" in capsys.readouterr().out
    results = json.loads((tmp_path / "bench" / "results.json").read_text())
    assert results["threads"] == 2 and results["device"] == device_in_words(threads=2)
    noisy = [(row["width"], row["threads"]) for row in results["rows"] if row["denoiser"] == "noisy"]
    assert noisy == [(8, 1), (8, 2), (16, 1), (16, 2)]


@pytest.mark.slow
def test_an_interrupted_bench_resumes(tmp_path):
    unfinished = tmp_path / "unfinished.json"

    def races(*specs, measured=1):
        return measure_rows(specs, [(4, 8)], [1, 2], unfinished, measured)

    first = next(races(NOISY))  # and no further
    again = list(races(NOISY))
    assert again[0] == first  # to the last digit of its times: it was not measured again
    assert list(races(NOISY)) == again

    others = races(NOISY, DenoiserSpec.named("accumulated"))  # what is there is not theirs
    assert next(others)[0] != first[0]
    assert {row.denoiser for row in chain.from_iterable(races(NOISY))} == {"noisy"}
    assert all(row.frames == 2 for row in chain.from_iterable(races(NOISY, measured=2)))


def test_only_the_same_call_resumes_a_bench(tmp_path):
    unfinished = tmp_path / "bench" / "unfinished-results.json"
    unfinished.parent.mkdir()
    first = next(measure_rows(timed_specs(["noisy"]), [(4, 8)], [1, 2], unfinished, measured=1))
    bench_denoisers(tmp_path, ["noisy"], ["8x4"], [1, 2], measured=1)
    rows = json.loads((tmp_path / "bench" / "results.json").read_text())["rows"]
    assert [row for row in rows if row["threads"] == 1] == [asdict(row) for row in first]
    assert not unfinished.exists()  # the next one measures anew


def test_oidn_has_no_parameters_to_count():
    if cannot_run(parse_name("oidn")):
        pytest.skip("there is no OIDN here")
    (timed,) = time_in_turns([DenoiserSpec.named("oidn+taa")], (8, 8), measured=1)
    row = cost(timed, (8, 8), 1.0)
    assert (row.peak_mb, row.parameters, row.macs_per_pixel) == (1.0, None, None)


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_one_denoises_3840_x_2160_in_four_gigabytes(precision):
    frames = [synthetic_frame(index, 2160, 3840) for index in range(2)]
    peak = alone(denoiser_peak_mb, DenoiserSpec.named("one", precision=precision), frames, 2)
    assert peak is not None
    assert peak < 4000


def test_slow_denoisers_are_timed_on_fewer_frames():
    (timed,) = time_in_turns([NOISY], (4, 8), max_seconds=0)
    assert len(timed.seconds) == FEWEST_FRAMES < TIMED_FRAMES


def test_times_do_not_depend_on_weights():
    assert timed_specs(["kp@quick", "kp"]) == timed_specs(["kp"]) and all(map(is_usual, timed_specs(["kp", "svgf"])))
    assert other_ways(DenoiserSpec.named("svgf", device="cuda")) == []


@pytest.mark.parametrize("name", [name for name, kind in DENOISERS.items() if not kind.offline])
def test_denoisers_declare_whether_they_have_kernels(name, monkeypatch):
    calls = []
    monkeypatch.setattr(compiled, "match_threads", lambda: calls.append(name))
    if cannot_run(parse_name(name)):
        pytest.skip(f"{name} cannot run here")
    # In bfloat16 those run kernels that C computes in float32.
    precision = "bfloat16" if prototype(name).c_digest() else "float32"
    compile_kernels(DenoiserSpec.named(name, precision=precision))
    assert bool(calls) == DENOISERS[name].has_kernels


def test_multiply_accumulates_by_hand():
    """RAE's 36 convolutions of 3 x 3: inputs times outputs times 9 at each resolution."""
    encoder = (32, 32, 43, 57, 76, 101, 101)
    decoder = ((76, 76), (57, 57), (43, 43), (32, 32), (128, 64))
    widths = encoder[1:]
    products = 7 * 32 + 64 * 3  # the first and the last layer
    for level, (before, width) in enumerate(zip(encoder, widths, strict=False)):
        products += (before * width + 4 * width * width) / 4**level
    below = widths[-1]
    for level, (middle, out) in zip(range(4, -1, -1), decoder, strict=True):
        products += ((below + widths[level]) * middle + middle * out) / 4**level
        below = out
    assert macs_per_pixel(DenoiserSpec.named("rae")) == pytest.approx(9 * products)
    assert macs_per_pixel(DenoiserSpec.named("noisy")) is None


def test_repvgg_is_counted_as_it_runs():
    """One 5 x 5 convolution a block, not its branches; and parameters of both forms are reported."""
    denoiser = create("wskp6")
    trained = denoiser.parameter_count()
    denoiser.prepare()
    layers = [layer for layer in denoiser.network.modules() if isinstance(layer, torch.nn.Conv2d)]
    assert denoiser.parameter_count() < trained
    expected = sum(layer.in_channels * layer.out_channels * 25 for layer in layers)
    assert macs_per_pixel(DenoiserSpec.named("wskp6", precision="bfloat16")) == expected


def test_rows_by_default_and_on_request(monkeypatch, capsys):
    gone = "it is not installed"
    monkeypatch.setattr(eval.bench.denoisers, "cannot_run", lambda name: gone if str(name) == "oidn" else None)
    assert "oidn" not in {spec.name for spec in timed_specs(())}
    assert f"oidn: skipped, {gone}" in capsys.readouterr().out
    assert "oidn" not in {spec.name for spec in timed_specs(["noisy"])}
    with pytest.raises(BadInput, match=gone):
        timed_specs(["oidn"])
    monkeypatch.undo()
    if not cannot_run(parse_name("oidn")):
        assert [spec.way for spec in timed_specs(["oidn"])] == ["oidn"]


def test_oidn_is_not_timed_on_a_gpu(monkeypatch):
    """It computes on the CPU: a ratio to it would compare two devices."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(eval.bench.denoisers, "cannot_run", lambda name: None)
    assert [spec.name for spec in timed_specs(["oidn-fast+taa", "noisy"], "cuda")] == ["noisy"]


def test_invalid_sizes_and_threads(tmp_path):
    for text in ("720p", "0x5", "5x", "-1x3"):
        with pytest.raises(BadInput, match="not a size"):
            bench_denoisers(tmp_path, ["noisy"], [text])
    with pytest.raises(BadInput, match="at least 1"):
        bench_denoisers(tmp_path, ["noisy"], ["4x4"], threads=[0])
    assert thread_counts(()) == [torch.get_num_threads()]
    assert parse_size("1280x720") == (720, 1280)
    assert size_name((720, 1280)) == "1280x720"


def test_synthetic_frames_are_reproducible():
    a = synthetic_frame(3, 36, 64)
    b = synthetic_frame(3, 36, 64)
    other = synthetic_frame(4, 36, 64)
    assert all(torch.equal(a.channels[name], b.channels[name]) for name in a.channels)
    assert not torch.equal(a.direct, other.direct)


def test_synthetic_frames_resemble_rendered_ones():
    """Several meshes and sky; noise that is mostly black and spiked; motion that finds its surface again."""
    before = synthetic_frame(9, 90, 160)
    frame = synthetic_frame(10, 90, 160)
    assert all(torch.isfinite(tensor).all() for tensor in frame.channels.values())
    assert 8 < len(frame.mesh_id.unique()) < 20 and (frame.mesh_id == 0).any()
    reflected = frame.direct + frame.indirect
    hit = frame.mesh_id > 0
    assert 0.3 < (reflected.sum(1, keepdim=True)[hit] == 0).float().mean() < 0.6
    assert reflected.max() > 20 * reflected.mean() and (reflected[~hit.expand_as(reflected)] == 0).all()
    np.testing.assert_allclose(frame.normal.norm(dim=1, keepdim=True)[hit], 1, atol=1e-5)

    hidden = (frame.dual_motion - frame.motion).abs().amax(dim=1)[0] > 1 / 64
    assert 0.002 < hidden.float().mean() < 0.05

    def same_mesh(motion: torch.Tensor) -> torch.Tensor:
        """Whether the previous frame shows the same mesh where the vectors (1, 2, H, W) lead, to the nearest pixel."""
        x, y = motion[0] + torch.stack(torch.meshgrid(torch.arange(160), torch.arange(90), indexing="xy"))
        there = before.mesh_id[0, 0][y.round().long().clamp(0, 89), x.round().long().clamp(0, 159)]
        return (there == frame.mesh_id[0, 0]).float()

    traditional = same_mesh(frame.motion)
    dual = same_mesh(frame.dual_motion)
    assert traditional[~hidden].mean() > 0.98 and traditional[hidden].mean() < 0.2
    assert dual[hidden].mean() > 0.8  # they lead beside what covered the surface
    assert (synthetic_frame(0, 9, 16).motion == 0).all()


def test_transposed_convolutions_count_their_inputs():
    """By hand for `one`: each layer's weights, at the resolution at which they are applied."""
    a, b, c = One.widths
    inputs = sum(INPUT_CHANNELS.values())
    outputs = sum(HEAD_CHANNELS.values())
    half = 4 * inputs * a + (1 + 9) * a * a + 4 * a * outputs
    quarter = 4 * a * b + 2 * 9 * b * b + 4 * b * a
    eighth = 4 * b * c + 2 * 9 * c * c + 4 * c * b
    assert macs_per_pixel(DenoiserSpec.named("one")) == half / 4 + quarter / 16 + eighth / 64
