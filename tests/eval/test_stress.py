"""The stress bench reports exactly what a broken denoiser breaks, and lets a sound one pass."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import pytest
import torch

import eval.stress.run
from eval.stress.cases import EXTREMES, LIGHT, LONG, PERIOD, RECOVERY_LIMIT, SPOILED, SURFACE, Extreme
from eval.stress.check import FORGOTTEN, Range, Trial, heads, largest_logits
from models import registry
from models.denoiser import Denoiser, State
from models.weights import save_weights
from onespp import main

NAMES = [extreme.name for extreme in EXTREMES]
IN_LIGHT = [extreme.name for extreme in EXTREMES if extreme.poison and extreme.poison.names == LIGHT]
KEYS = {"denoiser", "weights", "extreme", "error", "nonfinite", "violation", "recovery", "broken"}


def all_break(extremes: Iterable[str], *requirements: str) -> dict[str, list[str]]:
    return {extreme: list(requirements) for extreme in extremes}


class Simple(Denoiser):
    """The noisy frame, with bad pixels as they come."""

    reads = LIGHT
    mended = False

    def __call__(self, frame, state):
        return self.forward(frame.finite() if self.mended else frame, state)

    def forward(self, frame, state):
        return self.answer(frame.radiance("total"), frame), State(frame.moment)

    def answer(self, radiance, frame):
        return radiance


class Overflows(Simple):
    """NaN where it is bright."""

    mended = True

    def answer(self, radiance, frame):
        return torch.where(radiance > 2e4, torch.nan, radiance)


class Spreads(Simple):
    """One bad pixel blackens the image."""

    def answer(self, radiance, frame):
        return radiance if torch.isfinite(radiance).all() else torch.zeros_like(radiance)


class SpreadsNaN(Simple):
    """One bad pixel makes all bad."""

    def answer(self, radiance, frame):
        return radiance if torch.isfinite(radiance).all() else torch.full_like(radiance, torch.nan)


class KeepsBadPixels(Simple):
    """Nothing but the bad pixel itself is bad, which is allowed."""


class Brightens(Simple):
    """By 0.1 % of the irradiance."""

    mended = True

    def answer(self, radiance, frame):
        return torch.lerp(frame.emission, radiance, 1.001)


class GoesNegative(Simple):
    mended = True

    def answer(self, radiance, frame):
        return radiance - 1e-9


@dataclass(frozen=True)
class Mean(State):
    radiance: torch.Tensor


class Remembers(Denoiser):
    """An exponential mean that gives the newest frame a weight of `alpha`."""

    reads = LIGHT
    alpha = 0.01

    def forward(self, frame, state):
        radiance = frame.radiance("total")
        if isinstance(state, Mean):
            radiance = torch.lerp(state.radiance, radiance, self.alpha)
        return radiance, Mean(frame.moment, radiance)


class Halves(Remembers):
    alpha = 0.5


class GrowsBrighter(Denoiser):
    """By 1 % from frame to frame."""

    reads = LIGHT

    def forward(self, frame, state):
        factor = 1.01 * state.radiance if isinstance(state, Mean) else torch.ones(1)
        return factor * frame.radiance("total"), Mean(frame.moment, factor)


@pytest.fixture
def stress(tmp_path, monkeypatch, capsys):
    """Run the command on a class under a name: the exit code, what it breaks by extreme, and what it prints."""

    def run(kind, name="broken", *options):
        monkeypatch.setitem(registry.DENOISERS, name, kind)
        code = 0
        try:
            main(["stress", name, "--runs", str(tmp_path), *options])
        except SystemExit as end:
            code = end.code
        results = json.loads((tmp_path / "stress" / "results.json").read_text())
        rows = results["rows"]
        assert (results["schema"], results["device"]) == (1, "cpu, 1 thread")
        assert all(row.keys() == KEYS for row in rows)
        return code, {row["extreme"]: row["broken"] for row in rows if row["broken"]}, capsys.readouterr().out

    return run


@pytest.fixture(autouse=True)
def seldom_draw(request, monkeypatch):
    """The picture is drawn where it is looked at: it takes longer than all the rest."""
    if "passes" not in request.node.name:
        monkeypatch.setattr(eval.stress.run, "heat_map", lambda *_: None)


def test_a_sound_denoiser_passes(stress, tmp_path):
    code, broken, printed = stress(registry.DENOISERS["accumulated"], "accumulated")
    assert (code, broken) == (0, {}) and "All requirements are kept." in printed
    table = (tmp_path / "stress" / "table.md").read_text()
    assert all(f"| {name} " in table for name in NAMES if "float1" not in name and "logits" not in name)
    assert (tmp_path / "stress" / "errors.png").stat().st_size > 10_000


def test_nan_is_found(stress):
    code, broken, printed = stress(Overflows)
    bright = ["a firefly of 65504", "radiance 6e4", "radiance 1e-7 to 6e4"]
    assert (code, broken) == (1, all_break(bright, "finite"))
    assert "finite: what comes of finite pixels is finite" in printed and "recovery: " not in printed


def test_spreading_is_found(stress):
    assert stress(Spreads)[:2] == (1, all_break(IN_LIGHT, "spread"))


def test_spreading_nan_is_found(stress):
    assert stress(SpreadsNaN)[:2] == (1, all_break(IN_LIGHT, "finite", "spread"))


def test_a_bad_pixel_may_stay_bad_for_a_frame(stress):
    assert stress(KeepsBadPixels)[:2] == (0, {})


def test_leaving_the_range_is_found_where_it_is_promised(stress):
    lit = [name for name in NAMES if name not in ("all black", "logits to ±1e4")]
    assert stress(Brightens, "eaw")[:2] == (1, all_break(lit, "range"))
    assert stress(Brightens)[:2] == (0, {})


def test_negative_light_is_found(stress):
    code, broken, printed = stress(GoesNegative)
    assert code == 1 and set(map(tuple, broken.values())) == {("range",)} and "all black" in broken
    assert "no other goes below 0" in printed


def test_a_state_that_does_not_recover_is_found(stress):
    code, broken, printed = stress(Remembers)
    assert (code, broken) == (1, all_break(IN_LIGHT, "recovery"))
    assert f"> {RECOVERY_LIMIT}" in printed


def test_recovery_is_counted_in_frames():
    """The mean's error halves from frame to frame."""
    extreme = next(extreme for extreme in EXTREMES if extreme.name == IN_LIGHT[0])
    outcome = Trial("halves", lambda _: Halves(), extreme).outcome()
    frames = list(extreme.frames())
    whole = frames[0].radiance("total")
    lost = float((whole - frames[SPOILED].finite().radiance("total")).abs().max() / whole.max())
    expected = next(n for n in range(100) if lost * 0.5 ** (n + 1) <= FORGOTTEN)
    assert outcome.recovery == expected and outcome.error == pytest.approx(lost / 2)


def test_long_sequences_show_drift(stress, monkeypatch):
    monkeypatch.setattr(eval.stress.run, "LONG", replace(LONG, name="long", count=4 * PERIOD))
    assert stress(Halves, "sound", "--long")[1].keys() == set()
    kept, drifted = (
        Trial("any", lambda _, kind=kind: kind(), eval.stress.LONG).outcome().error for kind in (Halves, GrowsBrighter)
    )
    assert kept < 1e-6 and drifted == pytest.approx(1.01 ** (2 * PERIOD) - 1, rel=1e-3)


def test_what_cannot_be_stressed(capsys, tmp_path):
    for arguments, message in (
        (["nonsense"], "unknown denoiser 'nonsense'"),
        (["svgf", "--precision", "bfloat16"], "none of svgf computes in bfloat16"),
    ):
        with pytest.raises(SystemExit) as end:
            main(["stress", *arguments, "--runs", str(tmp_path)])
        assert end.value.code == 2 and message in capsys.readouterr().err


def test_weights_are_named(tmp_path):
    """Fresh ones where there are no trained ones."""
    (file,) = (entrant.weights for entrant in eval.stress.contestants(["wskp3"], tmp_path, "tiny"))
    assert file is None
    path = tmp_path / "train" / "wskp3-tiny" / "weights.safetensors"
    path.parent.mkdir(parents=True)
    save_weights(registry.create("wskp3"), "wskp3", {}, path)
    (entrant,) = eval.stress.contestants(["wskp3"], tmp_path, "tiny")
    assert entrant.origin == str(path)


# --- The extremes are what they say -----------------------------------------------------------------------------------


@pytest.mark.parametrize("extreme", (*EXTREMES, replace(LONG, count=3)), ids=lambda extreme: extreme.name)
def test_frames_continue_their_sequence(extreme: Extreme):
    """So that all states are carried; and only the frames meant to be are not finite."""
    frames = list(extreme.frames())
    assert len(frames) == extreme.count and {frame.size for frame in frames} == {extreme.size}
    for before, frame in pairwise(frames):
        assert frame.follows(before.moment)
    for index, frame in enumerate(frames):
        bad = sum((~torch.isfinite(tensor)).any(dim=1).sum() for tensor in frame.channels.values())
        assert bad == (len(extreme.poison.names) if extreme.poison and index == SPOILED else 0)


def test_extremes_reach_their_values():
    def values(name: str, channel: str, index: int = 0) -> torch.Tensor:
        extreme = next(extreme for extreme in EXTREMES if extreme.name == name)
        return list(extreme.frames())[index].channels[channel]

    def spans(tensor: torch.Tensor) -> Iterator[float]:
        return (float(value) for value in torch.aminmax(tensor[tensor > 0]))

    low, high = spans(values("depth 1e-4 to 1e6", "depth"))
    assert low < 1e-3 and high > 1e5
    low, high = spans(values("radiance 1e-7 to 6e4", "direct"))
    assert low < 1e-7 and high > 1e4
    assert values("a firefly of 65504", "direct", SPOILED).max() == 65504
    assert (values("albedo 0", "albedo") == 0).all() and (values("no surface at all", "mesh_id") == 0).all()
    assert not values("all black", "direct").any() and not values("all black", "emission").any()
    low, high = spans(values("depth around 1e-4", "depth"))
    assert 2e-5 < low < high < 3e-4
    assert {name for extreme in EXTREMES if extreme.poison for name in extreme.poison.names} == {*LIGHT, *SURFACE}


def test_light_is_even_and_then_as_bright_on_average():
    extreme = replace(EXTREMES[0], count=60)
    frames = list(extreme.frames())
    assert all((frame.irradiance("total") - 1).abs().max() < 1e-6 for frame in frames[: extreme.even])
    noisy = torch.cat([frame.irradiance("total") for frame in frames[extreme.even :]])
    assert noisy.mean() == pytest.approx(1, abs=0.05) and (noisy == 0).float().mean() > 0.3


@pytest.mark.parametrize("name", ["wskp3", "wskp-mr", "kp", "ntd"])
def test_logits_are_scaled_and_left_as_they_were(name):
    torch.manual_seed(0)
    denoiser = registry.create(name)
    denoiser.prepare()
    frame = next(EXTREMES[0].frames())
    seen = []
    with largest_logits(denoiser, 1e4):
        hooks = [head.register_forward_hook(lambda *args: seen.append(args[2].abs().max())) for head in heads(denoiser)]
        denoiser(frame, None)
    assert seen and all(float(top) == pytest.approx(1e4) for top in seen)
    for hook in hooks:
        hook.remove()
    assert not any(head._forward_hooks for head in heads(denoiser))


def test_the_range_is_of_every_colour_and_of_what_svgf_adds_up():
    """Hand-made: direct light of 1 to 3, indirect of 0 to 2, in other pixels."""
    frame = next(EXTREMES[0].frames())
    albedo, zero = torch.ones(1, 3, 1, 2), torch.zeros(1, 3, 1, 2)
    direct, indirect = (torch.tensor(row).expand(1, 3, 1, 2) for row in ([1.0, 3.0], [2.0, 0.0]))
    tensors = {"direct": direct, "indirect": indirect, "albedo": albedo, "emission": zero}
    frame = replace(frame, channels=tensors)
    for name, low, high in (("eaw", 3.0, 3.0), ("svgf", 1.0, 5.0)):
        seen = Range(name)
        seen.see(frame)
        for level, outside in ((low, 0), (high, 0), (high * 1.01, 0.01), (low * 0.99, 0.01)):
            assert max(0, seen.violation(frame, torch.full((3, 1, 2), level))) == pytest.approx(outside, abs=1e-6)
        red = torch.full((3, 1, 2), low)
        red[0] = 2 * high
        assert seen.violation(frame, red) == pytest.approx(1)
