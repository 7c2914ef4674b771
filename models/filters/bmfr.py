"""BMFR: blockwise multi-order feature regression (Koskela et al. 2019).

Accumulated irradiance is fitted, block by block, by a linear combination of noise-free features; what was fitted is
accumulated once more. Features, size of blocks, amount of noise and weights are those of the code that its authors
published (github.com/maZZZu/bmfr); we do not have the paper's text. Its last stage, temporal antialiasing, comes after
remodulation and is an option for every denoiser here: `bmfr+taa` is the whole pipeline. wrappers.taa blends after Karis,
0.1 of the newest frame, the authors 0.2 of gamma-corrected pictures.

What is ours:

- History is found as for all denoisers here (history.reprojection), for what is accumulated first and second alike.
- Positions are along the world's axes, around the camera, and scaled to [0, 1] in each block, then squared. Squares of
  positions as they are would span the same space together with 1 and positions, wherever the origin is; but far from
  it, noise hides what tells them from positions. The authors scale only what extends over more than a unit; we scale
  always, so that the unit cancels.
- An axis along which a block is flat, to 10^-3 of its largest extent, is scaled by that: rounding is no feature.
- Background takes part in no regression: its light and features, the constant too, are 0 but for the noise. So blocks
  with few surfaces, or a single pixel, are regularised as strongly as full ones, and have full rank. Blocks without any
  are left out.
- The grid's offsets are the first 16 points of the R2 sequence. Noise is the same for all blocks of a frame, and drawn
  anew for each by its number since the last reset.
- Images narrower than a block are mirrored again and again.
- QR factors are computed in float64, in which no irradiance overflows; fits are cut at the largest light of a frame.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import MAX_MAGNITUDE, Frame
from models import compiled
from models.compiled import bmfr as kernels
from models.compiled.bmfr import BLOCK_SIDE, MIN_RELATIVE_EXTENT, REGRESSORS
from models.denoiser import CLASSICAL, State, matching_state
from models.filters.baselines import Accumulated, AccumulatedState, Accumulating
from models.history.reprojection import reproject
from models.history.surfaces import positions_around_eye, ray_axes

NOISE = 0.01  # largest, of what is added to features against rank deficiency
SMALLEST_SECOND_ALPHA = 0.1  # weight of the newest fit in a long history
OFFSETS = 16  # of the grid, after which they repeat
PLASTIC_NUMBER = 1.32471795724474602596  # R2's steps are its first two negative powers
Offset = tuple[int, int]  # px, from the upper left pixel of the grid's first block to that of the image


def grid_offset(number: int) -> Offset:
    """Where the grid of blocks lies in frame `number`, down and across, each from 0 to 31."""
    place = number % OFFSETS + 1
    down, across = (int(BLOCK_SIDE * (place * PLASTIC_NUMBER**-power % 1)) for power in (1, 2))
    return down, across


def feature_noise(number: int) -> Tensor:
    """What is added to the features (1024, 10) of each block in frame `number`, float64; always the same."""
    generator = torch.Generator().manual_seed(number)
    uniform = torch.rand(BLOCK_SIDE**2, REGRESSORS, dtype=torch.float64, generator=generator)
    noise = NOISE * (2 * uniform - 1)
    noise[:, 0] = 0  # the constant's
    return noise


def mirrored(first: int, last: int, size: int) -> Tensor:
    """The pixels at the places from `first` to before `last` of an axis that is mirrored at both ends of its `size`."""
    place = torch.arange(first, last) % (2 * size)
    return torch.minimum(place, 2 * size - 1 - place)


class Blocks:
    """How images of a size (H, W) fall into blocks of a grid that begins `offset` before them."""

    def __init__(self, size: tuple[int, int], offset: Offset):
        self.size = size
        self.offset = offset
        self.counts = [-(-(length + before) // BLOCK_SIDE) for length, before in zip(size, offset, strict=True)]

    def split(self, image: Tensor) -> Tensor:
        """The pixels (B, blocks, 1024, C) of an image (B, C, H, W), mirrored at its borders."""
        rows, columns = (
            mirrored(-before, count * BLOCK_SIDE - before, length)
            for length, before, count in zip(self.size, self.offset, self.counts, strict=True)
        )
        grid = image[:, :, rows[:, None], columns].unflatten(2, (-1, BLOCK_SIDE)).unflatten(4, (-1, BLOCK_SIDE))
        return grid.permute(0, 2, 4, 3, 5, 1).flatten(3, 4).flatten(1, 2)

    def join(self, blocks: Tensor) -> Tensor:
        """The image (B, C, H, W) of pixels (B, blocks, 1024, C)."""
        grid = blocks.unflatten(1, self.counts).unflatten(3, (BLOCK_SIDE, BLOCK_SIDE))
        image = grid.permute(0, 5, 1, 3, 2, 4).flatten(4, 5).flatten(2, 3)
        (height, width), (above, left) = self.size, self.offset
        return image[:, :, above : above + height, left : left + width]


def features(normal: Tensor, position: Tensor, surface: Tensor) -> Tensor:
    """The features (N, 1024, 10) of blocks, from normals and positions (N, 1024, 3), 0 off surfaces (N, 1024, 1)."""
    low = torch.where(surface, position, torch.inf).amin(dim=1, keepdim=True)
    extent = torch.where(surface, position, -torch.inf).amax(dim=1, keepdim=True) - low
    extent = torch.maximum(extent, MIN_RELATIVE_EXTENT * extent.amax(dim=2, keepdim=True))
    scaled = (position - low) / torch.where(extent > 0, extent, 1)
    return torch.where(surface, torch.cat([torch.ones_like(surface), normal, scaled, scaled.square()], dim=2), 0)


@compiled.by(kernels.regress)
def regress(irradiance: Tensor, normal: Tensor, depth: Tensor, axes: Tensor, noise: Tensor, offset: Offset) -> Tensor:
    """Irradiance (B, 3, H, W), fitted in each block by the features with `noise` (1024, 10), made of those without.

    `axes` (B, 3, 3) are the camera's ray_axes.
    """
    blocks = Blocks((depth.shape[-2], depth.shape[-1]), offset)
    surface = blocks.split(depth) > 0
    light = torch.where(surface, blocks.split(irradiance), 0).double()
    shown = surface.flatten(2).any(dim=2)
    normals, positions = (blocks.split(image)[shown] for image in (normal, positions_around_eye(depth, axes)))
    clean = features(normals.double(), positions, surface[shown])
    q, r = torch.linalg.qr(clean + noise)
    light[shown] = clean @ torch.linalg.solve_triangular(r, q.mT @ light[shown], upper=True)
    return blocks.join(light.to(irradiance))


@dataclass(frozen=True)
class BMFRState(AccumulatedState):
    fitted: Tensor  # (B, 3, H, W), irradiance, accumulated
    frames: int  # since the last reset, this one among them


class BMFR(Accumulating):
    """Fits accumulated irradiance in blocks of 32 x 32 pixels, and accumulates that."""

    reads = Accumulated.reads
    refuses = CLASSICAL

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, BMFRState, frame)
        history = self.accumulated(frame, before)
        number = before.frames if before else 0
        axes = ray_axes(frame.now)
        noise = feature_noise(number).to(axes)
        fitted = regress(history.irradiance, frame.normal, frame.depth, axes, noise, grid_offset(number))
        fitted = fitted.clamp(0, MAX_MAGNITUDE)
        if before:
            past, _ = reproject(frame, before.fitted, before.history.surfaces)
            # The length is 1 where no history was found.
            fitted = torch.lerp(past, fitted, (1 / history.length).clamp(min=SMALLEST_SECOND_ALPHA))
        return frame.remodulate(fitted, self.signal), BMFRState(frame.moment, history, fitted, number + 1)
