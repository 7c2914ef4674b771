"""`onespp weights`: the table, and cards, regenerated between their markers."""

import os
import shutil
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from command_line import main
from errors import BadInput
from eval.harness import evaluate
from eval.results import read_results
from eval.shipped import BEGIN, END, card_file, facts, measure_card, table
from files import read_json, write_json
from models.registry import create, shipped_names
from models.weights import average_weights, save_weights
from provenance import file_digest
from tests.helpers.training import tensors
from tests.test_cli import fails

RECIPE = {
    "budget": "tiny",
    "seed": 3,
    "data": {"profile": "somewhere/my.toml", "seed": 4, "generator": 5, "scenes": ["a", "b"]},
    "loss": {"epsilon": 0.01},
    "epochs": 6,
    "parameters": 1234,
    "step": 78,
    "validation": 0.123456,
}
MADE_BY = [{"versions": {"torch": "1.2.3"}, "code": "c0de"}, {"versions": {"torch": "1.2.4"}, "code": "c0d3"}]
HAND = f"# wskp3\n\nBy hand.\n\n{BEGIN}\nold\n{END}\n\n## Limitations\n\nBy hand, too.\n"


@pytest.fixture
def wskp3(shipped) -> Path:
    """Weights that were never trained, shipped."""
    path = shipped / "wskp3.safetensors"
    save_weights(create("wskp3"), "wskp3", RECIPE, path, MADE_BY)
    return path


def test_the_table_has_a_line_for_each(wskp3, capsys):
    save_weights(create("kp"), "kp", RECIPE | {"parameters": 77}, wskp3.with_name("kp.safetensors"))
    main(["weights"])
    head, _, *lines = capsys.readouterr().out.splitlines()
    assert head.split()[:2] == ["network", "parameters"]
    assert [line.split()[:2] for line in lines] == [["wskp3", "1234"], ["kp", "77"]]
    assert file_digest(wskp3)[:12] in lines[0] and "my.toml, 2 scenes" in lines[0] and "0.1235" in lines[0]


def test_weights_that_a_script_trained_say_so(wskp3, tiny, tmp_path):
    recipe = {key: value for key, value in RECIPE.items() if key != "budget"}
    save_weights(create("wskp3"), "wskp3", recipe, wskp3, MADE_BY)
    evaluate([tiny], tmp_path, "tiny", ["noisy", "wskp3"])
    wskp3.with_suffix(".md").write_text(HAND)
    text = measure_card("wskp3", tmp_path).read_text()
    assert "- Trained by a script that is not kept" in text and "onespp train" not in text
    assert "a script" in table()


def test_no_card_without_shipped_weights(shipped, capsys):
    assert "no weights of 'rae' are shipped; those are none" in fails(capsys, "weights", "rae")
    assert table() == ""


def test_only_the_generated_part_of_a_card_changes(wskp3, tiny, tmp_path, capsys):
    evaluate([tiny], tmp_path, "tiny", ["noisy", "accumulated", "eaw", "wskp3"])
    card = wskp3.with_suffix(".md")
    with pytest.raises(BadInput, match=r"wskp3.md: write the network's intended use.*the lines"):
        measure_card("wskp3", tmp_path)
    assert not wskp3.with_suffix(".json").exists()
    card.write_text(HAND)
    assert measure_card("wskp3", tmp_path) == card
    text = card.read_text()
    before, _, after = HAND.partition("old\n")
    assert text.startswith(before) and text.endswith(after) and "old" not in text
    words = " ".join(text.split())
    for fact in (
        "1234 parameters",
        file_digest(wskp3),
        "`onespp train wskp3 --budget tiny --seed 3` on the data set `my.toml` (seed 4, ",
        "generator version 5, 2 scenes). Weights",
        "of step 78, with a validation loss of 0.1235",
        '`{"loss": {"epsilon": 0.01}, "epochs": 6}`',
        "torch 1.2.3, code c0de and torch 1.2.4, code c0d3",
        "2 test clips at 1 spp of `tiny`, total radiance",
    ):
        assert fact in words, fact
    rows = {
        cells[1]: cells[2:-1] for line in text.splitlines() if len(cells := [c.strip() for c in line.split("|")]) > 3
    }
    assert "eaw" not in rows
    results = read_json(tmp_path / "eval" / "results.json")["rows"]
    for name in ("noisy", "accumulated", "wskp3"):
        psnr = {row["scene"]: row["metrics"]["psnr"] for row in results if row["denoiser"] == name}
        assert rows[name][rows["denoiser"].index("PSNR dB")] == f"{sum(psnr.values()) / 2:.2f}"
        for scene, value in psnr.items():
            assert rows[f"{scene}/000"][rows["clip"].index(name)] == f"{value:.2f}"
    clips = read_results(tmp_path)[1]
    floors = [clip.reference.metrics["rmse"] for clip in clips]
    assert rows["denoiser"][:2] == ["made from", "RMSE"] and rows["wskp3"][0] == "paper"
    assert rows["(noise floor)"][1] == f"{sum(floors) / 2:.4f}" and float(rows["wskp3"][1]) > sum(floors) / 2

    capsys.readouterr()
    main(["weights", "--card", str(tmp_path)])  # all of them
    assert card.read_text() == text and capsys.readouterr().out == f"{card}\n"
    main(["weights", "wskp3"])
    assert capsys.readouterr().out == text


@pytest.mark.parametrize("name", shipped_names())
def test_cards_are_generated_from_weights_and_measurements(name):
    card = card_file(name).read_text()
    assert card.partition(BEGIN)[2].partition(END)[0].strip() == facts(name), "run `onespp weights --card RUNS`"


def test_the_mean_of_trainings_names_their_recipes(wskp3, tiny, tmp_path, capsys):
    """Its card has no training of its own; the table says so."""
    files = [tmp_path / "a.safetensors", tmp_path / "b.safetensors", tmp_path / "c.safetensors"]
    for seed, file in enumerate(files):
        torch.manual_seed(seed)
        start = {"from": file_digest(files[0])} if seed else {}
        save_weights(create("wskp3"), "wskp3", RECIPE | {"rate": seed} | start, file, MADE_BY[:1])
    assert "needs the NETWORK and --out FILE" in fails(capsys, "weights", "--average", *map(str, files))
    main(["weights", "wskp3", "--average", *map(str, files), "--out", str(wskp3)])
    assert f"{wskp3} is a mean itself" in fails(
        capsys, "weights", "wskp3", "--average", str(wskp3), str(files[0]), "--out", str(tmp_path / "mean.safetensors")
    )
    trained = [tensors(file) for file in files]
    for key, value in tensors(wskp3).items():
        mean = np.mean([each[key].numpy() for each in trained], axis=0)
        np.testing.assert_allclose(value, mean, rtol=1e-5, atol=1e-7)
    evaluate([tiny], tmp_path, "tiny", ["noisy", "wskp3"])
    wskp3.with_suffix(".md").write_text(HAND)
    text = measure_card("wskp3", tmp_path).read_text()
    assert "mean of the weights of 3 trainings" in text and "Trained by" not in text
    recipes = [line for line in text.splitlines() if line.startswith("  - on the data set")]
    for seed, (file, recipe) in enumerate(zip(files, recipes, strict=True)):
        assert f'"rate": {seed}' in recipe and f'"sha256": "{file_digest(file)}"' in recipe
    assert text.count("data set `my.toml`") == 3 and text.count("torch 1.2.3") == 1
    assert "3 trainings' mean" in table()


@pytest.mark.parametrize(("starts", "is_averaged"), [(("x", "x"), True), (("x", "y"), False), ((None, None), False)])
def test_trainings_with_other_starts_have_no_mean(tmp_path, starts, is_averaged):
    files = [tmp_path / "a.safetensors", tmp_path / "b.safetensors"]
    for file, start in zip(files, starts, strict=True):
        recipe = RECIPE | ({"from": start} if start else {})
        save_weights(create("wskp3"), "wskp3", recipe | {"file": file.name}, file, MADE_BY)
    refused = pytest.raises(BadInput, match="did not begin with the same weights")
    with nullcontext() if is_averaged else refused:
        average_weights(create("wskp3"), "wskp3", files, tmp_path / "mean.safetensors")
    assert (tmp_path / "mean.safetensors").exists() == is_averaged


def test_specialised_weights_have_no_mean(tmp_path):
    denoiser = create("wskp3")
    denoiser.specialise({"albedo": [0.5, 0.5, 0.5]})
    file = tmp_path / "a.safetensors"
    save_weights(denoiser, "wskp3", RECIPE, file, MADE_BY)
    with pytest.raises(BadInput, match=r"a.safetensors is specialised to one scene"):
        average_weights(create("wskp3"), "wskp3", [file], tmp_path / "mean.safetensors")
    assert not (tmp_path / "mean.safetensors").exists()


def test_weights_that_do_not_state_their_training_have_no_mean(tmp_path):
    file = tmp_path / "a.safetensors"
    save_file(create("wskp3").state_dict(), file, {"denoiser": "wskp3"})
    with pytest.raises(BadInput, match=r"a.safetensors does not state how it was trained"):
        average_weights(create("wskp3"), "wskp3", [file], tmp_path / "mean.safetensors")


def test_results_of_other_weights_are_refused(wskp3, tiny, tmp_path):
    """Not those of a training, and not those that were shipped before."""
    wskp3.with_suffix(".md").write_text(HAND)
    evaluate([tiny], tmp_path, "tiny", ["noisy", "wskp3"])
    results = tmp_path / "eval" / "results.json"
    content = read_json(results)
    os.utime(wskp3, (results.stat().st_mtime + 5,) * 2)
    with pytest.raises(BadInput, match=r"no results of .*wskp3.safetensors as it is now.*`onespp eval noisy"):
        measure_card("wskp3", tmp_path)
    os.utime(wskp3, (0, 0))
    measure_card("wskp3", tmp_path)
    write_json(results, content | {"first_hits": True})
    with pytest.raises(BadInput, match="without --first-hits"):
        measure_card("wskp3", tmp_path)
    for row in content["rows"]:
        row["weights"] = row["weights"] and "runs/train/wskp3-quick/weights.safetensors"
    write_json(results, content)
    with pytest.raises(BadInput, match="no results of"):
        measure_card("wskp3", tmp_path)
    write_json(results, content | {"rows": [row for row in content["rows"] if row["denoiser"] == "noisy"]})
    with pytest.raises(BadInput, match="no results of"):
        measure_card("wskp3", tmp_path)
    shutil.rmtree(tmp_path / "eval")
    with pytest.raises(BadInput, match="there are no results"):
        measure_card("wskp3", tmp_path)
    assert "old" not in wskp3.with_suffix(".md").read_text()
