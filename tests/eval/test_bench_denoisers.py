"""The bench of denoisers, in small, and the sequence it is measured on."""

import json

import numpy as np
import pytest
import torch
from eval.sizes import SIZES

import eval.bench.denoisers
from errors import BadInput
from eval.bench.denoisers import Variant, bench_denoisers, macs_per_pixel, parse_size, race, thread_counts, variants
from eval.bench.scaling import exponent, in_use
from eval.bench.synthetic_frames import synthetic_frame
from models.registry import create, inference_precision
from onespp import main
from provenance import device_in_words

KEYS = {
    *("denoiser", "height", "width", "dtype", "ms_median", "ms_p10", "ms_p90", "peak_mb"),
    *("parameters", "macs_per_pixel", "threads", "frames", "prediction"),
}


def test_results_have_the_agreed_form(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(eval.bench.denoisers, "REPEATS", 2)
    arguments = ["accumulated", "rae", "--size", "64x32", "--threads", "1", "--runs", str(tmp_path)]
    main(["bench", "denoisers", *arguments])
    table = capsys.readouterr().out
    assert "times oidn" in table and "reconstruction" in table and "accumulated (PyTorch)" in table
    results = json.loads((tmp_path / "bench" / "results.json").read_text())
    assert (results["schema"], results["device"], results["threads"]) == (1, device_in_words(threads=1), 1)
    rows = results["rows"]
    assert all(row.keys() == KEYS and (row["width"], row["height"]) == (64, 32) for row in rows)
    labels = [(row["denoiser"], row["dtype"]) for row in rows]
    ways = ("accumulated", "accumulated (PyTorch)", "accumulated (indirect)")
    assert labels[:3] == [(way, "float32") for way in ways]
    assert ("rae", "float32") in labels and ("rae", "bfloat16") in labels
    for row in rows:
        assert 0 < row["ms_p10"] <= row["ms_median"] <= row["ms_p90"]
        counts = {"rae": 1_951_935, "oidn": None, "oidn (fast)": None}  # the baseline comes by itself
        assert row["parameters"] == counts.get(row["denoiser"], 0)
        assert (row["macs_per_pixel"] is None) == (row["prediction"] is None) == (row["denoiser"] != "rae")
        assert row["prediction"] is None or 0 < row["prediction"] < 1
        assert row["frames"] == 2


def test_every_number_of_threads_has_its_rows(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(eval.bench.denoisers, "REPEATS", 1)
    monkeypatch.setattr(
        eval.bench.denoisers, "race", lambda ours, size: seen.append(torch.get_num_threads()) or race(ours, size)
    )
    monkeypatch.setattr(eval.bench.denoisers, "peaks", lambda entrants, size, threads: [None] * len(entrants))
    bench_denoisers(tmp_path, ["noisy"], ["8x8", "16x8"], threads=[2, 1])
    results = json.loads((tmp_path / "bench" / "results.json").read_text())
    noisy = [(row["width"], row["threads"]) for row in results["rows"] if row["denoiser"] == "noisy"]
    assert noisy == [(8, 1), (8, 2), (16, 1), (16, 2)] and seen == [1, 2, 1, 2]
    assert results["threads"] == 2  # that of the last rows of a size
    assert thread_counts(()) == sorted({1, torch.get_num_threads()})


def test_an_interrupted_bench_goes_on(tmp_path, monkeypatch):
    seen = []

    def racing(ours, size):
        seen.append((*size, torch.get_num_threads()))
        if len(seen) == 2:
            raise KeyboardInterrupt
        return race(ours, size)

    monkeypatch.setattr(eval.bench.denoisers, "REPEATS", 1)
    monkeypatch.setattr(eval.bench.denoisers, "race", racing)
    monkeypatch.setattr(eval.bench.denoisers, "peaks", lambda entrants, size, threads: [None] * len(entrants))
    with pytest.raises(KeyboardInterrupt):
        bench_denoisers(tmp_path, ["noisy"], ["8x4"], [1, 2])
    assert not (tmp_path / "bench" / "results.json").exists()
    bench_denoisers(tmp_path, ["noisy"], ["8x4"], [1, 2])
    assert seen == [(4, 8, 1), (4, 8, 2), (4, 8, 2)]
    bench_denoisers(tmp_path, ["noisy"], ["8x4"], [1, 2])  # a new measurement
    assert len(seen) == 5 and [file.name for file in (tmp_path / "bench").iterdir()] == ["results.json"]

    seen.clear()
    with pytest.raises(KeyboardInterrupt):
        bench_denoisers(tmp_path, ["noisy"], ["8x4"], [1, 2])
    bench_denoisers(tmp_path, ["noisy", "accumulated"], ["8x4"], [1])  # others: what is there is not theirs
    assert len(seen) == 3


def test_a_bench_that_takes_long_measures_fewer_frames(monkeypatch):
    monkeypatch.setattr(eval.bench.denoisers, "PATIENCE", 0)
    (contender,) = race([Variant("noisy", "noisy")], (4, 8))
    assert contender.timing((4, 8))["frames"] == eval.bench.denoisers.FEWEST < eval.bench.denoisers.REPEATS


def test_scaling(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(eval.bench.denoisers, "REPEATS", 1)
    main(["bench", "scaling", "noisy", "wskp3", "--size", "32x32", "16x16", "--threads", "1", "--runs", str(tmp_path)])
    assert "16x16" in capsys.readouterr().out
    rows = json.loads((tmp_path / "bench" / "scaling.json").read_text())["rows"]
    names = ["noisy", "wskp3", *([] if eval.bench.denoisers.unavailable("oidn") else ["oidn", "oidn (fast)"])]
    assert [(row["denoiser"], row["width"]) for row in rows] == [(name, w) for w in (16, 32) for name in names]
    used = str(inference_precision(create("wskp3"))).removeprefix("torch.")
    assert [row["dtype"] for row in rows if row["denoiser"] == "wskp3"] == [used, used]
    assert (tmp_path / "report" / "figures" / "scaling.png").exists()


def test_exponent_of_known_laws():
    pixels = [100, 400, 900, 1600]
    assert exponent(pixels, [3.0 * n for n in pixels]) == pytest.approx(1)
    assert exponent(pixels, [0.1 * n**1.5 for n in pixels]) == pytest.approx(1.5)
    assert exponent(pixels[:1], [1.0]) is None


def test_networks_of_other_sizes_are_measured_too():
    names = {variant.name for variant in variants(())}
    assert {"wskp6-1w", "wskp6-5w"} <= names and "wskp6-6w" not in names  # that is wskp6
    assert macs_per_pixel(Variant("wskp6-1w", "wskp6-1w")) < macs_per_pixel(Variant("wskp6", "wskp6"))
    assert not any(variant.name in SIZES for variant in in_use(()))
    assert not [v for v in variants(["svgf"], "cuda") if not v.compiled]


def test_multiply_accumulates_by_hand():
    """RAE's 36 convolutions of 3 x 3: inputs times outputs times 9 at each resolution."""
    encoder, decoder = (32, 32, 43, 57, 76, 101, 101), ((76, 76), (57, 57), (43, 43), (32, 32), (128, 64))
    widths = encoder[1:]
    products = 7 * 32 + 64 * 3  # the first and the last layer
    for level, (before, width) in enumerate(zip(encoder, widths, strict=False)):
        products += (before * width + 4 * width * width) / 4**level
    below = widths[-1]
    for level, (middle, out) in zip(range(4, -1, -1), decoder, strict=True):
        products += ((below + widths[level]) * middle + middle * out) / 4**level
        below = out
    assert macs_per_pixel(Variant("rae", "rae")) == pytest.approx(9 * products)
    assert macs_per_pixel(Variant("noisy", "noisy")) is None


def test_repvgg_is_counted_as_it_runs():
    """One 5 x 5 convolution a block, not its branches; and parameters of both forms are reported."""
    denoiser = Variant("wskp6", "wskp6").build()
    trained = denoiser.parameter_count()
    denoiser.prepare()
    layers = [m for m in denoiser.network.modules() if isinstance(m, torch.nn.Conv2d)]
    assert denoiser.parameter_count() < trained
    expected = sum(m.in_channels * m.out_channels * 25 for m in layers)
    assert macs_per_pixel(Variant("wskp6", "wskp6", "bfloat16")) == expected


def test_what_is_measured(monkeypatch, capsys):
    monkeypatch.setattr(eval.bench.denoisers, "unavailable", lambda name: "gone fishing" if name == "oidn" else None)
    assert "oidn" not in {variant.name for variant in variants(())}
    assert "oidn: skipped, gone fishing" in capsys.readouterr().out
    with pytest.raises(BadInput, match="gone fishing"):
        variants(["oidn"])
    monkeypatch.undo()
    if not eval.bench.denoisers.unavailable("oidn"):
        assert [v.label for v in variants(["oidn"])] == ["oidn", "oidn (fast)"]
    for text in ("720p", "0x5", "5x", "-1x3"):
        with pytest.raises(BadInput, match="not a size"):
            bench_denoisers(None, ["noisy"], [text])
    with pytest.raises(BadInput, match="at least 1"):
        bench_denoisers(None, ["noisy"], ["4x4"], threads=[0])
    assert parse_size("1280x720") == (720, 1280)


def test_synthetic_frames_are_reproducible():
    a, b, other = synthetic_frame(3, 36, 64), synthetic_frame(3, 36, 64), synthetic_frame(4, 36, 64)
    assert all(torch.equal(a.channels[name], b.channels[name]) for name in a.channels)
    assert not torch.equal(a.direct, other.direct)


def test_synthetic_frames_look_like_rendered_ones():
    """Several meshes and sky; noise that is mostly black and spiked; motion that finds its surface again."""
    before, frame = synthetic_frame(9, 90, 160), synthetic_frame(10, 90, 160)
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

    traditional, dual = same_mesh(frame.motion), same_mesh(frame.dual_motion)
    assert traditional[~hidden].mean() > 0.98 and traditional[hidden].mean() < 0.2
    assert dual[hidden].mean() > 0.8  # they lead beside what covered the surface
    assert (synthetic_frame(0, 9, 16).motion == 0).all()
