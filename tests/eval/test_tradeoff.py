"""The trade: fronts by brute force, averaged and rendered samples, and one small run from end to end."""

import math
import re
import shutil

import numpy as np
import pytest
import torch

import eval.tradeoff.run
from datasets.clip import Clip, Dataset
from datasets.frame import read_frame
from errors import BadInput
from eval.bench.denoisers import timed_with
from eval.harness import clips_of_one_spp
from eval.metrics import METRICS
from eval.report.page import trade_plots
from eval.results import NOISE_FLOOR, ClipResults, Result
from eval.tables import ClipScores
from eval.tradeoff.run import (
    candidates,
    check_levels,
    draw_samples,
    results_by_spp,
    tables,
    trade,
    with_more_samples,
)
from eval.tradeoff.samples import fit_cost, rendered, sample_cost, scene_of, with_samples
from eval.tradeoff.trades import Times, Trade, dominated_by_name, trades
from files import locked, read_json, write_json
from models.spec import DenoiserSpec
from provenance import device_in_words
from render.clip import NO_OPTIONS
from tests.eval.conftest import bench_of, untrained

SIZE = (32, 48)


def a_clip(tiny) -> Clip:
    return Dataset(tiny).clips("test")[1]


# --- Fronts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("metric, sign", [("psnr", 1), ("rmse", -1)])
def test_fronts_by_brute_force(metric, sign):
    rng = np.random.default_rng(0)
    ms = rng.integers(1, 9, 40)  # with ties
    values = rng.integers(20, 30, 40)
    points = {str(i): (float(a), float(b)) for i, (a, b) in enumerate(zip(ms, values, strict=True))}
    found = dominated_by_name(points | {"untimed": (None, 0.0), "undefined": (0.0, None)}, metric)
    assert not {"untimed", "undefined"} & found.keys() and None in found.values() and len(set(found.values())) > 1
    for i, (a, b) in enumerate(zip(ms, values, strict=True)):
        better = {
            str(j)
            for j in range(40)
            if ms[j] <= a and sign * values[j] >= sign * b and (ms[j] < a or sign * values[j] > sign * b)
        }
        assert (found[str(i)] is None) == (not better)
        assert found[str(i)] is None or found[str(i)] in better


def test_digits_that_are_not_shown_do_not_make_a_front():
    shown = [ClipScores([{"psnr": psnr}], [{"psnr": 99.0}]).compared("psnr") for psnr in (30.001, 30.004, 30.011)]
    assert shown == [30.0, 30.0, 30.01]


def test_values_within_the_noise_floor_are_equal():
    floor = [{"psnr": 40.0}]
    shown = [ClipScores([{"psnr": psnr}], floor).compared("psnr") for psnr in (30.0, 36.0, 38.0, 41.0)]
    assert shown == [30, 36, 36.99, 36.99]
    assert ClipScores([{"mse_unbiased": -1e-9}], [{"mse_unbiased": 1e-6}]).compared("mse_unbiased") == 2e-6
    assert ClipScores([{"ssim": None}], floor).compared("ssim") is None


def test_a_hard_clips_floor_hides_no_error_of_another():
    """Within the mean of the floors, 0.55, by far; but on the second clip 0.8 and 0.95 are apart."""
    floors = [{"ssim": 0.1, "mse_unbiased": 1e-6}, {"ssim": 1.0, "mse_unbiased": 1e-6}]
    a, b = ([{"ssim": 0.3, "mse_unbiased": 0.0}, {"ssim": s, "mse_unbiased": 0.0}] for s in (0.8, 0.95))
    assert ClipScores(a, floors).joint_floor == {"ssim": None, "mse_unbiased": pytest.approx(1e-6 / math.sqrt(2))}
    assert ClipScores(a, floors).compared("ssim") < ClipScores(b, floors).compared("ssim")
    both = [{"ssim": 0.1, "mse_unbiased": 1e-6}] * 2
    assert ClipScores(a, both).joint_floor["ssim"] == pytest.approx(0.1)


def clip_results(**psnr: float) -> ClipResults:
    """Results of total light on a clip, by denoiser."""

    def result(name: str, value: float) -> Result:
        metrics = dict.fromkeys(METRICS) | {"psnr": value, "mse_unbiased": 0.0}
        return Result("", name, "total", "cornell_box", "000", metrics, [])

    results = [result(*pair) for pair in psnr.items()]
    return ClipResults("cornell_box", "000", "total", results, result(NOISE_FLOOR, 99.0))


def test_samples_can_cost_more_than_they_gain(tmp_path):
    bench_of(tmp_path, {"noisy": 0.5, "rae": 4.5}, SIZE, threads=(1,))
    fed = {1: [clip_results(noisy=20.0, rae=30.0)], 4: [clip_results(noisy=26.0, rae=29.0)]}
    specs = [DenoiserSpec.named(name) for name in ("noisy", "rae")]
    rows = trades(specs, fed, {1: 0.5, 4: 8.5}, Times(tmp_path, SIZE))
    assert [row.name for row in rows] == ["noisy, 1 spp", "rae, 1 spp", "noisy, 4 spp", "rae, 4 spp"]
    assert [row.ms for row in rows] == [1.0, 5.0, 9.0, 13.0]
    assert [row.dominated_by["psnr"] for row in rows] == [None, None, "rae, 1 spp", "rae, 1 spp"]
    assert [row.metrics["psnr"] for row in rows] == [20, 30, 26, 29]


def test_two_trainings_of_a_network_are_two_points(tmp_path):
    bench_of(tmp_path, {"noisy": 1.0, "rae": 2.0}, SIZE, threads=(1,))
    (plot,) = trade_plots(Times(tmp_path, SIZE), [clip_results(**{"noisy": 20.0, "rae": 30.0, "rae@tiny": 28.0})])
    points = {point["name"]: (point["ms"], point["quality"], point["by"]) for point in plot["points"]}
    assert points == {"noisy": (1.0, 20.0, None), "rae": (2.0, 30.0, None), "rae@tiny": (2.0, 28.0, "rae")}
    assert plot["metric"] == "psnr" and plot["missing"] == []


# --- Samples ----------------------------------------------------------------------------------------------------------


def test_only_the_noisy_input_differs(tiny, tmp_path):
    clip = a_clip(tiny)
    four = with_samples(clip, Dataset(tiny), 4, tmp_path)
    assert (four.scene, four.name) == (clip.scene, "000-4spp")
    assert np.array_equal(four.reference(3), clip.reference(3)) and four.exposure == clip.exposure
    channels = [name for name in clip.channels if name not in ("direct", "indirect", "direct_reference")]
    ours, theirs = (read_frame(c, 3, [n for n in channels if n != "indirect_reference"]) for c in (four, clip))
    assert all(np.array_equal(ours.channels[name], theirs.channels[name]) for name in theirs.channels)
    assert not np.array_equal(four.read("direct", 3), clip.read("direct", 3))
    assert with_samples(clip, Dataset(tiny), 1, tmp_path) is clip


def test_with_the_clips_own_samples_its_bytes_are_reproduced(tiny):
    """So scene, frames and seed are right."""
    clip = a_clip(tiny)
    frames = list(rendered(clip, Dataset(tiny), 1, False))
    for frame in (0, clip.frames - 1):
        stored = frames[frame]["indirect"].astype(np.float16)
        assert np.array_equal(stored, clip.read("indirect", frame).astype(np.float16))


def test_clips_are_reused_until_their_source_changes(tiny, tmp_path):
    copy = shutil.copytree(tiny, tmp_path / "data")
    dataset = Dataset(copy)
    clip = a_clip(copy)
    path = with_samples(clip, dataset, 2, tmp_path / "more").path
    kept = (path / "direct.npy").stat().st_mtime_ns
    with_samples(clip, dataset, 2, tmp_path / "more")
    assert (path / "direct.npy").stat().st_mtime_ns == kept
    (path / "clip.json").unlink()  # killed before it was whole
    with_samples(clip, dataset, 2, tmp_path / "more")
    again = (path / "direct.npy").stat().st_mtime_ns
    assert again != kept
    write_json(clip.path / "clip.json", clip.facts | {"exposure": 2 * clip.exposure})
    changed = with_samples(Clip(clip.path), dataset, 2, tmp_path / "more")
    assert changed.exposure == 2 * clip.exposure and (path / "direct.npy").stat().st_mtime_ns != again


def test_impossible_numbers_of_samples(tiny, tmp_path):
    clip = a_clip(tiny)
    dataset = Dataset(tiny)
    four = with_samples(clip, dataset, 4, tmp_path)
    dataset.facts["options"] = {"halton": True, "regularise": False}
    with pytest.raises(BadInput, match="16 different samples a pixel: 32 are too many"):
        with_samples(clip, dataset, 32, tmp_path)
    with pytest.raises(BadInput, match="has 4 samples a pixel: 6 are no multiple"):
        with_samples(four, dataset, 6, tmp_path)
    dataset.facts["generator"] = 0
    with pytest.raises(BadInput, match=r"another version.*onespp dataset"):
        scene_of(clip, dataset)
    for levels in ((), (0, 1), (2, 1), (4, 4)):
        with pytest.raises(BadInput, match="rising numbers"):
            check_levels(levels)


def test_cost_of_samples(tiny):
    cost = fit_cost([1, 2, 4, 8], [3 + 2 * spp for spp in (1, 2, 4, 8)])
    assert cost == pytest.approx((3, 2)) and cost.of(100) == pytest.approx(203)
    measured = sample_cost(scene_of(a_clip(tiny), Dataset(tiny))[0], 48, 64, threads=1, options=NO_OPTIONS)
    assert measured.sample_ms > 0 and measured.frame_ms >= 0


# --- Candidates -------------------------------------------------------------------------------------------------------


def test_untrained_networks_are_refused_with_a_remedy(tmp_path, capsys, shipped):
    with pytest.raises(BadInput, match=r"rae: it has no weights.*`onespp train rae --budget tiny --runs"):
        candidates(["rae"], tmp_path, "tiny")
    assert [candidate.label for candidate in candidates(["svgf"], tmp_path, "tiny")] == ["svgf"]  # no baseline, no ways
    labels = {candidate.label for candidate in candidates([], tmp_path, "tiny")}
    assert {"noisy", "svgf"} <= labels and "rae" not in labels
    assert re.search(r"\bwskp3\b.*: skipped, it has no weights", capsys.readouterr().out)


def test_times_come_from_the_bench(tmp_path):
    with pytest.raises(BadInput, match=r"no times at .*`onespp bench denoisers --size 48x32 --runs"):
        Times(tmp_path, SIZE)
    bench_of(tmp_path, {"noisy": 1.0, "rae": 2.0}, SIZE)
    rae = DenoiserSpec.named("rae", precision="bfloat16")
    assert [Times(tmp_path, SIZE, threads=n).of(rae) for n in (None, 1)] == [1.0, 2.0]
    assert Times(tmp_path, SIZE).of(DenoiserSpec.named("kp")) is None
    assert Times(tmp_path, SIZE).of(DenoiserSpec.named("noisy", signal="indirect")) is None  # of total light alone
    with pytest.raises(BadInput, match=r"results-cuda.json"):
        Times(tmp_path, SIZE, device="cuda")
    with pytest.raises(BadInput, match=r"no times of 48x32 with 3 threads.*noisy rae --size 48x32 --threads 1 2 3"):
        Times(tmp_path, SIZE, threads=3)


def test_the_remedy_for_missing_times_measures_all_in_one_run(tmp_path):
    """Since a run of the bench replaces the results of the last one, and only times of one run compare."""
    bench_of(tmp_path, {"noisy": 1.0, "noisy (indirect)": 1.0, "rae": 2.0}, SIZE)
    times = Times(tmp_path, SIZE)
    specs = [DenoiserSpec.named(name) for name in ("noisy", "svgf+js")]
    rows = trades(specs, {1: [clip_results(**{"noisy": 20.0, "svgf+js": 25.0})]}, {1: 0.0}, times)
    command = f"onespp bench denoisers noisy rae svgf+js --size 48x32 --threads 1 2 --runs {tmp_path} --all"
    assert f"Without a time: svgf+js. Measure all with `{command}`." in tables(rows, rows, "title", times)


def test_times_of_another_device_are_refused(tiny, tmp_path):
    bench_of(tmp_path, {"noisy": 1.0}, SIZE)
    Times(tmp_path, SIZE).check_device()
    path = tmp_path / "bench" / "results.json"
    write_json(path, read_json(path) | {"device": "cpu, another, 2 threads"})
    with pytest.raises(BadInput, match=r"results.json has times of cpu, another.*`onespp bench denoisers noisy --size"):
        trade(tiny, tmp_path, "tiny", (1,), ("noisy",), "48x32")


def test_times_of_other_code_are_named(tmp_path):
    bench_of(tmp_path, {"noisy": 1.0}, SIZE)
    assert Times(tmp_path, SIZE).warnings == []  # unknown
    path = tmp_path / "bench" / "results.json"
    for code in (timed_with()["code"], "other"):
        write_json(path, read_json(path) | {"made_by": timed_with() | {"code": code}})
        printed = tables([], [], "title", Times(tmp_path, SIZE))
        assert ("times of other code or packages: measure again with `onespp bench" in printed) == (code == "other")


def test_networks_are_fed_in_the_precision_that_is_timed(monkeypatch):
    monkeypatch.setattr(eval.tradeoff.run, "RENDERER", "cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    for precision in ("float32", "bfloat16"):
        monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda p=precision, **_: p == "bfloat16")
        specs = [DenoiserSpec.named("wskp6", precision=each) for each in ("float32", "bfloat16", "float16")]
        assert [spec.precision for spec in with_more_samples(specs, True)] == [precision]


# --- From end to end --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def traded(tiny, tmp_path_factory):
    """The results of a trade of a few filters and an untrained wskp6, what it printed, and the names of its figures."""
    runs = tmp_path_factory.mktemp("runs")
    untrained(runs, "wskp6")
    bench_of(runs, {"noisy": 1.0, "accumulated": 2.0, "svgf": 3.0, "wskp6": 4.0, "svgf+js": 5.0}, SIZE)
    text = trade(tiny, runs, "tiny", (1, 4), ("noisy", "accumulated", "svgf", "svgf+js", "wskp6@tiny"), "48x32")
    return read_json(runs / "report" / "trade.json"), text, [path.name for path in (runs / "report/figures").iterdir()]


@pytest.mark.slow
def test_trade_has_every_precision(traded):
    content, text, figures = traded
    assert (content["size"], content["threads"], len(content["clips"])) == ("48x32", 2, 2)
    assert content["device"] == device_in_words(threads=2)  # that of the times
    rows = {row["label"]: row for row in content["rows"]}
    assert {"noisy", "wskp6@tiny", "wskp6@tiny-bfloat16", "wskp6@tiny-float16"} <= rows.keys()
    assert rows["wskp6@tiny"]["ms"] == rows["wskp6@tiny-float16"]["ms"] == 2.0
    exact, rounded = (rows[f"wskp6@tiny{ending}"]["metrics"]["psnr"] for ending in ("", "-bfloat16"))
    assert exact != rounded == pytest.approx(exact, abs=0.1)  # evaluated in its precision
    assert rows["noisy"]["dominated_by"]["psnr"] is None  # the fastest
    assert "dominated in PSNR by" in text
    assert figures == ["trade-samples.png"]


@pytest.mark.slow
def test_more_samples_cost_more_and_gain_quality(traded):
    content, *_ = traded
    rows = {(row["denoiser"], row["spp"]): row for row in content["samples"]}
    assert content["render_ms"].keys() == {"cornell_box/000", "cornell_box_moving/000"}
    for name in ("noisy", "accumulated", "svgf"):
        one = rows[name, 1]
        four = rows[name, 4]
        assert four["metrics"]["psnr"] > one["metrics"]["psnr"] and four["render_ms"] >= one["render_ms"]
        assert four["ms"] == pytest.approx(four["render_ms"] + four["filter_ms"])
    quality = {row["label"]: row["metrics"]["psnr"] for row in content["rows"]}
    assert rows["noisy", 1]["metrics"]["psnr"] == quality["noisy"]  # 1 spp is the clip itself
    assert all(math.isfinite(row["metrics"]["psnr"]) for row in content["samples"])


@pytest.mark.slow
def test_the_plot_of_samples(traded):
    rows = [Trade(**row) for row in traded[0]["samples"]]
    left, right = draw_samples(rows, "title").axes
    labels = [line.get_label() for line in left.lines]
    assert set(labels) == {row.label for row in rows}
    for label, by_spp, by_ms in zip(labels, left.lines, right.lines, strict=True):
        ours = [row for row in rows if row.label == label]
        assert by_spp.get_xydata().tolist() == [[row.spp, row.metrics["psnr"]] for row in ours]
        assert by_ms.get_xydata().tolist() == [[row.ms, row.metrics["psnr"]] for row in ours]


def test_a_second_trade_at_once_is_refused(tiny, tmp_path):
    with locked(tmp_path / ".lock"), pytest.raises(BadInput, match="another process is writing"):
        results_by_spp([], [], Dataset(tiny), (1,), tmp_path)


def test_clips_of_more_samples_are_left_out(tiny, tmp_path):
    copy = shutil.copytree(tiny, tmp_path / "data")
    paths = sorted((copy / "test").glob("*/*/clip.json"))
    write_json(paths[0], read_json(paths[0]) | {"noisy_spp": 4})
    assert [clip.path for clip in clips_of_one_spp(Dataset(copy))] == [path.parent for path in paths[1:]]
    write_json(paths[1], read_json(paths[1]) | {"noisy_spp": 4})
    with pytest.raises(BadInput, match="no test clips of 1 spp"):
        clips_of_one_spp(Dataset(copy))
