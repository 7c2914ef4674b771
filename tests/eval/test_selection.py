"""Who runs and who does not, and what a description of a denoiser tells before anything is built."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from errors import BadInput
from eval import selection
from eval.selection import choose, evaluated, untrained, weights_file, weights_of, with_indirect_baselines
from models.extra_denoisers import EXTRA
from models.registry import DENOISERS, create
from models.spec import (
    PRECISIONS,
    DenoiserSpec,
    class_of,
    create_any,
    precision_in_use,
    precisions_of,
    split_name,
    with_budget,
)
from models.weights import save_weights
from train.task import WEIGHTS_FILE, run_folder

NAMES = (
    *(*DENOISERS, *EXTRA, "svgf+taa", "wskp3+taa", "wskp3+adaptive", "eaw+adaptive+taa"),
    *("wskp3@quick", "rae@tiny+taa", "wskp6@quick+adaptive"),
)


def not_mine(name: str) -> str | None:
    return "it is another's" if name != "one" else None


def left_handed(name: str) -> str | None:
    return "it is left-handed" if name.startswith("l") else None


def test_of_all_those_who_can_and_a_word_on_the_others(capsys):
    assert choose([], ["svgf", "one", "one"], not_mine) == ["one"]
    assert capsys.readouterr().out == "svgf: skipped, it is another's\n"


def test_what_takes_seconds_a_frame_waits_to_be_named(capsys):
    assert choose([], ["svgf", "nfor"]) == ["svgf"]
    assert capsys.readouterr().out == "nfor: skipped, it takes seconds a frame: name it to run it\n"
    assert choose(["nfor"], ["svgf"]) == ["nfor"]


def test_those_with_the_same_in_their_way_share_a_line(capsys):
    assert choose([], ["kp", "rae", "svgf"], lambda n: f"no {n}.weights" if n != "svgf" else None) == ["svgf"]
    assert capsys.readouterr().out == "kp, rae: skipped, no NAME.weights\n"


def test_whoever_is_named_must_be_able_to(capsys):
    assert choose(["right", "up", "right"], ["left"], left_handed) == ["right", "up"]
    with pytest.raises(BadInput, match="left: it is left-handed"):
        choose(["right", "left"], ["right"], left_handed)
    assert capsys.readouterr().out == ""


def test_a_network_without_weights_is_told_how_to_get_some(tmp_path, shipped):
    assert untrained(tmp_path, "tiny", "svgf") is None and weights_file("svgf", tmp_path, "tiny") is None
    for name, command in (("rae+taa", "onespp train rae --budget tiny"), ("wskp6-2w", "onespp ablate wskp-windows")):
        path = weights_file(name, tmp_path, "tiny")
        reason = untrained(tmp_path, "tiny", name)
        assert str(path) in reason and command in reason
        path.parent.mkdir(parents=True)
        path.write_bytes(b"")
        assert untrained(tmp_path, "tiny", name) is None
    assert "onespp train kp --budget release" in untrained(tmp_path, "tiny", "kp@release+adaptive")
    with pytest.raises(BadInput, match="unknown denoiser 'magic'"):
        evaluated(["magic"], tmp_path, "tiny")


@pytest.mark.parametrize(
    ("name", "denoiser", "budget"),
    [
        ("wskp6@quick", "wskp6", "quick"),
        ("wskp6@quick+adaptive", "wskp6+adaptive", "quick"),
        ("ntd-b@my-own+adaptive+taa", "ntd-b+adaptive+taa", "my-own"),
    ],
)
def test_names_with_a_budget(name, denoiser, budget):
    assert split_name(name) == (denoiser, budget) and with_budget(denoiser, budget) == name
    assert split_name(denoiser) == (denoiser, None)


@pytest.mark.parametrize(
    "name", ["svgf@quick", "wskp6-2w@quick", "magic@quick", "wskp6@", "@quick", "wskp6+adaptive@quick", "kp@a@b"]
)
def test_names_with_a_budget_that_mean_nothing(name, tmp_path):
    with pytest.raises(BadInput, match="unknown denoiser"):
        weights_of(name, tmp_path)


def write_weights(name: str, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_weights(create(name), name, {}, path)
    return path


def test_shipped_weights_come_first_unless_a_budget_is_named(tmp_path, shipped):
    trained = write_weights("wskp3", run_folder(tmp_path, "wskp3", "quick") / WEIGHTS_FILE)
    assert weights_of("wskp3", tmp_path) == weights_of("wskp3@quick", tmp_path) == trained
    ours = write_weights("wskp3", shipped / "wskp3.safetensors")
    for around in ("", "+adaptive", "+adaptive+taa"):
        assert weights_of(f"wskp3{around}", tmp_path) == ours
        assert weights_of(f"wskp3@quick{around}", tmp_path) == trained
    assert weights_of("wskp3", tmp_path / "elsewhere") == ours and weights_of("svgf", tmp_path) is None
    with pytest.raises(BadInput, match=r"wskp3@tiny: it has no weights at .*--budget tiny"):
        weights_of("wskp3@tiny", tmp_path)


def test_all_are_the_shipped_ones_and_what_was_trained_beside_them(tmp_path, shipped, monkeypatch, capsys):
    few = {name: DENOISERS[name] for name in ("noisy", "rae", "wskp3", "wskp6", "kp")}
    monkeypatch.setattr(selection, "DENOISERS", few)
    ours = {name: write_weights(name, shipped / f"{name}.safetensors") for name in ("wskp3", "wskp6")}
    trained = {name: write_weights(name, run_folder(tmp_path, name, "tiny") / WEIGHTS_FILE) for name in ("wskp6", "kp")}
    assert [(spec.name, spec.weights) for spec in evaluated([], tmp_path, "tiny")] == [
        ("noisy", None),
        ("wskp3", ours["wskp3"]),
        ("wskp6", ours["wskp6"]),
        ("wskp6@tiny", trained["wskp6"]),
        ("kp", trained["kp"]),
        ("wskp6+adaptive", ours["wskp6"]),
        ("wskp6@tiny+adaptive", trained["wskp6"]),
    ]
    assert capsys.readouterr().out.startswith("rae: skipped, it has no weights at")  # and nothing of wskp3@tiny
    assert [spec.name for spec in evaluated(["kp@tiny"], tmp_path, "quick")] == ["kp@tiny"]


def test_weights_of_a_budget_are_loaded(tmp_path):
    """Each network has its own, and both are the same code."""
    torch.manual_seed(1)
    first, second = (write_weights("wskp3", tmp_path / name) for name in ("a", "b"))
    plain, other = DenoiserSpec("wskp3+taa", weights=first), DenoiserSpec("wskp3@tiny+taa", weights=second)
    assert plain.modules == other.modules and other.label == "wskp3@tiny+taa"
    a, b = (list(spec.build().parameters()) for spec in (plain, other))
    assert len(a) == len(b) and not torch.equal(a[0], b[0])
    again = list(DenoiserSpec("wskp3@tiny+taa", weights=first).build().parameters())
    assert all(map(torch.equal, a, again))


def test_baselines_join_whoever_returns_indirect_light():
    specs = [DenoiserSpec("noisy"), DenoiserSpec("eaw")]
    assert with_indirect_baselines(specs) == specs
    together = with_indirect_baselines([*specs, DenoiserSpec("ntd")])
    assert [(spec.name, spec.returns) for spec in together] == [
        ("noisy", "total"),
        ("eaw", "total"),
        ("ntd", "indirect"),
        ("noisy", "indirect"),
    ]


@pytest.mark.parametrize("name", NAMES)
def test_facts_of_the_class_are_those_of_the_built_denoiser(name):
    kind = class_of(name)
    denoiser = create_any(name)
    assert isinstance(denoiser, kind)
    assert set(denoiser.reads) == set(kind.reads) and denoiser.signal == kind.signal
    assert denoiser.refuses == kind.refuses and kind.is_network == (denoiser.parameter_count() > 0)
    assert precision_in_use(name) in precisions_of(name)
    assert create_any(name, "indirect").signal == "indirect"


def test_names_of_the_ways_to_run():
    svgf = DenoiserSpec("svgf")
    assert (svgf.way, replace(svgf, signal="indirect").way) == ("svgf", "svgf (indirect)")
    assert replace(svgf, compiled=False).way == "svgf (PyTorch)"
    assert DenoiserSpec("ntd", signal="indirect").way == "ntd"
    assert DenoiserSpec("rae", precision="bfloat16").label == "rae-bfloat16"


def test_fresh_weights_are_always_the_same():
    first, second = (DenoiserSpec("wskp3", precision="bfloat16").build() for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    assert first.precision == PRECISIONS["bfloat16"]
