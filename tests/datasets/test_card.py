"""The data set card: there when a data set is whole, the same wherever it is made, and true."""

import json
import math
import shutil
import zlib
from pathlib import Path

import pytest

from datasets.card import CARD_FILE, PAGE_FILE, card_of, page_of
from datasets.clip import Dataset
from datasets.info import find_problems
from tests.helpers.datasets import generate_tiny


def card_in(root: Path) -> dict:
    return json.loads((root / CARD_FILE).read_text())


def test_it_agrees_with_the_files(tiny):
    card = card_in(tiny)
    clips = {str(path.parent.relative_to(tiny)): path for path in sorted(tiny.glob("*/*/*/clip.json"))}
    assert card["clips"].keys() == clips.keys()
    assert card["splits"]["train"].items() >= {"clips": 2, "frames": 16}.items()
    for name, path in clips.items():
        facts = json.loads(path.read_text())
        row = card["clips"][name]
        assert row["crc32"] == f"{zlib.crc32(path.read_bytes()):08x}"
        assert row["bytes"] == sum(f.stat().st_size for f in path.parent.iterdir() if f.name != "timing.json")
        assert row["floor_db"] == pytest.approx(-10 * math.log10(facts["floor_mse"]), abs=0.006)
        assert (row["reference_spp"], row["realisations"]) == ((64, 2) if "train" in name else (128, 1))
    assert card["bytes"] == sum(clip["bytes"] for clip in card["clips"].values())
    floors = [clip["floor_db"] for name, clip in card["clips"].items() if name.startswith("test/")]
    assert card["splits"]["test"]["worst_floor_db"] == min(floors)
    assert card["licence"] == "CC0-1.0" and card["command"] == "onespp dataset --profile tiny --seed 0"
    depth = card["channels"]["depth"]
    assert depth == {"axes": ["F", "H", "W", 1], "unit": "world units", "splits": ["train", "val", "test"]}


def test_the_page_names_what_the_card_has(tiny):
    page = (tiny / PAGE_FILE).read_text()
    card = card_in(tiny)
    facts = [card["command"], "CC0-1.0", *card["clips"], *card["channels"], *card["versions"].values()]
    assert all(fact in page for fact in facts)
    assert all(clip["crc32"] in page and f"{clip['floor_db']}" in page for clip in card["clips"].values())


def test_options_and_channels_left_out_are_listed(tiny_copy):
    path = tiny_copy / "dataset.json"
    facts = json.loads(path.read_text())
    facts["options"]["halton"] = True
    facts["channels"]["train"].remove("gradient")
    path.write_text(json.dumps(facts))
    card = card_of(Dataset(tiny_copy))
    assert card["command"].endswith(" --halton") and "Only test clips have gradient" in page_of(card)


def test_a_scene_of_ones_own_keeps_its_licence_and_lists_ignored_features(tiny_copy):
    path = tiny_copy / "dataset.json"
    facts = json.loads(path.read_text())
    own = {"profile": "/home/me/attic.toml", "source": {"/home/me/attic.toml": "0badcafe"}, "notes": ["fog: left out"]}
    path.write_text(json.dumps(facts | own))
    card = card_of(Dataset(tiny_copy))
    page = page_of(card)
    assert card["command"] == "onespp dataset --scene attic.toml --seed 0" and "/home" not in page
    assert "CC0" not in page and "Not as in the scene file: fog: left out." in page


def test_it_comes_with_the_last_clip_and_harms_nothing(tiny, tiny_copy):
    shutil.rmtree(tiny_copy / "val" / "cornell_box" / "000")
    for name in (CARD_FILE, PAGE_FILE):
        (tiny_copy / name).unlink()
    assert generate_tiny(tiny_copy, part="1/6") == 0
    assert not (tiny_copy / CARD_FILE).exists()
    assert generate_tiny(tiny_copy) == 1
    assert all((tiny_copy / name).read_bytes() == (tiny / name).read_bytes() for name in (CARD_FILE, PAGE_FILE))
    assert find_problems(tiny_copy) == []
    before = (tiny_copy / CARD_FILE).stat().st_mtime_ns
    assert generate_tiny(tiny_copy) == 0
    assert (tiny_copy / CARD_FILE).stat().st_mtime_ns == before
