"""Scores on other people's data by their own rules, beside the rows that they published."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor

from datasets.clip import Clip, Dataset
from datasets.frame import to_tensor
from datasets.tonemap import DISPLAY_GAMMA, psnr
from errors import BadInput
from eval.clip_run import play
from eval.metrics import flip, ssim, temporal_psnr
from eval.selection import evaluated
from models.operators import finite, image_luminance
from models.spec import DenoiserSpec
from models.wrappers.taa import transform_colours

PUBLISHED_METRICS = ("PSNR", "SSIM", "FLIP", "tPSNR")
# Stephen Hill's fit of the ACES tone curve (BakingLab): to its colour space, the curve's coefficients, and back.
ACES_INPUT = ((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777))
ACES_OUTPUT = ((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602))


def aces_tone(radiance: Tensor) -> Tensor:
    x = transform_colours(radiance, ACES_INPUT)
    x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081)
    return transform_colours(x, ACES_OUTPUT).clamp(0, 1) ** (1 / DISPLAY_GAMMA)


@dataclass(frozen=True)
class Protocol:
    """How others score, and their results: means over clips by PUBLISHED_METRICS, as far as they give them."""

    tone: Callable[[Tensor], Tensor]
    warm_up: int  # frames of each clip that do not count
    rows: dict[str, tuple[float, ...]]
    note: str  # printed below the table


NOISEBASE_NOTE = "Noisebase also publishes FVVDP, which is not computed here"
# By the profile of an imported dataset. Sources: Fan et al. 2021, averages of Table 1 (PSNR) and Table 2 (SSIM);
# Noisebase, docs/benchmarks/rendering_v1.md.
PROTOCOLS = {
    "bmfr": Protocol(
        lambda radiance: radiance.clamp(min=0) ** 0.454545,
        warm_up=0,
        rows={
            "KP (Fan et al. 2021)": (30.332, 0.951),
            "WSKP6 (Fan et al. 2021)": (30.323, 0.951),
            "MR-KP (Meng et al. 2020)": (30.322, 0.952),
            "WSKP3 (Fan et al. 2021)": (29.637, 0.946),
            "NBGD (Meng et al. 2020)": (29.474, 0.940),
            "NFOR (Bitterli et al. 2016)": (26.889, 0.910),
            "BMFR (Koskela et al. 2019)": (25.575, 0.904),
            "SVGF (Schied et al. 2017)": (22.264, 0.901),
        },
        note="All rows are by Fan et al. 2021, who do not say of what they take SSIM; ours is that of luminance",
    ),
    "noisebase at 2 spp": Protocol(
        aces_tone, 16, {"NPPD (Bálint et al. 2023)": (28.3952, 0.87283, 0.10702)}, f"{NOISEBASE_NOTE}: 7.36 of NPPD"
    ),
    "noisebase at 4 spp": Protocol(
        aces_tone, 16, {"NPPD (Bálint et al. 2023)": (29.3461, 0.88300, 0.09624)}, NOISEBASE_NOTE
    ),
    "noisebase at 8 spp": Protocol(
        aces_tone, 16, {"NPPD (Bálint et al. 2023)": (30.3686, 0.89657, 0.08451)}, NOISEBASE_NOTE
    ),
}


def as_file(radiance: Tensor, protocol: Protocol) -> Tensor:
    """What an 8-bit image of the radiance (1, 3, H, W) holds, in [0, 1] and float64."""
    return (255 * protocol.tone(finite(radiance).double()).clamp(0, 1)).floor() / 255


@torch.no_grad()
def scores(clip: Clip, spec: DenoiserSpec, protocol: Protocol) -> list[list[float | None]]:
    """A denoiser's PUBLISHED_METRICS of every frame that counts."""
    rows: list[list[float | None]] = []
    before: Tensor | None = None  # the last frame's error
    for index, _, (output,) in play(clip, [spec.build()]):
        if index < protocol.warm_up:
            continue
        reference = to_tensor(clip.reference(index).mean(axis=0))
        x, y = as_file(output, protocol), as_file(reference, protocol)
        error = x - y
        similarity = ssim(image_luminance(x**DISPLAY_GAMMA), image_luminance(y**DISPLAY_GAMMA))  # of linear luminance
        rows.append([psnr(float(error.square().mean())), similarity, flip(x, y), temporal_psnr(error, before)])
        before = error
    return rows


def protocol_of(dataset: Dataset) -> Protocol:
    """How others score a dataset. Raises BadInput where none of its clips or samples were scored by others."""
    profile = dataset.facts["profile"]
    if profile in PROTOCOLS:
        return PROTOCOLS[profile]
    if profile.startswith("noisebase"):
        known = ", ".join(name.split()[-2] for name in PROTOCOLS if name.startswith("noisebase"))
        raise BadInput(
            f"{dataset.path} is {profile}, of which nothing is published: import it again with --spp, one of {known}"
        )
    raise BadInput(f"{dataset.path} was not made by `onespp import`: there are no published results to compare with")


def published(names: Sequence[str], data: Path, runs: Path, budget: str) -> str:
    """A table of denoisers and published rows. Raises BadInput as `protocol_of` and `onespp eval`."""
    dataset = Dataset(data)
    protocol = protocol_of(dataset)
    clips = dataset.clips("test")
    for clip in clips:
        if clip.frames <= protocol.warm_up:
            raise BadInput(f"{clip.path} has {clip.frames} frames; of {protocol.warm_up} the first do not count")
    rows: list[list[Any]] = [[name, "published", *row] for name, row in protocol.rows.items()]
    for spec in evaluated(names, runs, budget, clips=clips):
        means = [np.nanmean(np.array(scores(clip, spec, protocol), float), axis=0) for clip in clips]
        rows.append([spec.name, spec.facts.made_from, *np.mean(means, axis=0)])
    lines = [[name, source, *(f"{mean:.4g}" for mean in means)] for name, source, *means in rows]
    return f"{tabulate(lines, ['', 'made from', *PUBLISHED_METRICS], disable_numparse=True)}\n{protocol.note}"
