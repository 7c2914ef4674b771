"""The stress bench reports exactly what a broken denoiser breaks, and lets a sound one pass."""

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from command_line import main
from datasets.frame import Frame
from errors import BadInput
from eval.stress.cases import (
    LIGHT_CHANNELS,
    LONG_CASE,
    NOISE_PERIOD,
    RECOVERY_LIMIT,
    SPOILED_FRAME,
    STRESS_CASES,
    SURFACE_CHANNELS,
    StressCase,
)
from eval.stress.check import FRESH, MAX_RESIDUE, StressCheck, StressRow, largest_logits, last_layers, range_violation
from eval.stress.run import applies, cases_in, check_all, heat_map, stressed, verdict_text, weights_label
from models import registry
from models.denoiser import Denoiser, State
from models.spec import DenoiserSpec
from plotting import plt
from tests.eval.conftest import untrained
from tests.test_cli import fails

NAMES = [case.name for case in STRESS_CASES]
CASES = {case.name: case for case in STRESS_CASES}
IN_LIGHT = [case.name for case in STRESS_CASES if case.poison and case.poison.channels == LIGHT_CHANNELS]
KEYS = {"denoiser", "weights", "extreme", "error", "nonfinite", "violation", "recovery", "broken"}

Check = Callable[..., list[StressRow]]


def simple(answer: Callable[[Tensor, Frame], Tensor], repaired: bool, is_convex: bool = False) -> type[Denoiser]:
    """Makes its answer of the noisy radiance alone, with bad pixels as they come or repaired."""

    class Simple(Denoiser):
        reads = LIGHT_CHANNELS
        convex = is_convex

        def __call__(self, frame, state):
            return self.forward(frame.finite() if repaired else frame, state)

        def forward(self, frame, state):
            return answer(frame.radiance("total"), frame), State(frame.moment)

    return Simple


GOES_NEGATIVE = simple(lambda radiance, _: radiance - 1e-9, repaired=True)


@dataclass(frozen=True)
class Mean(State):
    radiance: torch.Tensor


class Remembers(Denoiser):
    """An exponential mean that gives the newest frame a weight of `alpha`."""

    reads = LIGHT_CHANNELS
    alpha = 0.01

    def forward(self, frame, state):
        radiance = frame.radiance("total")
        if isinstance(state, Mean):
            radiance = torch.lerp(state.radiance, radiance, self.alpha)
        return radiance, Mean(frame.moment, radiance)


class FadesByHalf(Remembers):
    alpha = 0.5


class GrowsBrighter(Denoiser):
    """By 1 % from frame to frame."""

    reads = LIGHT_CHANNELS

    def forward(self, frame, state):
        factor = 1.01 * state.radiance if isinstance(state, Mean) else torch.ones(1)
        return factor * frame.radiance("total"), Mean(frame.moment, factor)


@pytest.fixture
def check(monkeypatch) -> Check:
    """Take a class through cases, by default all, as a denoiser."""

    def run(kind: type[Denoiser], cases: Sequence[StressCase] = STRESS_CASES) -> list[StressRow]:
        monkeypatch.setitem(registry.DENOISERS, "broken", kind)
        return check_all([DenoiserSpec.named("broken")], cases)

    return run


# --- The command ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "code", "printed"),
    [("accumulated", 0, "All requirements are kept."), ("broken", 1, "Broken requirements:")],
)
def test_exit_code_and_files(tmp_path, monkeypatch, capsys, name, code, printed):
    monkeypatch.setitem(registry.DENOISERS, "broken", GOES_NEGATIVE)
    try:
        main(["stress", name, "--runs", str(tmp_path)])
        ended = 0
    except SystemExit as end:
        ended = end.code
    assert ended == code and printed in capsys.readouterr().out
    results = json.loads((tmp_path / "stress" / "results.json").read_text())
    assert (results["schema"], results["device"], results["precision"]) == (1, "cpu, 1 thread", "float32")
    assert results["versions"]["torch"] == torch.__version__
    rows = results["rows"]
    assert all(row.keys() == KEYS and row["denoiser"] == name for row in rows)
    assert any(row["broken"] for row in rows) == bool(code)
    table = (tmp_path / "stress" / "table.md").read_text()
    assert all(f"| {row['extreme']} " in table for row in rows)
    with Image.open(tmp_path / "stress" / "errors.png") as picture:
        picture.verify()


def test_a_precision_that_no_denoiser_has_is_refused(capsys, tmp_path):
    message = fails(capsys, "stress", "svgf", "--precision", "bfloat16", "--runs", str(tmp_path))
    assert "none of svgf computes in bfloat16" in message


def test_weights_are_named(tmp_path, shipped):
    """Fresh ones where there are no trained ones; those of a budget that is named must be there."""
    with pytest.raises(BadInput, match="wskp3@tiny: it has no weights at"):
        stressed(["wskp3@tiny"], tmp_path, "quick")
    network, classical = stressed(["wskp3", "accumulated"], tmp_path, "tiny")
    assert (weights_label(network), weights_label(classical)) == (FRESH, None)
    path = untrained(tmp_path, "wskp3")
    (network,) = stressed(["wskp3"], tmp_path, "tiny")
    assert weights_label(network) == str(path)
    (case,) = check_all(stressed(["wskp3@tiny"], tmp_path, "quick"), [CASES["1 x 1 px"]])
    assert (case.denoiser, case.weights) == ("wskp3@tiny", str(path))


def test_cases_apply_to_precisions_and_logits_that_a_denoiser_has():
    def taken_by(name: str) -> set[str]:
        spec = DenoiserSpec.named(name)
        return {case for case in ("logits to ±1e4", "bfloat16", "float16") if applies(CASES[case], spec)}

    assert taken_by("wskp3") == taken_by("wskp-mr") == taken_by("kp") == {"logits to ±1e4", "bfloat16", "float16"}
    assert taken_by("ntd") == {"logits to ±1e4", "bfloat16"}
    assert taken_by("rae") == {"bfloat16", "float16"}
    assert taken_by("svgf") == set()


def test_cases_of_half_precision_and_the_long_sequence():
    assert cases_in("float32", long=False) == list(STRESS_CASES)
    assert cases_in("float32", long=True) == [*STRESS_CASES, LONG_CASE]
    half = cases_in("bfloat16", long=True)
    assert {case.precision for case in half} == {"bfloat16"}
    assert [case.name for case in half] == [*(name for name in NAMES if "float1" not in name), LONG_CASE.name]


def test_heat_map():
    cases = STRESS_CASES[:2]
    rows = [
        StressRow("noisy", None, cases[0].name, 0.01, 0, 0.0, None, ()),
        StressRow("noisy", None, cases[1].name, None, 3, 0.0, None, ("finite",)),
    ]
    figure = heat_map(rows, cases)
    axes = figure.axes[0]
    errors = np.ma.filled(axes.images[0].get_array(), np.nan)
    np.testing.assert_allclose(errors, [[-2, np.nan]])
    assert [(*line.get_xdata(), *line.get_ydata()) for line in axes.lines] == [(1, 0)]
    assert [label.get_text() for label in axes.get_xticklabels()] == [case.name for case in cases]
    plt.close(figure)


# --- Broken denoisers -------------------------------------------------------------------------------------------------


def spreading(value: float) -> type[Denoiser]:
    """One bad pixel makes `value` of the whole image."""
    return simple(
        lambda radiance, _: radiance if torch.isfinite(radiance).all() else torch.full_like(radiance, value),
        repaired=False,
    )


def brightening(is_convex: bool) -> type[Denoiser]:
    """By 0.1 % of the irradiance."""
    return simple(lambda radiance, frame: torch.lerp(frame.emission, radiance, 1.001), True, is_convex)


BRIGHT = ["a firefly of 65504", "radiance 6e4", "radiance 1e-7 to 6e4"]
LIT = [name for name in NAMES if name not in ("all black", "no surface at all", "logits to ±1e4")]
OVERFLOWING = simple(lambda radiance, _: torch.where(radiance > 2e4, torch.nan, radiance), repaired=True)
BROKEN = {
    "overflows": (OVERFLOWING, BRIGHT, ("finite",), "finite: outputs are finite where inputs are finite"),
    "spreads black": (spreading(0.0), IN_LIGHT, ("spread",), "spread: "),
    "spreads NaN": (spreading(torch.nan), IN_LIGHT, ("finite", "spread"), "spread: "),
    "keeps bad pixels": (simple(lambda radiance, _: radiance, repaired=False), [], (), "All requirements are kept."),
    "brightens": (brightening(is_convex=False), [], (), "All requirements are kept."),
    "brightens, convex": (brightening(is_convex=True), LIT, ("range",), "range: "),
    "remembers": (Remembers, IN_LIGHT, ("recovery",), f"> {RECOVERY_LIMIT}"),
}


@pytest.mark.parametrize(("kind", "cases", "requirements", "words"), BROKEN.values(), ids=BROKEN)
def test_what_is_broken_is_found_and_nothing_else(check, kind, cases, requirements, words):
    """Of each case the same requirements."""
    rows = check(kind)
    assert {row.extreme: row.broken for row in rows if row.broken} == dict.fromkeys(cases, requirements)
    text = verdict_text(rows, STRESS_CASES)
    assert words in text and ("recovery: " in text) == (kind is Remembers)


def test_negative_light_is_found(check):
    rows = check(GOES_NEGATIVE)
    broken = {row.extreme: row.broken for row in rows if row.broken}
    assert set(broken.values()) == {("range",)} and "all black" in broken
    assert "no other goes below 0" in verdict_text(rows, STRESS_CASES)


def test_recovery_is_counted_in_frames():
    """The mean's error halves from frame to frame."""
    case = CASES[IN_LIGHT[0]]
    row = StressCheck(lambda _: FadesByHalf(), case).row("fading", None)
    frames = list(case.frames())
    whole = frames[0].radiance("total")
    lost = float((whole - frames[SPOILED_FRAME].finite().radiance("total")).abs().max() / whole.max())
    expected = next(n for n in range(100) if lost * 0.5 ** (n + 1) <= MAX_RESIDUE)
    assert row.recovery == expected and row.error == pytest.approx(lost / 2)


def test_long_sequences_show_drift(check):
    long = replace(LONG_CASE, frame_count=4 * NOISE_PERIOD)
    (kept,) = check(FadesByHalf, cases=[long])
    assert kept.error < 1e-6 and kept.broken == ()
    (drifted,) = check(GrowsBrighter, cases=[long])
    assert drifted.error == pytest.approx(1.01 ** (2 * NOISE_PERIOD) - 1, rel=1e-3)


# --- Cases ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", (*STRESS_CASES, replace(LONG_CASE, frame_count=3)), ids=lambda case: case.name)
def test_frames_continue_their_sequence(case: StressCase):
    """So that all states are carried; and only the frames meant to be are not finite."""
    frames = list(case.frames())
    assert len(frames) == case.frame_count and {frame.size for frame in frames} == {case.size}
    for before, frame in pairwise(frames):
        assert frame.follows(before.moment)
    for index, frame in enumerate(frames):
        bad = {name: (~torch.isfinite(tensor)).flatten(0, -3).any(0).sum() for name, tensor in frame.channels.items()}
        spoiled = case.poison.channels if case.poison and index == SPOILED_FRAME else ()
        assert {name: count for name, count in bad.items() if count} == dict.fromkeys(spoiled, 1)


def test_cases_reach_their_values():
    def values(name: str, channel: str, index: int = 0) -> torch.Tensor:
        return list(CASES[name].frames())[index].channels[channel]

    def spans(tensor: torch.Tensor) -> Iterator[float]:
        return (float(value) for value in torch.aminmax(tensor[tensor > 0]))

    low, high = spans(values("depth 1e-4 to 1e6", "depth"))
    assert low < 1e-3 and high > 1e5
    low, high = spans(values("radiance 1e-7 to 6e4", "direct"))
    assert low < 1e-7 and high > 1e4
    assert values("a firefly of 65504", "direct", SPOILED_FRAME).max() == 65504
    assert (values("albedo 0", "albedo") == 0).all() and (values("no surface at all", "mesh_id") == 0).all()
    assert not values("all black", "direct").any() and not values("all black", "emission").any()
    low, high = spans(values("depth near 1e-4", "depth"))
    assert 2e-5 < low < high < 3e-4
    poisoned = {name for case in STRESS_CASES if case.poison for name in case.poison.channels}
    assert poisoned == {*LIGHT_CHANNELS, *SURFACE_CHANNELS}


def test_light_is_even_and_then_as_bright_on_average():
    case = replace(STRESS_CASES[0], frame_count=60)
    frames = list(case.frames())
    light = [(frame.irradiance("total"), (frame.depth > 0).expand(-1, 3, -1, -1)) for frame in frames]
    assert all(irradiance[~surface].max() == 0 for irradiance, surface in light)
    on_surfaces = [irradiance[surface] for irradiance, surface in light]
    assert all((irradiance - 1).abs().max() < 1e-6 for irradiance in on_surfaces[: case.even_frames])
    noisy = torch.cat(on_surfaces[case.even_frames :])
    assert noisy.mean() == pytest.approx(1, abs=0.05) and (noisy == 0).float().mean() > 0.3


@pytest.mark.parametrize("name", ["wskp3", "wskp-mr", "kp", "ntd"])
def test_logits_are_scaled_and_left_as_they_were(name):
    torch.manual_seed(0)
    denoiser = registry.create(name)
    denoiser.prepare()
    layers = last_layers(denoiser)
    frame = next(STRESS_CASES[0].frames())
    largest = []
    with largest_logits(denoiser, 1e4):
        hooks = [layer.register_forward_hook(lambda *args: largest.append(args[2].abs().max())) for layer in layers]
        denoiser(frame, None)
    assert largest and all(float(top) == pytest.approx(1e4) for top in largest)
    for hook in hooks:
        hook.remove()
    assert not any(layer._forward_hooks for layer in layers)


def test_the_range_of_each_colour_and_of_separate_lights():
    """Hand-made: direct light of 1 to 3, indirect of 0 to 2, in other pixels."""
    frame = next(STRESS_CASES[0].frames())
    tensors = {
        "direct": torch.tensor([1.0, 3.0]).expand(1, 3, 1, 2),
        "indirect": torch.tensor([2.0, 0.0]).expand(1, 3, 1, 2),
        "albedo": torch.ones(1, 3, 1, 2),
        "emission": torch.zeros(1, 3, 1, 2),
        "depth": torch.ones(1, 1, 1, 2),
    }
    frame = replace(frame, channels=tensors)
    for separates_lights, low, high in ((False, 3.0, 3.0), (True, 1.0, 5.0)):
        denoiser = SimpleNamespace(convex=True, separates_lights=separates_lights)
        for level, outside in ((low, 0), (high, 0), (high * 1.01, 0.01), (low * 0.99, 0.01)):
            output = torch.full((3, 1, 2), level)
            assert range_violation(denoiser, [frame], [output]) == pytest.approx(outside, abs=1e-6)
        red = torch.full((3, 1, 2), low)
        red[0] = 2 * high
        assert range_violation(denoiser, [frame], [red]) == pytest.approx(1)
