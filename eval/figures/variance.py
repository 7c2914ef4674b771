"""SVGF's synthetic test of its variance estimate (Schied et al. 2017, §5.2, Eq. 6 and Fig. 9)."""

import math
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor

from datasets.frame import Cameras, Frame
from datasets.tonemap import display
from models.denoiser import State
from models.svgf import SVGF
from plotting import DPI, plt, save_figure

TILE = 64  # px; every tile has the same structure, so that only the noise differs from left to right
PATTERN_SIZE = (2 * TILE, 12 * TILE)  # height, width
VARIANCES = (1e-4, 50.0)  # of f, at the left and at the right
PLAYED_FRAMES = 32
ROW_CAPTION = 24  # px


def pattern(height: int, width: int) -> Tensor:
    """Discs of rings on a checker, values 0.2 and 1: (H, W)."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    radius = torch.hypot(x % TILE - TILE / 2 + 0.5, y % TILE - TILE / 2 + 0.5)
    bright = torch.where(radius < TILE / 2 - 4, radius // 7, x // (TILE // 4) + y // (TILE // 4)) % 2
    return 0.2 + 0.8 * bright


def alphas(width: int) -> Tensor:
    """Eq. 6's alpha for every column (W): its variance alpha / (1 - alpha) grows by the same factor from each to next.

    Along a linear alpha, nearly all of the picture would be noisier than its contrast.
    """
    low, high = (math.log10(variance) for variance in VARIANCES)
    variance = torch.logspace(low, high, width)
    return variance / (1 + variance)


def sample(reference: Tensor, generator: torch.Generator) -> Tensor:
    """One sample a pixel of `reference` (H, W), times f(x, alpha) (Eq. 6)."""
    alpha = alphas(reference.shape[1])
    lit = torch.rand(reference.shape, generator=generator) >= alpha
    return reference * lit / (1 - alpha)


def wall(irradiance: Tensor) -> Frame:
    """A frame of a white wall, which faces a camera that stands still, with direct light (H, W) only."""
    height, width = irradiance.shape
    one = torch.ones(1, 1, height, width)
    black = torch.zeros(1, 3, height, width)
    channels = {
        "direct": irradiance.expand(1, 3, -1, -1),
        "indirect": black,
        "emission": black,
        "albedo": one.expand(1, 3, -1, -1),
        "normal": torch.tensor([0.0, 0.0, -1.0])[:, None, None].expand(1, 3, height, width),
        "depth": one,
        "mesh_id": one,
        "motion": torch.zeros(1, 2, height, width),
    }
    K = torch.tensor([[-width, 0, width / 2], [0, -width, height / 2], [0, 0, 1]], dtype=torch.float64)
    world = torch.eye(4, dtype=torch.float64)
    camera = Cameras(K[None], world[None], world[None, None])
    return Frame(channels, camera, camera, torch.ones(1, 3, 1, 1), "synthetic test of the variance")


@torch.no_grad()
def filtered_pattern(
    size: tuple[int, int] = PATTERN_SIZE, frames: int = PLAYED_FRAMES, seed: int = 0
) -> dict[str, Tensor]:
    """The rows of Fig. 9, (H, W) each: input, result of the first frame and of the last, reference."""
    generator = torch.Generator().manual_seed(seed)
    reference = pattern(*size)
    svgf = SVGF()
    state: State | None = None
    images: dict[str, Tensor] = {}
    for _ in range(frames):
        noisy = sample(reference, generator)
        output, state = svgf(wall(noisy), state)
        images.setdefault("spatial variance estimate", output[0, 0])
    return {"input": noisy} | images | {"temporal variance estimate": output[0, 0], "reference": reference}


def draw_rows(images: dict[str, Tensor]) -> Figure:
    """Images (H, W) of radiance one below the other, as displayed."""
    height, width = next(iter(images.values())).shape
    size = (width / DPI, len(images) * (height + ROW_CAPTION) / DPI)
    figure, axes = plt.subplots(len(images), 1, figsize=size)
    for axis, (name, image) in zip(axes, images.items(), strict=True):
        axis.imshow(display(image, 1.0).numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
        axis.set_title(name, fontsize=8, pad=2, loc="left")
        axis.set_axis_off()
    figure.subplots_adjust(left=0, right=1, bottom=0, top=0.965, hspace=0.19)
    return figure


def variance_figure(path: Path) -> None:
    """Draw Fig. 9 as a PNG."""
    save_figure(path, draw_rows(filtered_pattern()))
