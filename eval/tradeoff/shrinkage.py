"""What NAME+js gains on the better of noise and NAME, clip by clip: it must never lose by more than chance."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from tabulate import tabulate

from eval.metrics import METRICS, Values, within_floor
from eval.results import ClipResults
from models.registry import SHRINKING

NOISY = "noisy"


@dataclass(frozen=True)
class Gain:
    """Of one denoiser fed `spp` samples a pixel: dB on the better of noise and what it shrinks to.

    Attributes:
        metric: "psnr", by which what is within the noise floor counts as at its edge, or "mse_unbiased".
        clips: the gain on each clip, SCENE/CLIP.
    """

    label: str
    spp: int
    metric: str
    clips: dict[str, float]


def decibels(metric: str, values: Values, floors: Values) -> float:
    """A metric in dB, more is better."""
    value = values[metric]
    assert value is not None
    if metric == "mse_unbiased":
        return -10 * math.log10(max(value, 1e-12))
    floor = floors[metric]
    return METRICS[metric].edge(floor) if within_floor(metric, value, floor) else value  # type: ignore[arg-type]


def gains_of(fed: Mapping[int, Sequence[ClipResults]]) -> Iterator[Gain]:
    """Those of all NAME+js that were fed beside NAME and `noisy`, where there are two samples or more."""
    for spp, clips in fed.items():
        known = {result.denoiser for clip in clips for result in clip.results}
        pairs = [(name, name.replace(SHRINKING, "")) for name in sorted(known) if SHRINKING in name]
        for name, own in pairs:
            if spp > 1 and {own, NOISY} <= known:
                for metric in ("psnr", "mse_unbiased"):
                    yield Gain(name, spp, metric, dict(clip_gains(clips, metric, name, own)))


def clip_gains(clips: Sequence[ClipResults], metric: str, name: str, own: str) -> Iterator[tuple[str, float]]:
    """The gain on each clip that has results of all three."""
    for clip in clips:
        found = {
            result.denoiser: decibels(metric, result.metrics, clip.reference.metrics)
            for result in clip.results
            if result.denoiser in (name, own, NOISY)
        }
        if len(found) == 3:
            yield clip.name, found[name] - max(found[own], found[NOISY])


def gains_table(gains: Sequence[Gain]) -> str:
    """Means over the clips, and the worst clip, by samples a pixel."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for gain in gains:
        line = lines.setdefault(
            (gain.label, gain.metric), {"denoiser": gain.label, "by": METRICS[gain.metric].title.removesuffix(" dB")}
        )
        values = gain.clips.values()
        line[f"{gain.spp} spp"] = f"{sum(values) / len(values):+.2f} ({min(values):+.2f})"
    return tabulate([*lines.values()], "keys", disable_numparse=True)
