"""The bench of references, in small: two splits that are both the tiny data set, two steps each."""

import json
from pathlib import Path

import pytest

from datasets.clip import Dataset
from errors import BadInput
from eval.bench import references
from eval.bench.references import Split, Way, bench_references, recipe_of
from train.recipes import recipe_for


def test_every_split_gets_as_many_steps(tiny):
    (clip,) = Dataset(tiny).clips("train")[:1]
    for rooms in (8, 48):
        recipe = recipe_of("wskp6", "paper", [clip] * rooms)
        steps = recipe.epochs * recipe.crops[0] * rooms * clip.frames / recipe.batch
        assert steps == pytest.approx(references.STEPS["wskp6"], rel=0.1)
        assert recipe.rate == recipe_for("wskp6", "quick").rate


@pytest.mark.slow
def test_bench_references(tiny, tmp_path, monkeypatch):
    splits = (Split(1, 2), Split(1, 4))
    monkeypatch.setattr(references, "SPLITS", splits)
    monkeypatch.setattr(references, "STEPS", {"wskp6": 2})
    monkeypatch.setattr(references, "WAYS", tuple(Way("wskp6", "relative", split) for split in splits))
    monkeypatch.setattr(references, "LOSSES", {"relative": references.LOSSES["relative"]})

    def link(folder: Path, profile: str, seed: int) -> None:
        folder.parent.mkdir(parents=True, exist_ok=True)
        if not folder.exists():
            folder.symlink_to(tiny)

    monkeypatch.setattr(references, "generate", link)
    table = bench_references(tiny, tmp_path, seeds=1)
    assert "1 rooms, 2 spp (" in table and "wskp6" in table
    folder = tmp_path / "bench" / "references"
    assert (folder / "plot.png").stat().st_size > 5000
    assert (folder / "table.md").read_text() == f"{table}\n"
    results = json.loads((folder / "results.json").read_text())
    assert [row["variant"] for row in results["rows"]] == ["wskp6-relative-1x2", "wskp6-relative-1x4"]
    assert results["seconds"]["rooms-1x2"] > 0
    first, second = (row["clips"] for row in results["rows"])
    assert first == second and [*first] == ["cornell_box/000", "cornell_box_moving/000"]  # the same data and seed


def test_no_seeds_train_nothing(tiny, tmp_path):
    with pytest.raises(BadInput, match="0 seeds"):
        bench_references(tiny, tmp_path, seeds=0)
