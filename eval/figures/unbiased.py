"""What noise of the reference does to an MSE, and how well noise floors tell it: `onespp figure unbiased`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from datasets.frame import to_tensor
from datasets.tonemap import clip_exposure, luminance
from eval.comparison import Comparison
from eval.figures.reference_halves import reference_halves
from eval.metrics import METRICS, mse_unbiased
from plotting import DPI, plt, save_figure

SCENE = "cornell_box"
SCENE_SIZE = (64, 64)
REFERENCES_BY_SPP = {16: 128, 64: 64, 256: 32, 1024: 16}  # how many: the noisier, the more
TRUTH_SPP = 65536
BLUR = 0.25  # how much of a 3 x 3 mean is in the image that is judged
FLOORS = ("rmse", "l1", "flip", "ssim", "smape")


class NoisyReference(NamedTuple):
    """What one reference says: two estimates of a fixed image's MSE, its own noise floors, and what they estimate."""

    spp: int
    plain: float
    unbiased: float
    floors: dict[str, float]
    truths: dict[str, float]  # what the truth scores against this reference


def tensor(radiance: NDArray[np.float64]) -> Tensor:
    """(1, 3, H, W) of (H, W, 3)."""
    return to_tensor(radiance).double()


def value_of(measure: Callable[[Comparison], float | None] | None, comparison: Comparison) -> float:
    """What a metric says that is defined."""
    value = measure and measure(comparison)
    assert value is not None
    return value


def measure_references(
    counts: Mapping[int, int] = REFERENCES_BY_SPP, truth_spp: int = TRUTH_SPP
) -> tuple[float, list[NoisyReference]]:
    """The MSE of a fixed image to a reference of very many samples, and what noisy references say of it.

    Args:
        counts: how many references of each number of samples a pixel.
    """
    spps = [spp for spp, count in counts.items() for _ in range(count)]
    rendered = reference_halves(SCENE, SCENE_SIZE, [truth_spp, *spps])
    truth = next(rendered).mean(axis=0)
    exposure = clip_exposure(luminance(truth))
    perfect = tensor(truth)
    image = torch.lerp(perfect, avg_pool2d(perfect, 3, 1, 1, count_include_pad=False), BLUR)
    references = []
    for spp, halves in zip(spps, rendered, strict=True):
        pair = torch.cat([tensor(half) for half in halves])
        judged = Comparison(image, pair, exposure)
        perfectly = Comparison(perfect, pair, exposure)
        references.append(
            NoisyReference(
                spp=spp,
                plain=(exposure * (image - pair.mean(dim=0))).square().mean().item(),
                unbiased=mse_unbiased(judged),
                floors={name: value_of(METRICS[name].floor, perfectly) for name in FLOORS},
                truths={name: value_of(METRICS[name].of, perfectly) for name in FLOORS},
            )
        )
    return (exposure * (image - perfect)).square().mean().item(), references


def spread(references: Sequence[NoisyReference], spp: int, estimate: str) -> tuple[float, float]:
    """Mean and standard error of an estimate ("plain" or "unbiased") over the references of `spp` samples."""
    values = [getattr(reference, estimate) for reference in references if reference.spp == spp]
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def unbiased_figure(path: Path) -> None:
    """Draw both as a PNG; prints the numbers."""
    true, references = measure_references()
    figure, (left, right) = plt.subplots(1, 2, figsize=(1000 / DPI, 400 / DPI), layout="constrained")
    draw_errors(left, true, references)
    draw_floors(right, references)
    save_figure(path, figure)


def draw_errors(axis: Axes, true: float, references: Sequence[NoisyReference]) -> None:
    """Both estimates of the MSE against samples of the reference, with bars of four standard errors."""
    spps = sorted({reference.spp for reference in references})
    print(f"MSE of a slightly blurred image to {TRUTH_SPP} spp: {true:.3e}")
    for estimate, marker in (("plain", "o"), ("unbiased", "s")):
        name = f"{estimate} MSE"
        values, errors = zip(*(spread(references, spp, estimate) for spp in spps), strict=True)
        axis.errorbar(spps, values, 4 * np.array(errors), marker=marker, capsize=3, label=name)
        words = [f"{spp} spp: {v:.3e} ± {e:.1e}" for spp, v, e in zip(spps, values, errors, strict=True)]
        print("; ".join([name, *words]))
    axis.axhline(true, color="grey", linestyle="--", label=f"to {TRUTH_SPP} spp")
    axis.set_ylim(bottom=0)
    label_samples(axis, spps)
    axis.set(ylabel="MSE, linear radiance", title="A fixed image against ever better references")
    axis.legend()


def draw_floors(axis: Axes, references: Sequence[NoisyReference]) -> None:
    """Estimated floors over true ones; of SSIM, of what it lacks of 1."""
    spps = sorted({reference.spp for reference in references})
    for key in FLOORS:
        ratios = []
        for spp in spps:
            pairs = np.array([(found.floors[key], found.truths[key]) for found in references if found.spp == spp])
            estimate, truth = (abs((key == "ssim") - pairs)).mean(axis=0)
            ratios.append(estimate / truth)
        axis.plot(spps, ratios, marker="o", label=("1 - " if key == "ssim" else "") + METRICS[key].title)
        words = [f"{spp} spp: {ratio:.3f}" for spp, ratio in zip(spps, ratios, strict=True)]
        print("; ".join([f"floor of {key} / true", *words]))
    axis.axhline(1, color="grey", linestyle="--")
    label_samples(axis, spps)
    axis.set(ylabel="estimated floor / true floor", ylim=(0.7, 1.3), title="Noise floors against what the truth scores")
    axis.legend(ncols=2)


def label_samples(axis: Axes, spps: Sequence[int]) -> None:
    """Samples along a logarithmic axis."""
    axis.set(xscale="log", xlabel="samples per pixel of the reference")
    axis.set_xticks(spps, map(str, spps))
    axis.minorticks_off()
