"""Evaluation end to end: its results frame by frame, and that it resumes."""

import csv
import json
import multiprocessing
import os
import shutil
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from datasets.clip import Dataset
from errors import BadInput
from eval import clip_run, harness
from eval.harness import do_all, evaluate, sheet
from eval.metrics import METRICS
from eval.results import FLOOR, ClipResults, Result, folder_of, heading, load_picture, read_results
from eval.tables import means_by_age
from files import locked, read_json, write_json
from tests.eval.conftest import untrained

KEYS = {
    *("mse", "rmse", "l1", "psnr", "ssim", "flip", "mse_unbiased", "smape", "rel_mse"),
    *(
        "temporal_error",
        "temporal_error_floor",
        "flicker",
        "disocclusion_l1",
        "energy",
        "detail",
        "tpsnr",
        "block_flicker",
    ),
}
ROWS = {
    *(("noisy", "total"), ("accumulated", "total"), ("eaw", "total")),
    *(("noisy", "indirect"), ("accumulated", "indirect"), ("ntd", "indirect")),
}


def test_results_file_has_the_agreed_form(evaluated):
    results = json.loads((evaluated / "eval" / "results.json").read_text())
    assert results.keys() == {"schema", "dataset", "device", "first_hits", "versions", "rows"}
    assert results["schema"] == 1 and not results["first_hits"]
    assert len(results["rows"]) == len(ROWS) * 2
    assert {(row["denoiser"], row["signal"]) for row in results["rows"]} == ROWS
    for row in results["rows"]:
        assert row.keys() == {"denoiser", "signal", "weights", "scene", "clip", "frames", "metrics", "nonfinite"}
        assert row["metrics"].keys() == KEYS
        assert (row["weights"] is None) == (row["denoiser"] != "ntd")
        assert row["frames"] == 8 and row["nonfinite"] == 0
        assert row["metrics"]["flicker"] is None  # the camera moves


@pytest.mark.parametrize(
    ("signal", "lights"), [("total", ("direct", "indirect", "emission")), ("indirect", ("indirect",))]
)
def test_results_are_the_means_of_frames(evaluated, tiny, signal, lights):
    """The rows of `noisy`, and the noise floors below them, recomputed with numpy from the files."""
    results = json.loads((evaluated / "eval" / "results.json").read_text())
    clip = Dataset(tiny).clips("test")[0]
    key = ("noisy", signal, clip.scene)
    (row,) = (r for r in results["rows"] if (r["denoiser"], r["signal"], r["scene"]) == key)
    mse = []
    rmse = []
    floor = []
    for i in range(clip.frames):
        noisy = sum(np.float32(clip.read(name, i)) for name in lights)
        references = (name if name == "emission" else f"{name}_reference" for name in lights)
        buffers = sum(np.float64(clip.read(name, i)) for name in references)
        x, r, a, b = (np.clip(clip.exposure * v, 0, 1) ** (1 / 2.2) for v in (noisy, buffers.mean(0), *buffers))
        mse.append(((x - r) ** 2).mean())
        rmse.append(np.sqrt(mse[-1]))
        floor.append(((a - b) ** 2).mean() / 4)
    assert row["metrics"]["mse"] == pytest.approx(np.mean(mse), rel=1e-4)
    assert row["metrics"]["rmse"] == pytest.approx(np.mean(rmse), rel=1e-4)
    lines = (line.split() for line in (evaluated / "table.txt").read_text().splitlines())
    start = [f"{clip.scene}/{clip.name}", "(noise", "floor)", "-", signal]
    (printed,) = (line for line in lines if line[:5] == start)
    assert float(printed[5]) == pytest.approx(np.mean(np.sqrt(floor)), abs=1e-4)


def test_sheets_show_every_denoiser_and_the_reference(evaluated):
    _, clips = read_results(evaluated)
    for clip in clips:
        axes = sheet(evaluated, clip).axes
        ending = "" if clip.signal == "total" else "-indirect"
        assert (evaluated / "eval" / f"{clip.scene}-000{ending}.png").exists()
        for result, panel in zip((*clip.results, clip.reference), axes, strict=True):
            picture = load_picture(evaluated / "eval" / "clips" / f"{clip.scene}-000" / f"{result.denoiser}{ending}", 6)
            np.testing.assert_array_equal(panel.images[0].get_array(), picture / 255)
            assert panel.get_title().startswith(result.denoiser) and ("RMSE" in panel.get_title()) != result.floor


def test_several_data_sets_are_one_table(tiny, tmp_path):
    """Clips of all of them; one name cannot stand for two clips."""
    other = tmp_path / "other"
    shutil.copytree(tiny, other)
    with pytest.raises(BadInput, match=f"{other} both have cornell_box/000"):
        evaluate([tiny, other], tmp_path, "tiny", ["noisy"])
    for path in (tiny / "test").iterdir():
        (other / "test" / path.name).rename(other / "test" / f"other_{path.name}")
    facts = read_json(other / "dataset.json", ())
    facts["splits"]["test"] = [f"other_{clip}" for clip in facts["splits"]["test"]]
    write_json(other / "dataset.json", facts)
    content = evaluate([tiny, other], tmp_path, "tiny", ["noisy"], first_hits=True)
    scenes = {path.name for path in (tiny / "test").iterdir()}
    assert {row["scene"] for row in content["rows"]} == scenes | {f"other_{scene}" for scene in scenes}
    assert content["first_hits"] and heading(content) == f"{tiny}, {other}, with first hits as guides"


def test_clips_that_lack_a_channel_are_refused_before_any_work(tiny_copy, tmp_path):
    path = Dataset(tiny_copy).planned(["test"])[-1] / "clip.json"
    facts = read_json(path)
    del facts["channels"]["gradient"]
    write_json(path, facts)
    with pytest.raises(BadInput, match=f"asvgf: {path.parent} has no gradient"):
        evaluate([tiny_copy], tmp_path / "runs", "tiny", ["noisy", "asvgf"])
    assert not (tmp_path / "runs").exists()


# --- Frame by frame, and resumed --------------------------------------------------------------------------------------

NAMES = ["noisy", "accumulated", "rae@tiny"]


def content(runs: Path) -> dict[str, bytes]:
    """All that an evaluation writes, but strips of pictures; wherever `runs` is, which results.json names."""
    files = [*runs.glob("eval/clips/*/*/*"), runs / "eval/results.json", runs / "eval/frames.csv"]
    return {str(file.relative_to(runs)): file.read_bytes().replace(str(runs).encode(), b"RUNS") for file in files}


@pytest.fixture(scope="module")
def once(tiny, tmp_path_factory):
    runs = tmp_path_factory.mktemp("once")
    untrained(runs, "rae")
    evaluate([tiny], runs, "tiny", NAMES)
    return runs


@pytest.fixture
def runs(once, tmp_path):
    return shutil.copytree(once, tmp_path / "runs")


@pytest.fixture
def played(monkeypatch):
    """The denoisers that were run, clip by clip."""
    calls = []
    run_clip = harness.run_clip

    def watched(clip, runs, quiet=False):
        calls.append((clip.scene, sorted(run.name for run in runs.values())))
        run_clip(clip, runs, quiet)

    monkeypatch.setattr(harness, "run_clip", watched)
    return calls


def test_results_are_the_means_of_the_csv(once, tiny):
    with open(once / "eval" / "frames.csv") as file:
        lines = list(csv.DictReader(file))
    assert list(lines[0]) == ["denoiser", "signal", "scene", "clip", "frame", *METRICS]
    assert len(lines) == 2 * 8 * (len(NAMES) + 1)
    results = json.loads((once / "eval" / "results.json").read_text())
    for row in results["rows"]:
        ours = [line for line in lines if all(line[key] == row[key] for key in ("denoiser", "signal", "scene", "clip"))]
        assert [int(line["frame"]) for line in ours] == list(range(8))
        for metric in METRICS:
            values = [float(line[metric]) for line in ours if line[metric]]
            mean = row["metrics"][metric]
            assert mean == pytest.approx(np.mean(values)) if values else mean is None
    floors = [line for line in lines if line["denoiser"] == FLOOR and line["scene"] == "cornell_box"]
    clip = Dataset(tiny).clips("test")[0]
    stored = pytest.approx(clip.facts["floor_mse"], rel=1e-4)  # of what was rendered, before it became float16
    assert np.mean([float(line["mse"]) for line in floors]) == stored
    assert floors[0]["temporal_error"] == "" and float(floors[1]["temporal_error"]) > 0


def test_pictures_are_displayed_outputs(once, tiny):
    clip = Dataset(tiny).clips("test")[0]
    for name, radiance in (
        ("noisy", sum(np.float32(clip.read(part, 5)) for part in ("direct", "indirect", "emission"))),
        ("reference", clip.reference(5).mean(axis=0)),
    ):
        saved = load_picture(folder_of(once, clip.scene, clip.name, name, "total"), 5)
        shown = 255 * np.clip(clip.exposure * radiance, 0, 1) ** (1 / 2.2)
        assert np.abs(saved - shown).max() <= 0.51


def test_finished_results_are_kept(once, runs, tiny, played):
    before = content(once)
    evaluate([tiny], runs, "tiny", NAMES)
    assert played == [] and content(runs) == before


def test_a_second_evaluation_at_once_is_refused(runs, tiny):
    with locked(runs / "eval" / ".lock"), pytest.raises(BadInput, match=r"another process is writing .*eval: wait"):
        evaluate([tiny], runs, "tiny", NAMES)


def test_only_changed_denoisers_are_evaluated_again(runs, tiny, played):
    untrained(runs, "rae", seed=1)
    evaluate([tiny], runs, "tiny", [*NAMES, "eaw"])
    assert played == [("cornell_box", ["eaw", "rae@tiny"]), ("cornell_box_moving", ["eaw", "rae@tiny"])]
    played.clear()
    evaluate([tiny], runs, "tiny", ["noisy"])
    rows = json.loads((runs / "eval" / "results.json").read_text())["rows"]
    assert played == [] and {row["denoiser"] for row in rows} == {"noisy"}


def test_another_clip_under_the_same_name_is_another_result(runs, tiny, tmp_path, played):
    other = shutil.copytree(tiny, tmp_path / "other")
    path = other / "test" / "cornell_box" / "000" / "clip.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"exposure": 1.0}))
    evaluate([other], runs, "tiny", NAMES)
    assert played == [("cornell_box", sorted([*NAMES, "reference"]))]


@pytest.mark.parametrize("damage", ["missing result", "half a result", "missing picture"])
def test_damaged_results_are_evaluated_again(once, runs, tiny, played, damage):
    before = content(once)
    folder = runs / "eval" / "clips" / "cornell_box-000" / "accumulated"
    if damage == "missing picture":
        (folder / "0003.webp").unlink()
    elif damage == "missing result":
        (folder / "result.json").unlink()
    else:
        (folder / "result.json").write_text('{"key": ')
    evaluate([tiny], runs, "tiny", NAMES)
    assert played == [("cornell_box", ["accumulated"])] and content(runs) == before


@pytest.mark.parametrize("frame", [5, *(pytest.param(frame, marks=pytest.mark.slow) for frame in (0, 11))])
def test_an_interrupted_evaluation_resumes_to_equal_results(once, tiny, tmp_path, monkeypatch, frame):
    """`frame` of the 16 of both clips is the one in which it is killed."""
    frames = []
    save = clip_run.save_picture

    def killed(path, image):
        frames.append(path)
        if len(frames) > frame * (len(NAMES) + 1) + 1:
            raise KeyboardInterrupt
        save(path, image)

    runs = tmp_path / "runs"
    shutil.copytree(once / "train", runs / "train")
    monkeypatch.setattr(clip_run, "save_picture", killed)
    with pytest.raises(KeyboardInterrupt):
        evaluate([tiny], runs, "tiny", NAMES)
    assert not (runs / "eval" / "results.json").exists()
    assert len(list(runs.glob("eval/clips/*/*/result.json"))) == (len(NAMES) + 1) * (frame // 8)
    monkeypatch.setattr(clip_run, "save_picture", save)
    evaluate([tiny], runs, "tiny", NAMES)
    assert content(runs) == content(once)


@pytest.mark.slow
def test_parallel_evaluation_gives_the_same_results(once, tiny, tmp_path):
    runs = tmp_path / "runs"
    shutil.copytree(once / "train", runs / "train")
    evaluate([tiny], runs, "tiny", NAMES, processes=2, smallest_share=1)
    for a, b in zip(read_results(runs)[1], read_results(once)[1], strict=True):
        for ours, theirs in zip([*a.results, a.reference], [*b.results, b.reference], strict=True):
            assert ours.key == theirs.key and ours.frames == [
                {k: v if v is None else pytest.approx(v, rel=1e-3) for k, v in frame.items()} for frame in theirs.frames
            ]


def test_killed_processes_and_errors_end_an_evaluation():
    """Neither is waited for, nor are the other processes."""
    spawning = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, spawning) as pool, pytest.raises(BadInput, match=r"was killed.*fewer --processes"):
        do_all(pool, os._exit, [1], "calls", "call")
    start = time.monotonic()
    with ProcessPoolExecutor(2, spawning) as pool, pytest.raises(TypeError):
        do_all(pool, time.sleep, [60, "long", 60], "calls", "call")
    assert time.monotonic() - start < 30


def test_denoisers_are_judged_by_the_age_of_their_history():
    """The first frame, the fifth, and the mean from the 16th on, if all clips of 1 spp are so long."""

    def clip(length: int, offset: float, name: str = "000") -> ClipResults:
        frames = [{metric: offset + index for metric in METRICS} for index in range(length)]
        result = Result(key="", denoiser="one", signal="total", scene="box", clip=name, metrics={}, frames=frames)
        return ClipResults("box", name, "total", [result], result)

    ages = means_by_age([clip(20, 100.0), clip(20, 200.0), clip(20, 900.0, "000-4spp")])["one"]
    assert list(ages.values()) == [150.0, 154.0, 167.0]
    assert list(means_by_age([clip(20, 100.0), clip(6, 200.0)])["one"].values()) == [150.0, 154.0, None]
    assert list(means_by_age([clip(1, 3.0)])["one"].values()) == [3.0, None, None]
