"""Tables that rank denoisers say what each is made from, on the console and in the documentation."""

import math
import re
from pathlib import Path

import pytest

from eval import pages
from eval.pages import GENERATORS, measured, noise_off
from eval.results import FLOOR, NOISE_FLOOR, ClipResults, Result, read_results
from eval.tables import TableRow, results_table, table_by_age
from eval.tradeoff.trades import Trade, front_table, samples_table
from models.registry import DENOISERS, prototype

DOCUMENTED = {
    "quality": ("psnr", "indirect"),
    "metrics": ("psnr", "energy", "detail"),
    "samples": (),
    "front": (),
    "glass": (),
    "ages": ("benchmark",),
    "steady": ("benchmark",),
}


def words_of(row: str) -> list[str]:
    """The words of a row; of the label of a measurement in bfloat16, the denoiser's name."""
    return [word.removesuffix("-bfloat16") for word in re.findall(r"[\w@+-]+", row)]


def check(table: str) -> None:
    """Every row has the source of the first denoiser that it names, and there are several."""
    rows = table.partition("Pareto front")[0].splitlines()
    assert any("made from" in row for row in rows)
    of_row = {row: [word for word in words_of(row) if word.partition("+")[0] in DENOISERS] for row in rows}
    named = {row: names[0] for row, names in of_row.items() if names}
    assert len({*named.values()}) > 1
    for row, name in named.items():
        assert f" {prototype(name).made_from} " in row, row


@pytest.mark.parametrize(("name", "arguments"), DOCUMENTED.items(), ids=DOCUMENTED)
def test_the_documentation_s_tables(name, arguments):
    check(GENERATORS[name](*arguments))


def test_noise_of_references_is_taken_off():
    """Errors of 1/1000 and 1/100 in references with noise of 1/4000 and 1/1000: 30 and 20 dB."""
    clips = [
        {"results": {"one": {"psnr": -10 * math.log10(own + noise)}, NOISE_FLOOR: {"psnr": -10 * math.log10(noise)}}}
        for own, noise in ((1e-3, 2.5e-4), (1e-2, 1e-3))
    ]
    assert noise_off(clips, "one") == "25.00"
    assert noise_off(clips, NOISE_FLOOR) == ""


def test_the_lead_over_a_peer(monkeypatch):
    """Squared errors of 2 and 8 with noise of 1: 7 times less without it; temporal errors of 3 and 5 above 2."""
    errors = {"one": (2, 3), "oidn": (8, 5), NOISE_FLOOR: (1, 2)}
    scores = {
        name: {"psnr": -10 * math.log10(e / 1e3), "temporal_error": t, "ssim": 1 / t} for name, (e, t) in errors.items()
    }
    ages = {"one": {"first frame": 27.0}, "oidn": {"first frame": 27.5}}
    monkeypatch.setattr(pages, "benchmark", lambda _: {"clips": [{"results": scores}], "ages": ages})
    row = pages.lead("", "one", "oidn").splitlines()[-1]
    assert row.replace(" ", "") == "|`oidn`|-0.50dB|+6.02dB|+8.45dB|+0.1333|33%|"


def test_what_has_no_time_is_named_below_the_front(monkeypatch):
    rows = [row | ({"ms": None} if row["denoiser"] == "one" else {}) for row in measured("trade")["samples"]]
    monkeypatch.setattr(pages, "measured", lambda _: {"samples": rows})
    above, _, below = pages.front().partition("\nWithout a time: ")
    assert "`one`" in below and "`one`" not in above


def test_standard_errors_fall_with_the_frames(monkeypatch):
    """The mean of frames with 3 and 4 has one of 2.5; other floors are averaged."""
    place = {"key": "", "signal": "total", "scene": "box", "clip": "000", "metrics": {}}
    frames = [{"energy": error, "psnr": error} for error in (9.0, 3.0, 4.0)]
    floor = Result(denoiser=NOISE_FLOOR, frames=frames, **place)
    monkeypatch.setattr(pages, "read_results", lambda _: ({}, [ClipResults("box", "000", "total", [], floor)]))
    (clip,) = pages.steady_clips(Path(), 1)
    floors = clip["results"][NOISE_FLOOR]
    assert (floors["energy"], floors["psnr"]) == (2.5, 3.5)


def test_however_small_the_error_of_energy_has_two_digits():
    errors = {"energy": 0.00021, "mse_unbiased": 1.25e-6, "psnr": 40.0}
    row = TableRow("box/000", FLOOR, "total", errors, errors)
    assert [row.text(metric) for metric in (*errors, "rmse")] == ["±0.021%", "±1.25e-06", "40.00", "-"]


def test_the_console_s_tables(evaluated):
    clips = read_results(evaluated)[1]
    check(results_table(clips))
    check(table_by_age(clips))


def test_the_tables_of_trades():
    rows = [Trade(**row) for row in measured("trade")["samples"]]
    check(front_table(rows))
    check(samples_table(rows))
