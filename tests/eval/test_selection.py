"""Which denoisers run, and the facts that a spec gives before anything is built."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from errors import BadInput
from eval import selection
from eval.selection import (
    choose,
    evaluated,
    lacks_channels,
    untrained,
    weights_file,
    weights_of,
    with_indirect_baselines,
)
from models.registry import DENOISERS, DenoiserName, create, parse_name, prototype
from models.spec import DenoiserSpec
from models.weights import save_weights
from train.task import WEIGHTS_FILE, run_folder

ONE, SVGF, RAE, KP, NFOR = map(parse_name, ("one", "svgf", "rae", "kp", "nfor"))


def only_one(name: DenoiserName) -> str | None:
    return "it is not ours" if name != ONE else None


def test_choose_all_that_can_run_and_print_the_others(capsys):
    assert choose([], [SVGF, ONE, ONE], only_one) == [ONE]
    assert capsys.readouterr().out == "svgf: skipped, it is not ours\n"


def test_offline_denoisers_run_only_where_named(capsys):
    assert choose([], [SVGF, NFOR]) == [SVGF]
    assert capsys.readouterr().out == "nfor: skipped, it takes seconds a frame: name it to run it\n"
    assert choose(["nfor"], [SVGF]) == [NFOR]


def test_denoisers_skipped_for_one_reason_share_a_line(capsys):
    assert choose([], [KP, RAE, SVGF], lambda name: f"no {name}.weights" if name != SVGF else None) == [SVGF]
    assert capsys.readouterr().out == "kp, rae: skipped, no NAME.weights\n"


def test_named_denoisers_must_be_able_to_run(capsys):
    assert choose(["one", "one"], [SVGF], only_one) == [ONE]
    with pytest.raises(BadInput, match="svgf: it is not ours"):
        choose(["one", "svgf"], [ONE], only_one)
    assert capsys.readouterr().out == ""


def test_the_message_on_a_network_without_weights_names_the_training_command(tmp_path, shipped):
    assert untrained(tmp_path, "tiny", SVGF) is None and weights_file(SVGF, tmp_path, "tiny") is None
    name = parse_name("rae+taa")
    path = weights_file(name, tmp_path, "tiny")
    reason = untrained(tmp_path, "tiny", name)
    assert str(path) in reason and "onespp train rae --budget tiny" in reason
    with pytest.raises(BadInput, match="onespp train rae --budget tiny"):
        evaluated(["rae"], tmp_path, "tiny")
    path.parent.mkdir(parents=True)
    path.write_bytes(b"")
    assert untrained(tmp_path, "tiny", name) is None
    assert "onespp train kp --budget release" in untrained(tmp_path, "tiny", parse_name("kp@release+adaptive"))


def test_denoisers_that_a_clip_has_too_few_channels_for(tmp_path, capsys):
    """As of imported data sets, which have no gradient; sample buffers are optional."""
    clip = SimpleNamespace(path=tmp_path / "room", channels=set(prototype("svgf").reads), is_imported=True)
    ready = {spec.name for spec in evaluated([], tmp_path, "tiny", clips=[clip])}
    assert "svgf" in ready and "asvgf" not in ready
    assert evaluated(["svgf+js"], tmp_path, "tiny", clips=[clip])
    assert f"asvgf: skipped, {clip.path} has no gradient" in capsys.readouterr().out
    with pytest.raises(BadInput, match=r"trmv: .*room has no roughness and no dual_motion and no .*onespp dataset"):
        evaluated(["svgf", "trmv"], tmp_path, "tiny", clips=[clip])
    assert lacks_channels([clip], parse_name("ntd")) == f"{clip.path} was imported and has no indirect light"


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("svgf", DenoiserName("svgf")),
        ("wskp6@quick", DenoiserName("wskp6", "quick")),
        ("wskp6@quick+adaptive", DenoiserName("wskp6", "quick", ("adaptive",))),
        ("ntd-b@my-own+adaptive+taa", DenoiserName("ntd-b", "my-own", ("adaptive", "taa"))),
        ("kp+js", DenoiserName("kp", None, ("js",))),
    ],
)
def test_names_are_parsed_into_their_parts(text, name):
    assert parse_name(text) == name and str(name) == text
    assert parse_name(name) is name


@pytest.mark.parametrize(
    "text",
    ["svgf@quick", "magic@quick", "wskp6@", "@quick", "wskp6+adaptive@quick", "kp@a@b", "svgf+", "svgf+magic", ""],
)
def test_names_of_no_denoiser(text):
    with pytest.raises(BadInput, match="denoiser"):
        parse_name(text)


def write_weights(name: str, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    save_weights(create(name), name, {}, path)
    return path


def test_shipped_weights_come_first_unless_a_budget_is_named(tmp_path, shipped):
    trained = write_weights("wskp3", run_folder(tmp_path, "wskp3", "quick") / WEIGHTS_FILE)
    assert weights_of(parse_name("wskp3"), tmp_path) == weights_of(parse_name("wskp3@quick"), tmp_path) == trained
    ours = write_weights("wskp3", shipped / "wskp3.safetensors")
    for wrappers in ("", "+adaptive", "+adaptive+taa"):
        assert weights_of(parse_name(f"wskp3{wrappers}"), tmp_path) == ours
        assert weights_of(parse_name(f"wskp3@quick{wrappers}"), tmp_path) == trained
    assert weights_of(parse_name("wskp3"), tmp_path / "elsewhere") == ours and weights_of(SVGF, tmp_path) is None
    with pytest.raises(BadInput, match=r"wskp3@tiny: it has no weights at .*--budget tiny"):
        weights_of(parse_name("wskp3@tiny"), tmp_path)


def test_the_default_includes_shipped_networks_and_those_trained_here(tmp_path, shipped, monkeypatch, capsys):
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
    plain, other = DenoiserSpec.named("wskp3+taa", weights=first), DenoiserSpec.named("wskp3@tiny+taa", weights=second)
    assert plain.modules == other.modules and other.label == "wskp3@tiny+taa"
    a, b = (list(spec.build().parameters()) for spec in (plain, other))
    assert len(a) == len(b) and not torch.equal(a[0], b[0])
    again = list(DenoiserSpec.named("wskp3@tiny+taa", weights=first).build().parameters())
    assert all(map(torch.equal, a, again))


def test_baselines_of_indirect_light_are_added():
    specs = [DenoiserSpec.named("noisy"), DenoiserSpec.named("eaw")]
    ntd = DenoiserSpec.named("ntd")
    assert with_indirect_baselines(specs) == specs and with_indirect_baselines([ntd]) == [ntd]
    together = with_indirect_baselines([*specs, ntd])
    expected = [("noisy", "total"), ("eaw", "total"), ("ntd", "indirect"), ("noisy", "indirect")]
    assert [(spec.name, spec.returns) for spec in together] == expected
