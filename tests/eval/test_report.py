"""The report: one page that needs nothing else, and animated pictures."""

import base64
import io
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command_line import main
from datasets.clip import Dataset
from datasets.frame import read_frame
from errors import BadInput
from eval.clip_run import densest_crop
from eval.harness import evaluate_clip, named_denoisers
from eval.metrics import METRICS, flip_map
from eval.report.page import page_clip, render, report
from eval.results import FLOOR, MAX_SHOWN_ERROR, by_clip, folder_of, load_picture, load_result
from eval.tables import TableRow, best_denoisers
from eval.tradeoff.samples import with_samples
from files import read_json, write_json
from models.spec import DenoiserSpec
from models.wrappers.error_estimate import denoise_with_error
from provenance import ROOT
from tests.eval.conftest import bench_of


class Page(HTMLParser):
    """Checks that tags match; collects their attributes, and the text of scripts and of the table's rows."""

    VOID = ("meta", "link", "input", "img", "br")

    def __init__(self, path: Path):
        super().__init__()
        self.open: list[str] = []
        self.attributes: list[tuple[str, str, str | None]] = []
        self.scripts: list[str] = []
        self.rows: list[list[str]] = []
        self.classes: dict[str, str] = {}  # of the table's cells, by their values
        self.feed(path.read_text())
        assert self.open == []
        self.data = json.loads(self.scripts[0])

    def handle_starttag(self, tag, attrs):
        self.attributes += [(tag, name, value) for name, value in attrs]
        if "data-value" in dict(attrs):
            self.classes[dict(attrs)["data-value"]] = dict(attrs)["class"]
        self.open += [tag] if tag not in self.VOID else []
        if tag == "script":
            self.scripts.append("")
        if tag == "tr":
            self.rows.append([])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif self.open[-1:] in (["td"], ["th"]) or self.open[-2:] == ["th", "button"]:
            self.rows[-1].append(data)


@pytest.fixture(scope="session")
def page(evaluated) -> Page:
    return Page(evaluated / "report" / "index.html")


def pixels(uri: str) -> np.ndarray:
    head, body = uri.split(",")
    assert head == "data:image/webp;base64"
    return np.array(Image.open(io.BytesIO(base64.b64decode(body))).convert("RGB"))


def test_the_page_loads_nothing_and_has_its_figures(page, evaluated):
    assert ("img", "alt", "trade flip") in page.attributes
    for tag, name, value in page.attributes:
        if name in ("src", "href", "action", "poster", "srcset"):
            assert value.startswith(("data:", "#")), (tag, name, value)
    text = (evaluated / "report" / "index.html").read_text()
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", text)
    assert set(re.findall(r"https?://[\w./]*", text)) == {"http://www.w3.org/2000/svg"}  # a namespace, never loaded


def test_the_table_has_every_result_and_floor(page):
    titles, *rows = page.rows
    shown = [metric.title for key, metric in METRICS.items() if key != "flicker"]  # nothing stands still here
    facts = ["clip", "denoiser", "made from", "signal"]
    assert [title.removesuffix(" ↑") for title in titles] == [*facts, *shown, "non-finite"]
    clips = ["mean of clips of 1 spp", "cornell_box/000", "cornell_box_moving/000"]
    assert [row[0] for row in rows if row[1] == "(noise floor)" and row[3] == "total"] == clips
    assert {(row[2], row[3]) for row in rows if row[1] == "ntd"} == {("paper", "indirect")}
    assert len(rows) == 3 * 4 + 3 * 4  # of total and of indirect light three denoisers each, and the floor
    assert all(len(row) == 4 + len(shown) + (row[1] != "(noise floor)") for row in rows)


def test_the_best_are_marked(page, evaluated):
    """By RMSE: the least of each clip and signal, here never within the noise floor."""
    for clip in (("cornell_box", "000"), ("cornell_box_moving", "000")):
        rmse = {}
        for name in ("noisy", "accumulated", "eaw"):
            rmse[name] = load_result(folder_of(evaluated, *clip, name, "total")).metrics["rmse"]
        best = repr(min(rmse.values()))
        assert page.classes[best] == "number best"
        assert all(page.classes[repr(value)] == "number" for value in rmse.values() if repr(value) != best)


def row(name: str, floor: float | None = None, **values: float | None) -> TableRow:
    return TableRow("cornell_box/000", name, "total", values, dict.fromkeys(values, floor))


def test_best_denoisers():
    rows = [row("a", psnr=30.0, rmse=0.1), row("b", psnr=31.0, rmse=0.1), row("c", psnr=None, rmse=0.2)]
    assert best_denoisers(rows, "psnr") == {"b"} and best_denoisers(rows, "rmse") == {"a", "b"}
    assert best_denoisers(rows, "flicker") == set()
    rows = [row("a", 40.0, psnr=38.0), row("b", 40.0, psnr=37.5), row("c", 40.0, psnr=36.0), row(FLOOR, psnr=40.0)]
    assert best_denoisers(rows, "psnr") == {"a", "b"}  # both within the floor
    rows = [row("a", 40.0, psnr=36.0), row("b", 45.0, psnr=37.5)]
    assert best_denoisers(rows, "psnr") == {"b"}
    rows = [row("a", mse_unbiased=-3e-4), row("b", mse_unbiased=2e-4)]
    assert best_denoisers(rows, "mse_unbiased") == {"b"}  # the nearest to 0
    rows = [row("a", ssim=-0.2), row("b", ssim=0.1)]
    assert best_denoisers(rows, "ssim") == {"b"}


def test_the_page_embeds_the_pictures_of_the_evaluation(page, evaluated):
    clip = next(clip for clip in page.data["clips"] if clip["name"] == "cornell_box_moving/000 (indirect light)")
    assert list(clip["images"]) == ["ntd", "noisy", "accumulated", "reference"] and clip["frames"] == list(range(8))
    folders = {
        name: folder_of(evaluated, "cornell_box_moving", "000", name, "indirect") for name in ("ntd", "reference")
    }
    for index in (0, 7):
        images = {name: load_picture(folder, index) for name, folder in folders.items()}
        for name, image in images.items():
            assert np.array_equal(pixels(clip["images"][name][index]), image)
        expected = flip_map(images["ntd"] / 255, images["reference"] / 255)
        assert np.abs(pixels(clip["flips"]["ntd"][index])[..., 0] / 255 - expected).max() <= 0.51 / 255
    assert set(clip["flips"]) == set(clip["images"]) - {"reference"}


def test_estimated_errors_have_their_own_view(tiny, page, tmp_path):
    clip = next(clip for clip in Dataset(tiny).clips("train") if clip.scene == "cornell_box")
    fed = with_samples(clip, Dataset(tiny), 2, tmp_path / "data", with_buffers=True)
    specs = [DenoiserSpec.named("noisy"), DenoiserSpec.named("eaw+js")]
    (results,) = by_clip(evaluate_clip(fed, named_denoisers(specs), tmp_path))
    shown = page_clip(tmp_path, results, 3)
    assert list(shown["errors"]) == ["eaw+js"] and len(shown["errors"]["eaw+js"]) == len(shown["frames"])
    shade = pixels(shown["errors"]["eaw+js"][1])[..., 0]
    denoiser = specs[1].build()
    state = None
    for index in range(4):
        _, state, estimate = denoise_with_error(denoiser, read_frame(fed, index, specs[1].facts.reads), state)
    expected = (fed.exposure * estimate.radiance_error()[0].square().mean(dim=0).sqrt() / MAX_SHOWN_ERROR).clamp(0, 1)
    assert shade.max() > 0
    assert np.abs(shade / 255 - expected.numpy()).max() <= 0.51 / 255
    assert all(clip["errors"] == {} for clip in page.data["clips"])


def test_curves_are_the_frames(page, evaluated):
    clip = page.data["clips"][0]
    assert clip["name"] == "cornell_box/000"
    saved = json.loads((folder_of(evaluated, "cornell_box", "000", "eaw", "total") / "result.json").read_text())
    for metric in ("rmse", "temporal_error"):
        values = [
            None if frame[metric] is None else pytest.approx(frame[metric], rel=1e-3) for frame in saved["frames"]
        ]
        assert clip["curves"][metric]["eaw"] == values
        assert len(clip["curves"][metric]["reference"]) == 8


def test_crops_are_inside_and_in_separate_frames(page):
    crops = page.data["clips"][-2]["crops"]
    assert crops
    for crop in crops:
        assert 0 <= crop["x"] <= 64 - crop["size"] and 0 <= crop["y"] <= 64 - crop["size"] and crop["size"] == 16
    assert len({crop["frame"] for crop in crops}) == len(crops)


def test_quality_against_time(page):
    plots = {(plot["signal"], plot["metric"]): plot for plot in page.data["trades"]}
    total = plots["total", "flip"]
    assert {point["name"]: point["ms"] for point in total["points"]} == {"noisy": 0.5, "accumulated": 1.0, "eaw": 2.5}
    assert [point["name"] for point in total["points"]] == ["noisy", "accumulated", "eaw"]  # fastest first
    assert total["missing"] == [] and total["size"] == "1280 × 720"
    indirect = {point["name"]: point for point in plots["indirect", "ssim"]["points"]}
    assert indirect["noisy"]["by"] is None and "ntd" in indirect
    assert (indirect["noisy"]["ms"], indirect["accumulated"]["ms"]) == (0.4, 0.6)  # not those of total light


@pytest.mark.usefixtures("no_live_page")
def test_a_page_of_few_megabytes_shows_fewer_frames(evaluated, tmp_path):
    runs = shutil.copytree(evaluated, tmp_path / "runs")
    whole = (runs / "report" / "index.html").stat().st_size
    report(runs, megabytes=whole / 3e6)
    small = Page(runs / "report" / "index.html")
    frames = small.data["clips"][0]["frames"]
    assert 1 < len(frames) < 8 and (runs / "report" / "index.html").stat().st_size < 0.6 * whole
    assert all(crop["frame"] in frames for clip in small.data["clips"] for crop in clip["crops"])
    assert len(small.data["clips"][0]["curves"]["rmse"]["noisy"]) == 8
    report(runs, megabytes=1e-6)
    assert Page(runs / "report" / "index.html").data["clips"][0]["frames"] == [0]


def test_animations(evaluated):
    for name in ("cornell_box-000", "cornell_box_moving-000", "cornell_box_moving-000-indirect"):
        with Image.open(evaluated / "report" / f"{name}.webp") as image:
            assert image.n_frames == 8 and image.width == 4 * 256 and image.info["loop"] == 0
            first = np.array(image.convert("RGB"))
            image.seek(7)
            assert not np.array_equal(first, np.array(image.convert("RGB")))


@pytest.mark.usefixtures("no_live_page")
def test_without_results_or_with_damaged_ones(evaluated, tmp_path, capsys):
    with pytest.raises(BadInput, match="onespp eval"):
        report(tmp_path)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(BadInput, match="more than 0"):
        report(evaluated, megabytes=0)
    runs = shutil.copytree(evaluated, tmp_path / "runs")
    (runs / "eval" / "clips" / "cornell_box-000" / "eaw" / "0002.webp").write_bytes(b"RIFF")
    with pytest.raises(SystemExit) as exit_:
        main(["report", "--runs", str(runs)])
    error = capsys.readouterr().err
    assert exit_.value.code == 2 and "0002.webp is missing or damaged" in error and "onespp eval" in error
    assert (runs / "report" / "index.html").read_bytes() == (evaluated / "report" / "index.html").read_bytes()
    shutil.rmtree(runs / "eval" / "clips" / "cornell_box-000" / "eaw")
    with pytest.raises(BadInput, match=r"eaw/result.json is missing"):
        report(runs)


@pytest.mark.slow
def test_the_live_page_is_linked_where_it_can_be_made(evaluated, tmp_path, monkeypatch, capsys):
    def links(runs: Path) -> bool:
        linked = ("a", "href", "live.html") in Page(runs / "report" / "index.html").attributes
        assert linked == (runs / "report" / "live.html").exists()
        return linked

    runs = shutil.copytree(evaluated, tmp_path / "runs")
    report(runs, megabytes=1e-6)
    if links(runs):
        assert '"name": "cornell_box_moving/000"' in (runs / "report" / "live.html").read_text()
        (runs / "report" / "live.html").unlink()
    capsys.readouterr()
    # Without a compiler for WebAssembly: a copy of the runtime's sources, none of which is compiled.
    shutil.copytree(ROOT / "runtime", tmp_path / "runtime", ignore=shutil.ignore_patterns("*.wasm"))
    monkeypatch.setattr("eval.report.page.ROOT", tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("CLANG", "no-such-compiler")
    report(runs, megabytes=1e-6)
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("no live.html: ") and "no-such-compiler" in line and "libclang-rt-dev-wasm32" in line
    assert not links(runs)
    # Without the runtime, as in an installed package.
    shutil.rmtree(tmp_path / "runtime")
    report(runs, megabytes=1e-6)
    assert capsys.readouterr().out == "" and not links(runs)


@pytest.mark.usefixtures("no_live_page")
def test_without_a_bench_there_is_no_plot(evaluated, tmp_path):
    runs = shutil.copytree(evaluated, tmp_path / "runs")
    shutil.rmtree(runs / "bench")
    report(runs, megabytes=1e-6)  # one frame a clip
    assert Page(runs / "report" / "index.html").data["trades"] == []
    assert 'id="trade"' not in (runs / "report" / "index.html").read_text()


def test_times_of_other_code_are_named(tmp_path, capsys):
    bench_of(tmp_path, {"noisy": 1.0}, (32, 48))
    path = tmp_path / "bench" / "results.json"
    write_json(path, read_json(path) | {"made_by": {}})
    render({"dataset": "data", "device": "cpu", "versions": {}}, [], tmp_path, 1.0, live=False)
    assert f"{path} has times of other code or packages: measure again with" in capsys.readouterr().out


def test_a_live_page_that_fails_without_a_word_costs_nothing_else(evaluated, tmp_path, monkeypatch, capsys):
    killed = subprocess.CompletedProcess([], -9, "", "")
    monkeypatch.setattr("eval.report.page.subprocess.run", lambda *_, **__: killed)
    runs = shutil.copytree(evaluated, tmp_path / "runs")
    report(runs, megabytes=1e-6)
    assert "no live.html: exit status -9" in capsys.readouterr().out


def test_densest_crop():
    mask = torch.zeros(100, 80, dtype=torch.bool)
    assert densest_crop(mask) is None
    mask[40:44, 30:36] = True
    window = densest_crop(mask)
    assert window["size"] == 20 and window["pixels"] == 24
    assert abs(window["x"] + 9.5 - 32.5) <= 1 and abs(window["y"] + 9.5 - 41.5) <= 1
    mask[:] = False
    mask[0, 79] = True
    assert densest_crop(mask) == {"x": 60, "y": 0, "size": 20, "pixels": 1}
    assert densest_crop(torch.ones(3, 50, dtype=torch.bool))["size"] == 3
    assert densest_crop(torch.ones(1, 1, dtype=torch.bool)) == {"x": 0, "y": 0, "size": 1, "pixels": 1}
