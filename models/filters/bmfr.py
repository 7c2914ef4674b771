"""BMFR: blockwise multi-order feature regression (Koskela et al. 2019).

In each block, accumulated irradiance is fitted by a linear combination of noise-free features; the fit is accumulated
once more. Features, block size, noise amplitude and weights are those of the authors' code (github.com/maZZZu/bmfr); we
do not have the paper's text. Its last stage, temporal antialiasing, comes after remodulation: `bmfr+taa` is the whole
pipeline, with TAA as in Karis 2014 (0.1 of the newest frame; the authors take 0.2 of gamma-corrected frames).

Differences from the authors' code:

- Both accumulations use the reprojection of all denoisers here (history/reprojection.py).
- Positions are along the world's axes, relative to the camera, and scaled to [0, 1] in each block before they are
  squared; the authors scale only extents above one unit. The span of 1, positions and squares does not depend on
  the origin, but far from it noise hides the difference between positions and their squares.
- An axis along which a block is flat, to 10^-3 of its largest extent, is scaled by that: rounding is no feature.
- Light and features of background are 0, the constant too, except for the noise. So blocks with few surfaces are
  regularised as strongly as full ones and have full rank. Blocks without any surface are skipped.
- The grid's offsets are the first 16 points of the R2 sequence. Noise is the same for all blocks of a frame, and drawn
  anew for each frame from its number since the last reset.
- Images narrower than a block are mirrored repeatedly.
- QR factors are computed in float64, in which no irradiance overflows; fits are clamped to a frame's largest radiance.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import MAX_MAGNITUDE, Frame
from models import compiled
from models.compiled import bmfr as kernels
from models.compiled.bmfr import BLOCK_SIDE, MIN_RELATIVE_EXTENT, REGRESSORS
from models.denoiser import CLASSICAL, State, matching_state
from models.filters.baselines import AccumulatedState, Accumulating
from models.history.geometry import positions_around_eye, ray_axes
from models.history.reprojection import reproject

NOISE = 0.01  # amplitude of what is added to features against rank deficiency
MIN_FIT_ALPHA = 0.1  # weight of the newest fit in a long history
GRID_OFFSETS = 16  # after which they repeat
PLASTIC_NUMBER = 1.32471795724474602596  # R2's steps are its first two negative powers
Offset = tuple[int, int]  # px, from the upper left pixel of the grid's first block to that of the image


def grid_offset(number: int) -> Offset:
    """The offset of the grid of blocks in frame `number`, each from 0 to 31."""
    point = number % GRID_OFFSETS + 1
    down, across = (int(BLOCK_SIDE * (point * PLASTIC_NUMBER**-power % 1)) for power in (1, 2))
    return down, across


def feature_noise(number: int) -> Tensor:
    """Noise (1024, 10), float64, for the features of each block in frame `number`; always the same."""
    generator = torch.Generator().manual_seed(number)
    noise = NOISE * (2 * torch.rand(BLOCK_SIDE**2, REGRESSORS, dtype=torch.float64, generator=generator) - 1)
    noise[:, 0] = 0  # of the constant
    return noise


def mirrored(first: int, last: int, size: int) -> Tensor:
    """Pixel indices at positions `first` to `last` - 1 of an axis that is mirrored at both ends of its `size`."""
    index = torch.arange(first, last) % (2 * size)
    return torch.minimum(index, 2 * size - 1 - index)


class Blocks:
    """Splits images of a size (H, W) into the blocks of a grid that begins `offset` before them."""

    def __init__(self, size: tuple[int, int], offset: Offset):
        self.size = size
        self.offset = offset
        self.counts = [-(-(length + before) // BLOCK_SIDE) for length, before in zip(size, offset, strict=True)]

    def split(self, image: Tensor) -> Tensor:
        """The blocks (B, blocks, 1024, C) of an image (B, C, H, W), mirrored at its borders."""
        rows, columns = (
            mirrored(-before, count * BLOCK_SIDE - before, length)
            for length, before, count in zip(self.size, self.offset, self.counts, strict=True)
        )
        grid = image[:, :, rows[:, None], columns].unflatten(2, (-1, BLOCK_SIDE)).unflatten(4, (-1, BLOCK_SIDE))
        return grid.permute(0, 2, 4, 3, 5, 1).flatten(3, 4).flatten(1, 2)

    def join(self, blocks: Tensor) -> Tensor:
        """The image (B, C, H, W) of blocks (B, blocks, 1024, C)."""
        grid = blocks.unflatten(1, self.counts).unflatten(3, (BLOCK_SIDE, BLOCK_SIDE)).permute(0, 5, 1, 3, 2, 4)
        (height, width), (above, left) = self.size, self.offset
        return grid.flatten(4, 5).flatten(2, 3)[:, :, above : above + height, left : left + width]


def features(normal: Tensor, position: Tensor, surface: Tensor) -> Tensor:
    """The features (N, 1024, 10) of blocks, from normals and positions (N, 1024, 3), 0 off surfaces (N, 1024, 1)."""
    low = torch.where(surface, position, torch.inf).amin(dim=1, keepdim=True)
    extent = torch.where(surface, position, -torch.inf).amax(dim=1, keepdim=True) - low
    extent = torch.maximum(extent, MIN_RELATIVE_EXTENT * extent.amax(dim=2, keepdim=True))
    scaled = (position - low) / torch.where(extent > 0, extent, 1)
    return torch.where(surface, torch.cat([torch.ones_like(surface), normal, scaled, scaled.square()], dim=2), 0)


@compiled.by(kernels.regress)
def regress(irradiance: Tensor, normal: Tensor, depth: Tensor, axes: Tensor, noise: Tensor, offset: Offset) -> Tensor:
    """Irradiance (B, 3, H, W) fitted in each block: coefficients of noisy features, applied to features without noise.

    `axes` (B, 3, 3) are the camera's ray_axes, `noise` is (1024, 10).
    """
    blocks = Blocks((depth.shape[-2], depth.shape[-1]), offset)
    surface = blocks.split(depth) > 0
    light = torch.where(surface, blocks.split(irradiance), 0).double()
    not_empty = surface.flatten(2).any(dim=2)
    normals, positions = (blocks.split(image)[not_empty] for image in (normal, positions_around_eye(depth, axes)))
    clean = features(normals.double(), positions, surface[not_empty])
    q, r = torch.linalg.qr(clean + noise)
    light[not_empty] = clean @ torch.linalg.solve_triangular(r, q.mT @ light[not_empty], upper=True)
    return blocks.join(light.to(irradiance))


@dataclass(frozen=True)
class BMFRState(AccumulatedState):
    fit: Tensor  # (B, 3, H, W), accumulated fitted irradiance
    frames: int  # since the last reset, this one included


class BMFR(Accumulating):
    """Fits accumulated irradiance in blocks of 32 x 32 pixels, and accumulates the fits."""

    made_from = "code"
    refuses = CLASSICAL

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, BMFRState, frame)
        history = self.accumulated(frame, previous)
        number = previous.frames if previous else 0
        axes = ray_axes(frame.now)
        noise = feature_noise(number).to(axes)
        fit = regress(history.irradiance, frame.normal, frame.depth, axes, noise, grid_offset(number))
        fit = fit.clamp(0, MAX_MAGNITUDE)
        if previous:
            past_fit, _ = reproject(frame, previous.fit, previous.history.gbuffer)
            # The length is 1 where there is no history.
            fit = torch.lerp(past_fit, fit, (1 / history.length).clamp(min=MIN_FIT_ALPHA))
        return frame.remodulate(fit, self.signal), BMFRState(frame.moment, history, fit, number + 1)
