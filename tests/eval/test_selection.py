"""Who runs and who does not, and what a description of a denoiser tells before anything is built."""

from dataclasses import replace

import pytest
import torch

from errors import BadInput
from eval.extra_denoisers import EXTRA
from eval.selection import choose, evaluated, untrained, weights_file, with_indirect_baselines
from eval.spec import PRECISIONS, DenoiserSpec, class_of, create_any, precision_in_use, precisions_of
from models.registry import DENOISERS

NAMES = (*DENOISERS, *EXTRA, "svgf+taa", "wskp3+taa", "wskp3+adaptive", "eaw+adaptive+taa")


def left_handed(name: str) -> str | None:
    return "it is left-handed" if name.startswith("l") else None


def test_of_all_those_who_can_and_a_word_on_the_others(capsys):
    assert choose([], ["left", "right", "right"], left_handed) == ["right"]
    assert capsys.readouterr().out == "left: skipped, it is left-handed\n"


def test_those_with_the_same_in_their_way_share_a_line(capsys):
    assert choose([], ["kp", "rae", "svgf"], lambda n: f"no {n}.weights" if n != "svgf" else None) == ["svgf"]
    assert capsys.readouterr().out == "kp, rae: skipped, no NAME.weights\n"


def test_whoever_is_named_must_be_able_to(capsys):
    assert choose(["right", "up", "right"], ["left"], left_handed) == ["right", "up"]
    with pytest.raises(BadInput, match="left: it is left-handed"):
        choose(["right", "left"], ["right"], left_handed)
    assert capsys.readouterr().out == ""


def test_a_network_without_weights_is_told_how_to_get_some(tmp_path):
    assert untrained(tmp_path, "tiny", "svgf") is None and weights_file("svgf", tmp_path, "tiny") is None
    for name, command in (("rae+taa", "onespp train rae --budget tiny"), ("wskp6-2w", "onespp ablate wskp-windows")):
        path = weights_file(name, tmp_path, "tiny")
        reason = untrained(tmp_path, "tiny", name)
        assert str(path) in reason and command in reason
        path.parent.mkdir(parents=True)
        path.write_bytes(b"")
        assert untrained(tmp_path, "tiny", name) is None
    with pytest.raises(BadInput, match="unknown denoiser 'magic'"):
        evaluated(["magic"], tmp_path, "tiny")


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
