"""A history that follows the light: it is multiplied by how much brighter or darker its surroundings have become.

Highlights that slide over glossy surfaces, and lamps that dim, change whole neighbourhoods. History that is multiplied
by the ratio of means stays as free of noise as it was; a larger weight of the newest frame would add noise.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.compiled import light_gain as kernels
from models.compiled.light_gain import TILE, between_tiles
from models.operators import MAX_LUMINANCE, MIN_DIVISOR, block_sums, image_luminance

GAIN_RADIUS = 6  # tiles
GAIN_DEVIATION = 2.0  # tiles, of the Gaussian that weights them
GAIN_NOISE = 3.0  # standard errors of a neighbourhood's mean: smaller differences do not count
MAX_GAIN = 4.0  # of history, a frame


def changes(history: Tensor, noisy: Tensor, has_history: Tensor) -> Tensor:
    """What is summed over tiles, (B, 3, H, W): luminance of history, by how much the frame's is more, and its square.

    Of `noisy` irradiance (B, 3, H, W), and of the first channels of `history` (B, C, H, W); 0 where there is no history
    (B, 1, H, W).
    """
    images = history[:, :3], noisy
    past, newest = (image_luminance(image).clamp(max=MAX_LUMINANCE) * has_history for image in images)
    change = newest - past
    return torch.cat([past, change, change.square()], dim=1)


@compiled.by(kernels.tile_sums)
def tile_sums(history: Tensor, noisy: Tensor, has_history: Tensor) -> Tensor:
    """Sums (B, 3, h, w) of `changes` over tiles, smaller ones at the far borders."""
    return block_sums(changes(history, noisy, has_history), TILE)


def gain_of(sums: Tensor) -> Tensor:
    """What history is multiplied by in each tile, (B, 1, h, w), from `tile_sums`.

    The change of a neighbourhood is shrunk by the square of its noise, as James and Stein shrink means (1961). Noise
    is estimated from the changes themselves: the squared standard error of a sum of values d with weights w is Σ w² d²,
    and for a Gaussian w half of Σ w d².
    """
    offsets = torch.arange(-GAIN_RADIUS, GAIN_RADIUS + 1, dtype=sums.dtype, device=sums.device)
    weights = torch.exp(-offsets.square() / (2 * GAIN_DEVIATION**2))
    rows, columns = weights.view(1, 1, -1, 1), weights.view(1, 1, 1, -1)
    images = sums.flatten(0, 1)[:, None]
    images = F.conv2d(F.conv2d(images, rows, padding=(GAIN_RADIUS, 0)), columns, padding=(0, GAIN_RADIUS))
    past, change, square = images.view_as(sums).split(1, dim=1)
    size = change.abs().clamp(min=MIN_DIVISOR)
    significance = (1 - GAIN_NOISE**2 / 2 * square / size / size).clamp(min=0)
    return 1 + significance * (change / past.clamp(min=MIN_DIVISOR)).clamp(1 / MAX_GAIN - 1, MAX_GAIN - 1)


def at_pixels(tiles: Tensor, height: int, width: int) -> Tensor:
    """Tiles (B, 1, h, w), interpolated bilinearly between their centres: (B, 1, H, W)."""
    for dim, size in ((-2, height), (-1, width)):
        before, after, share = (each.to(tiles.device) for each in between_tiles(size))
        share = share[:, None] if dim == -2 else share
        tiles = torch.lerp(tiles.index_select(dim, before), tiles.index_select(dim, after), share)
    return tiles


@compiled.by(kernels.multiplied)
def multiplied(history: Tensor, gain: Tensor, lights: int) -> Tensor:
    """History (B, C, H, W), its first `lights` channels multiplied by the gain of tiles; perhaps in the same memory."""
    return torch.cat([history[:, :lights] * at_pixels(gain, *history.shape[-2:]), history[:, lights:]], dim=1)


def follow_light(history: Tensor, noisy: Tensor, has_history: Tensor, lights: int) -> Tensor:
    """A reprojected history (B, C, H, W) whose first `lights` channels follow the frame's light.

    Its first three channels are compared with the frame's `noisy` irradiance (B, 3, H, W), where it `has_history`
    (B, 1, H, W). No gradients go through the gain. The result may be in the memory of `history`.
    """
    with torch.no_grad():
        gain = gain_of(tile_sums(history, noisy, has_history))
    return multiplied(history, gain, lights)
