"""What noise of the reference does to an MSE, and how well noise floors tell it: `onespp figure unbiased`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from datasets.frame import to_tensor
from datasets.tonemap import clip_exposure, luminance
from eval.comparison import Comparison
from eval.figures.reference_halves import reference_halves
from eval.metrics import METRICS, noise_floors
from eval.metrics import measure as measure_frame
from plotting import DPI, plt, save_figure

SCENE, SIZE = "cornell_box", (64, 64)
REPEATS = {16: 128, 64: 64, 256: 32, 1024: 16}  # references by samples per pixel: the noisier, the more
SPPS = list(REPEATS)
TRUTH_SPP = 65536
BLUR = 0.25  # how much of a 3 x 3 mean is in the image that is judged
FLOORS = ("rmse", "l1", "flip", "ssim", "smape")


class Measured(NamedTuple):
    """Of one reference: its samples, two estimates of a fixed image's MSE, its noise floors, and what they estimate."""

    spp: int
    plain: float
    unbiased: float
    floors: dict[str, float]
    truths: dict[str, float]  # what the truth scores against this reference


def tensor(radiance: NDArray[np.float64]) -> Tensor:
    """(1, 3, H, W) of (H, W, 3)."""
    return to_tensor(radiance).double()


def measure(repeats: Mapping[int, int] = REPEATS, truth_spp: int = TRUTH_SPP) -> tuple[float, list[Measured]]:
    """The MSE of a fixed image to a reference of very many samples, and what noisy references say of it."""
    spps = [spp for spp, count in repeats.items() for _ in range(count)]
    rendered = reference_halves(SCENE, SIZE, [truth_spp, *spps])
    truth = next(rendered).mean(axis=0)
    exposure = clip_exposure(luminance(truth))
    perfect = tensor(truth)
    image = torch.lerp(perfect, avg_pool2d(perfect, 3, 1, 1, count_include_pad=False), BLUR)
    measured = []
    for spp, halves in zip(spps, rendered, strict=True):
        pair = torch.cat([tensor(half) for half in halves])
        metrics, best = (measure_frame(Comparison(x, pair, exposure)) for x in (image, perfect))
        plain = (exposure * (image - pair.mean(dim=0))).square().mean().item()
        floors = noise_floors(Comparison(image, pair, exposure))
        values = ({key: float(found[key] or 0) for key in FLOORS} for found in (floors, best))
        measured.append(Measured(spp, plain, float(metrics["mse_unbiased"] or 0), *values))
    return (exposure * (image - perfect)).square().mean().item(), measured


def spread(measured: Sequence[Measured], spp: int, which: str) -> tuple[float, float]:
    """Mean and standard error over the references of `spp` samples."""
    values = [getattr(found, which) for found in measured if found.spp == spp]
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def unbiased_figure(path: Path) -> None:
    """Draw both as a PNG; prints the numbers."""
    true, measured = measure()
    figure, (left, right) = plt.subplots(1, 2, figsize=(1000 / DPI, 400 / DPI), layout="constrained")
    draw_errors(left, true, measured)
    draw_floors(right, measured)
    save_figure(path, figure)


def draw_errors(axis: Any, true: float, measured: Sequence[Measured]) -> None:
    print(f"MSE of a slightly blurred image to {TRUTH_SPP} spp: {true:.3e}")
    for which, name, marker in (("plain", "plain MSE", "o"), ("unbiased", "unbiased MSE", "s")):
        values, errors = zip(*(spread(measured, spp, which) for spp in SPPS), strict=True)
        axis.errorbar(SPPS, values, 4 * np.array(errors), marker=marker, capsize=3, label=name)
        print(
            name, *(f"{spp} spp: {v:.3e} ± {e:.1e}" for spp, v, e in zip(SPPS, values, errors, strict=True)), sep="; "
        )
    axis.axhline(true, color="grey", linestyle="--", label=f"to {TRUTH_SPP} spp")
    axis.set(xscale="log", xlabel="samples per pixel of the reference", ylabel="MSE, linear radiance")
    axis.set_ylim(bottom=0)
    axis.set(xticks=SPPS, xticklabels=SPPS, title="A fixed image against ever better references")
    axis.minorticks_off()
    axis.legend()


def draw_floors(axis: Any, measured: Sequence[Measured]) -> None:
    """Estimated floors over true ones; of SSIM, of what it lacks of 1."""
    for key in FLOORS:
        ratios = []
        for spp in SPPS:
            pairs = np.array([(found.floors[key], found.truths[key]) for found in measured if found.spp == spp])
            estimate, truth = (abs((key == "ssim") - pairs)).mean(axis=0)
            ratios.append(estimate / truth)
        axis.plot(SPPS, ratios, marker="o", label=("1 - " if key == "ssim" else "") + METRICS[key].title)
        print(f"floor of {key} / true", *(f"{spp} spp: {r:.3f}" for spp, r in zip(SPPS, ratios, strict=True)), sep="; ")
    axis.axhline(1, color="grey", linestyle="--")
    axis.set(xscale="log", xlabel="samples per pixel of the reference", ylabel="estimated floor / true floor")
    axis.set(xticks=SPPS, xticklabels=SPPS, ylim=(0.7, 1.3), title="Noise floors against what the truth scores")
    axis.minorticks_off()
    axis.legend(ncols=2)
