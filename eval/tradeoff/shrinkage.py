"""The gain of NAME+js over the better of NAME and the noisy frame, clip by clip; it should never be negative."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from tabulate import tabulate

from eval.metrics import METRICS, Values, within_floor
from eval.results import ClipResults

SHRINKING = "+js"
INPUT = "noisy"  # the denoiser that returns its input


@dataclass(frozen=True)
class Gain:
    """The gain of one denoiser with `spp` samples per pixel, in dB.

    Attributes:
        metric: "psnr" or "mse_unbiased"; a value within the noise floor counts as at the floor's edge.
        clips: the gain on each clip, SCENE/CLIP.
    """

    label: str
    spp: int
    metric: str
    clips: dict[str, float]


def decibels(metric: str, values: Values, floors: Values) -> float:
    """A metric in dB, where more is better."""
    value, floor = values[metric], floors[metric]
    assert value is not None and floor is not None
    if within_floor(metric, value, floor):
        value = METRICS[metric].edge(floor)
    return value if metric == "psnr" else -10 * math.log10(value)


def gains_of(fed: Mapping[int, Sequence[ClipResults]]) -> Iterator[Gain]:
    """The gains of all NAME+js with results of NAME and `noisy`, for two samples per pixel or more."""
    for spp, clips in fed.items():
        names = sorted({result.denoiser for clip in clips for result in clip.results if SHRINKING in result.denoiser})
        for name, metric in product(names, ("psnr", "mse_unbiased")):
            gained = dict(clip_gains(clips, metric, name))
            if spp > 1 and gained:
                yield Gain(name, spp, metric, gained)


def clip_gains(clips: Sequence[ClipResults], metric: str, name: str) -> Iterator[tuple[str, float]]:
    """The gain on each clip with results of all three."""
    others = {name.replace(SHRINKING, ""), INPUT}
    for clip in clips:
        found = {
            result.denoiser: decibels(metric, result.metrics, clip.reference.metrics)
            for result in clip.results
            if result.denoiser in {name, *others}
        }
        if found.keys() == {name, *others}:
            yield clip.name, found[name] - max(found[other] for other in others)


def gains_rows(gains: Sequence[Gain]) -> list[dict[str, str]]:
    """Means over the clips, and the worst clip, by samples per pixel: one row per denoiser and metric."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for gain in gains:
        line = lines.setdefault(
            (gain.label, gain.metric), {"denoiser": gain.label, "by": METRICS[gain.metric].title.removesuffix(" dB")}
        )
        values = gain.clips.values()
        line[f"{gain.spp} spp"] = f"{sum(values) / len(values):+.2f} ({min(values):+.2f})"
    return [*lines.values()]


def gains_table(gains: Sequence[Gain]) -> str:
    return tabulate(gains_rows(gains), "keys", disable_numparse=True)
