"""The documentation: generated numbers agree with their sources, and what pages name exists."""

import re
from pathlib import Path

import pytest

from command_line import GROUPS
from eval.pages import FURTHER_PAGES, MARKED, PAGES, generated
from provenance import ROOT
from tests.test_cli import commands

MOST_WORDS = 16_000
FENCED = re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)
# Pages of results, whose tables are all generated.
MEASURED_PAGES = [page for page in PAGES if page.name in ("README.md", "results.md", "evaluation.md", "denoisers.md")]


@pytest.mark.parametrize("page", [*PAGES, *FURTHER_PAGES], ids=lambda page: str(page.relative_to(ROOT)))
def test_generated_parts_agree_with_their_sources(page):
    assert generated(page.read_text()) == page.read_text(), "run `python -m eval.pages`"


@pytest.mark.parametrize("page", MEASURED_PAGES, ids=lambda page: page.name)
def test_no_table_of_measurements_is_typed_by_hand(page):
    by_hand = MARKED.sub("", FENCED.sub("", page.read_text()))
    cells = [
        line for line in by_hand.splitlines() if line.startswith("|") and re.search(r"\| *[≈±]?\d+\.\d+ *\|", line)
    ]
    assert not cells


def test_the_documentation_stays_short():
    assert sum(len(page.read_text().split()) for page in PAGES) <= MOST_WORDS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_and_files_exist(page):
    text = page.read_text()
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]+))?\)", text):
        file = page.parent / target if target else page
        assert file.exists(), f"{page.name} links to {target}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings}, anchor
    for name in re.findall(r"`((?:scenes|render|datasets|models|train|eval|denoise|tests)/[\w/]+\.\w+)`", text):
        assert (ROOT / name).exists(), f"{page.name} names {name}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_exist(page):
    known = set(commands(GROUPS))
    for first, second in re.findall(r"(?:`|^)onespp ([a-z]+)(?: ([a-z]+))?", page.read_text(), re.MULTILINE):
        assert {(first,), (first, second)} & known, f"{page.name} names `onespp {first} {second}`"


def test_every_picture_is_used():
    pages = "".join(page.read_text() for page in PAGES)
    assert all(picture.name in pages for picture in Path(ROOT / "docs").glob("*.png"))
