"""Tables that rank denoisers say what each is made from, on the console and in the documentation."""

import re

import pytest

from eval.pages import GENERATORS, measured
from eval.results import read_results
from eval.tables import results_table, table_by_age
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
    return re.findall(r"[\w@+-]+", row)


def check(table: str) -> None:
    """Every row has the source of the first denoiser that it names, and there are several."""
    rows = table.partition("Pareto front")[0].splitlines()
    assert any("made from" in row for row in rows)
    named = {row: name for row in rows if (name := next((w for w in words_of(row) if w in DENOISERS), None))}
    assert len({*named.values()}) > 1
    for row, name in named.items():
        assert f" {prototype(name).made_from} " in row, row


@pytest.mark.parametrize(("name", "arguments"), DOCUMENTED.items(), ids=DOCUMENTED)
def test_the_documentation_s_tables(name, arguments):
    check(GENERATORS[name](*arguments))


def test_the_console_s_tables(evaluated):
    clips = read_results(evaluated)[1]
    check(results_table(clips))
    check(table_by_age(clips))


def test_the_tables_of_trades():
    rows = [Trade(**row) for row in measured("trade")["samples"]]
    check(front_table(rows))
    check(samples_table(rows))
