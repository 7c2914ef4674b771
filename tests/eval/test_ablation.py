"""Ablations: variants differ in what they should and in nothing else; one small run from training to plot."""

import inspect
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch
from torch import nn

import command_line
from datasets.clip import Clip, Dataset
from datasets.frame import Frame, read_frame
from datasets.sequences import REFERENCES
from errors import BadInput
from eval.ablation.definitions import ABLATIONS, AblationVariant, Finding, ablation_for
from eval.ablation.plots import ablation_figure
from eval.ablation.run import ablate, clips_to_judge, epoch_losses, fusion_ms, meshes_move, trained
from eval.ablation.summary import ablation_table, finding_verdict, seed_mean_text
from eval.ablation.textured_rae import TexturedRAE
from eval.ablation.variant_run import VariantRun
from models.ntd import NTD
from models.parameters import WINDOWS
from models.rae import RAE
from models.wskp import WSKP
from plotting import plt
from timing import thread_count
from train import training
from train.losses.rae import RAELoss, RAETerms
from train.recipe import Recipe
from train.recipes import recipe_for


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """On images this small further threads only wait."""
    with thread_count(1):
        yield


def frames_of(tiny, reads, count: int = 2) -> list[Frame]:
    clip = next(clip for clip in Dataset(tiny).clips("test") if meshes_move(clip))
    return [read_frame(clip, index, reads) for index in range(count)]


def made_up(what: str, value, seeds: int = 2) -> list[VariantRun]:
    """Runs of all variants whose metrics are value(index of the variant, seed)."""
    metrics = ("psnr", "ssim", "rmse", "flip", "temporal_error", "disocclusion_l1")
    runs = []
    for index, variant in enumerate(ablation_for(what).variants):
        for seed in range(seeds):
            x = value(index, seed)
            clips = {"scene/0": dict.fromkeys(metrics, x)}
            runs.append(VariantRun(variant.label, seed, 7, [None, x], clips, x))
    return runs


# --- The variants -----------------------------------------------------------------------------------------------------


def test_an_unknown_ablation_or_budget_is_refused(tiny, tmp_path):
    with pytest.raises(BadInput, match=r"'widths'.*rae-inputs, rae-loss, wskp-windows"):
        ablate("widths", tiny, tmp_path, "tiny")
    with pytest.raises(BadInput, match="unknown budget 'huge'"):
        ablate("ntd", tiny, tmp_path, "huge")
    with pytest.raises(BadInput, match="0 seeds"):
        ablate("ntd", tiny, tmp_path, "tiny", seeds=0)
    assert not list(tmp_path.iterdir())


def test_the_command_line_knows_all_ablations():
    literal = get_args(inspect.signature(command_line.ablate).parameters["what"].annotation)[0]
    assert get_args(literal) == tuple(ABLATIONS)


@pytest.mark.parametrize("what", ABLATIONS)
def test_every_ablation_can_be_trained_and_run(tiny, what):
    chosen = ablation_for(what)
    labels = [variant.label for variant in chosen.variants]
    assert len(set(labels)) == len(labels)
    assert {label for finding in chosen.findings for pair in finding.pairs for label in pair} <= set(labels)
    for variant in chosen.variants:
        recipe = variant.recipe("quick")
        whole = recipe_for(variant.base, "quick")
        assert recipe == replace(whole, epochs=whole.epochs // 4, loss=recipe.loss)
        torch.manual_seed(0)
        denoiser = variant.create()
        assert recipe.loss.around(denoiser).terms == recipe.loss
        denoiser.prepare()
        state = None
        for frame in frames_of(tiny, denoiser.reads):
            output, state = denoiser(frame, state)
            assert torch.isfinite(output).all() and (output >= 0).all()


def test_inputs_of_rae_are_added_one_by_one():
    networks = [variant.create() for variant in ablation_for("rae-inputs").variants]
    assert [network.network.first.in_channels for network in networks] == [3, 3, 5, 6, 7]
    assert [isinstance(network, TexturedRAE) for network in networks] == [True, False, False, False, False]
    assert "normal" not in networks[1].reads and "normal" in networks[2].reads and "roughness" not in networks[3].reads
    assert networks[4].reads == RAE.reads == RAE().reads


def test_the_default_rae_is_as_it_was(tiny):
    """Channels in the order that trained weights know; fewer are the same network with the others' weights at zero."""
    torch.manual_seed(0)
    (frame,) = frames_of(tiny, RAE.reads, 1)
    whole = RAE()
    seen = []
    whole.network.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0]))
    _, state = whole.predict(frame, None)
    torch.testing.assert_close(seen[0][:, 3:5], frame.view_normal()[:, :2])
    torch.testing.assert_close(seen[0][:, 5:6], state.scale.normalised_depth(frame.depth))
    torch.testing.assert_close(seen[0][:, 6:], frame.roughness)

    part = RAE(("normal",))
    weights = whole.state_dict()
    part.load_state_dict(weights | {"network.first.weight": weights["network.first.weight"][:, :5]})
    with torch.no_grad():
        whole.network.first.weight[:, 5:] = 0
    torch.testing.assert_close(part.predict(frame, None)[0], whole.predict(frame, None)[0], atol=1e-5, rtol=1e-5)


def as_plain(textured: TexturedRAE) -> RAE:
    """RAE with the same weights."""
    plain = RAE(())
    plain.load_state_dict(textured.state_dict())
    plain.prepare()
    return plain


def test_textured_rae_denoises_radiance(tiny):
    (frame,) = frames_of(tiny, (*RAE.reads, *REFERENCES), 1)
    textured = TexturedRAE(())
    textured.prepare()
    reference = (frame.direct_reference + frame.indirect_reference).mean(dim=1)
    torch.testing.assert_close(textured.target(frame), reference)
    coloured = replace(frame, channels=frame.channels | {"albedo": torch.rand_like(frame.albedo)})
    torch.testing.assert_close(textured(coloured, None)[0], textured(frame, None)[0])
    torch.testing.assert_close(textured.predict(coloured, None)[0], textured.predict(frame, None)[0])
    assert not torch.allclose(textured.predict(frame, None)[0], as_plain(textured).predict(frame, None)[0])


def test_terms_of_raes_loss_are_added_one_by_one():
    terms = [variant.recipe("quick").loss for variant in ablation_for("rae-loss").variants]
    assert [(t.spatial, t.gradient, t.temporal) for t in terms] == [(0.8, 0, 0), (0.8, 0.1, 0), (0.8, 0.1, 0.1)]
    assert isinstance(ablation_for("rae-loss").variants[0].recipe("quick").loss.around(RAE()), RAELoss)
    assert terms[2] == recipe_for("rae", "paper").loss == RAETerms()


def test_windows_stand_alone_and_together():
    networks = [variant.create() for variant in ablation_for("wskp-windows").variants]
    windows = [network.windows for network in networks]
    assert windows[:6] == [(3,), (5,), (7,), (9,), (11,), (13,)]
    assert windows[6:] == [WINDOWS[:count] for count in range(2, 7)]
    assert all(network.network[-1].kernel()[1].numel() == 2 * len(network.windows) for network in networks)


def test_without_repvgg_there_is_one_convolution_a_layer():
    sizes = {
        variant.label: [{c.kernel_size[0] for c in layer.branches} for layer in variant.create().network]
        for variant in ablation_for("wskp-repvgg").variants
    }
    assert sizes["wskp6"] == sizes["kp"] == [{1, 3, 5}] * 6
    assert sizes["wskp6-plain"] == sizes["kp-plain"] == [{5}] * 6


def test_ntd_differs_in_vectors_and_loss():
    chosen = {v.label: (v.create(), v.recipe("quick").loss) for v in ablation_for("ntd").variants}
    assert all(isinstance(network, NTD) for network, _ in chosen.values())
    assert {label: network.vectors for label, (network, _) in chosen.items()} == {
        "ntd-a": "motion",
        "ntd-b": "dual_motion",
        "ntd": "dual_motion",
    }
    assert [loss.occlusion for _, loss in chosen.values()] == [0, 0, 1]


# --- What comes out ---------------------------------------------------------------------------------------------------


class WithoutMotion(Dataset):
    def clips(self, split: str) -> list[Clip]:
        return [clip for clip in super().clips(split) if not meshes_move(clip)]


def test_ntd_is_judged_where_meshes_move(tiny):
    dataset = Dataset(tiny)
    assert {clip.scene: meshes_move(clip) for clip in dataset.clips("test")} == {
        "cornell_box": False,
        "cornell_box_moving": True,
    }
    assert [clip.scene for clip in clips_to_judge(dataset, ablation_for("ntd"))] == ["cornell_box_moving"]
    assert len(clips_to_judge(dataset, ablation_for("rae-loss"))) == 2
    with pytest.raises(BadInput, match="nothing moves in the test clips of"):
        clips_to_judge(WithoutMotion(tiny), ablation_for("ntd"))


def test_losses_are_means_of_epochs(tmp_path):
    metrics = tmp_path / "metrics.csv"
    metrics.write_text("step,loss,val_loss\n1,4,\n2,2,\n3,nan,\n4,1,\n5,nan,\n6,nan,0.5\n")
    assert epoch_losses(metrics, 3) == [3.0, 1.0, None]


def test_findings_are_held_to_the_means_over_seeds():
    finding = Finding("B beats A", "psnr", (("wskp6", "wskp6-plain"),))
    runs = made_up("wskp-repvgg", lambda index, seed: 10.0 + index + 4 * seed * (index == 0))
    assert seed_mean_text(runs, "wskp6-plain", "psnr") == "12.00 ± 2.83"
    wrong = "does not hold in 1 of 1: wskp6 11.00 ± 0.00 is no better than wskp6-plain 12.00 ± 2.83"
    assert finding_verdict(finding, runs) == f"{wrong} (seed by seed: in 1 of 2)"
    assert finding_verdict(finding, [run for run in runs if run.seed == 0]) == "holds"
    assert finding_verdict(replace(finding, metric="rmse"), runs) == "holds (seed by seed: in 1 of 2)"
    undefined = made_up("wskp-repvgg", lambda index, seed: None)
    assert (
        finding_verdict(finding, undefined) == "not defined on these clips"
        and seed_mean_text(undefined, "kp", "psnr") == "-"
    )


@pytest.mark.parametrize("what", ABLATIONS)
@pytest.mark.parametrize("seeds", [1, 2])
def test_every_ablation_has_a_table_and_a_plot(what, seeds):
    ablation = ablation_for(what)
    runs = made_up(what, lambda index, seed: 1.0 + index + seed / 8, seeds)
    figure = ablation_figure(ablation, runs, "title")
    figure.canvas.draw()
    plt.close(figure)
    text = ablation_table(ablation, runs, "github")
    assert all(variant.label in text and variant.paper in text for variant in ablation.variants)
    assert all(finding.text in text for finding in ablation.findings)


def test_the_fusion_of_all_is_timed(tiny):
    variants = ablation_for("wskp-repvgg").variants
    torch.manual_seed(0)
    denoisers = {variant.label: variant.create() for variant in variants}
    for denoiser in denoisers.values():
        denoiser.prepare()
    times = fusion_ms(denoisers, Dataset(tiny).clips("test")[0], measured=1, warm_up=0)
    assert times.keys() == denoisers.keys() and all(ms > 0 for ms in times.values())


class SmallVariant(AblationVariant):
    """Trained in one step on one crop of each frame."""

    def recipe(self, budget: str) -> Recipe:
        return replace(super().recipe(budget), crops=(1, 1), batch=64)


def modified(folder: Path) -> dict[str, int]:
    """When what a training writes was last written, by file."""
    names = ("checkpoint.pt", "metrics.csv", "weights.safetensors")
    return {str(path): path.stat().st_mtime_ns for name in names for path in sorted(folder.glob(f"*/{name}"))}


def test_an_ablation_from_training_to_plot(tiny, tmp_path, monkeypatch):
    """A second call trains nothing, another seed only what is new, and all in one precision."""
    whole = ablation_for("wskp-repvgg")
    small = replace(
        whole,
        variants=tuple(SmallVariant(**vars(variant)) for variant in whole.variants[:2]),
        metrics=("psnr", "fusion_ms"),
        findings=(Finding("it helps", "psnr", (("wskp6", "wskp6-plain"),)),),
    )
    monkeypatch.setitem(ABLATIONS, "wskp-repvgg", lambda: small)
    measured: list[str] = []
    monkeypatch.setattr(training, "fastest_precision", lambda *_: measured.append("once") or "float32")
    folder = tmp_path / "ablation" / "wskp-repvgg"

    text = ablate("wskp-repvgg", tiny, tmp_path, "tiny")
    first = modified(folder)
    assert {Path(path).parent.name for path in first} == {"wskp6-plain-0", "wskp6-0"} and len(first) == 6
    assert measured == ["once"]
    assert "budget tiny, 1 epochs (25% of its own), seeds: 1" in text and "34.600 / 0.9830" in text
    assert (folder / "plot.png").read_bytes().startswith(b"\x89PNG") and "| wskp6 " in (folder / "table.md").read_text()
    assert (tmp_path / "accumulated").is_dir()
    content = json.loads((folder / "results.json").read_text())
    assert [(row["variant"], row["seed"], len(row["losses"])) for row in content["rows"]] == [
        ("wskp6-plain", 0, 1),
        ("wskp6", 0, 1),
    ]
    assert all(row["fusion_ms"] > 0 and len(row["clips"]) == 2 for row in content["rows"])
    trained(small.variants[0], folder / "wskp6-plain-0" / "weights.safetensors")

    ablate("wskp-repvgg", tiny, tmp_path, "tiny")
    again = json.loads((folder / "results.json").read_text())
    assert modified(folder) == first
    assert [row["clips"] for row in again["rows"]] == [row["clips"] for row in content["rows"]]
    assert "±" in ablate("wskp-repvgg", tiny, tmp_path, "tiny", seeds=2)
    second = modified(folder)
    assert {Path(path).parent.name for path in second.keys() - first.keys()} == {"wskp6-plain-1", "wskp6-1"}
    assert second.items() >= first.items() and measured == ["once"]


def test_plain_is_without_identity():
    assert not any(isinstance(m, nn.Identity) or getattr(m, "has_identity", False) for m in WSKP(sizes=(5,)).modules())
