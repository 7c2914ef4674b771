"""References of one frame at several sample counts, and what metrics make of their noise."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d

from datasets.frame import to_tensor
from datasets.tonemap import clip_exposure, luminance
from eval.comparison import Comparison
from eval.metrics import METRICS, mse_unbiased
from render.posed_frame import PosedFrame
from render.stage import Stage
from scenes.registry import build_scene

SCENE = "cornell_box"
SCENE_SIZE = (64, 64)
REFERENCES_BY_SPP = {16: 128, 64: 64, 256: 32, 1024: 16}  # how many: the noisier, the more
TRUTH_SPP = 65536
BLUR = 0.25  # how much of a 3 x 3 mean is in the image that is comparison
FLOORS = ("rmse", "l1", "flip", "ssim", "smape")


class NoisyReference(NamedTuple):
    """Two estimates of a fixed image's MSE by one reference, its noise floors, and what these estimate."""

    spp: int
    plain: float
    unbiased: float
    floors: dict[str, float]
    truths: dict[str, float]  # what the truth scores against this reference


def tensor(radiance: NDArray[np.float64]) -> Tensor:
    """(1, 3, H, W) of (H, W, 3)."""
    return to_tensor(radiance).double()


def value_of(measure: Callable[[Comparison], float | None] | None, comparison: Comparison) -> float:
    """A metric that is defined."""
    value = measure and measure(comparison)
    assert value is not None
    return value


def measure_references(
    counts: Mapping[int, int] = REFERENCES_BY_SPP, truth_spp: int = TRUTH_SPP
) -> tuple[float, list[NoisyReference]]:
    """The MSE of a fixed image to a reference of very many samples, and its estimates from noisy references.

    Args:
        counts: how many references of each number of samples a pixel.
    """
    spps = [spp for spp, count in counts.items() for _ in range(count)]
    rendered = reference_buffers(SCENE, SCENE_SIZE, [truth_spp, *spps])
    truth = next(rendered).mean(axis=0)
    exposure = clip_exposure(luminance(truth))
    perfect = tensor(truth)
    image = torch.lerp(perfect, avg_pool2d(perfect, 3, 1, 1, count_include_pad=False), BLUR)
    references = []
    for spp, buffers in zip(spps, rendered, strict=True):
        pair = torch.cat([tensor(half) for half in buffers])
        comparison = Comparison(image, pair, exposure)
        perfectly = Comparison(perfect, pair, exposure)
        references.append(
            NoisyReference(
                spp=spp,
                plain=(exposure * (image - pair.mean(dim=0))).square().mean().item(),
                unbiased=mse_unbiased(comparison),
                floors={name: value_of(METRICS[name].floor, perfectly) for name in FLOORS},
                truths={name: value_of(METRICS[name].of, perfectly) for name in FLOORS},
            )
        )
    return (exposure * (image - perfect)).square().mean().item(), references


def spread(references: Sequence[NoisyReference], spp: int, estimate: str) -> tuple[float, float]:
    """Mean and standard error of an estimate ("plain" or "unbiased") over the references of `spp` samples."""
    values = [getattr(reference, estimate) for reference in references if reference.spp == spp]
    return float(np.mean(values)), float(np.std(values, ddof=1) / np.sqrt(len(values)))


def reference_buffers(
    name: str, size: tuple[int, int], spps: Sequence[int], seed: int = 0
) -> Iterator[NDArray[np.float64]]:
    """Yields two sample buffers (2, H, W, 3) of the radiance of a scene's first frame, for each of `spps`.

    Both have spp / 2 samples a pixel and a seed of their own, as in a data set; `size` is (height, width) in pixels.
    Raises BadInput for an unknown scene.
    """
    height, width = size
    posed = PosedFrame(Stage(build_scene(name, seed, frames=1), height, width), 0)
    for index, spp in enumerate(spps):
        yield np.stack([posed.radiance(2 * index + half, spp // 2) for half in (0, 1)])
