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

GAUSSIAN_REACH = 3  # deviations: the radius of Gaussians
GAIN_DEVIATION = 2  # tiles, of the Gaussian that weights them
GAIN_NOISE = 3.0  # standard errors of a neighbourhood's mean: smaller differences do not count
MAX_GAIN = 4.0  # of a neighbourhood, a frame
MIN_GAIN = 1 / MAX_GAIN


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


def gaussian_sums(tiles: Tensor, deviation: int) -> Tensor:
    """Sums (B, C, h, w) of tiles around each, with the weights of a Gaussian, its own being 1; 0 outside the image."""
    radius = GAUSSIAN_REACH * deviation
    offsets = torch.arange(-radius, radius + 1, dtype=tiles.dtype, device=tiles.device)
    weights = torch.exp(-offsets.square() / (2 * deviation**2))
    rows, columns = weights.view(1, 1, -1, 1), weights.view(1, 1, 1, -1)
    images = tiles.flatten(0, 1)[:, None]
    images = F.conv2d(F.conv2d(images, rows, padding=(radius, 0)), columns, padding=(0, radius))
    return images.view_as(tiles)


def gain_of(
    sums: Tensor, deviation: int = GAIN_DEVIATION, noise: float = GAIN_NOISE, least: float = MIN_GAIN
) -> Tensor:
    """What light is multiplied by in each tile, (B, 1, h, w), from `tile_sums`: of light, its change, and its variance.

    From `least` to MAX_GAIN. The change of a neighbourhood is shrunk by the square of its noise, as James and Stein
    shrink means (1961): what is below so many standard errors does not count. The squared standard error of a sum
    with weights w is Σ w² v for values of variance v, and for a Gaussian w half of Σ w v; here v is the square of the
    change itself.
    """
    past, change, variance = gaussian_sums(sums, deviation).split(1, dim=1)
    size = change.abs().clamp(min=MIN_DIVISOR)
    significance = (1 - noise**2 / 2 * variance / size / size).clamp(min=0)
    return 1 + significance * (change / past.clamp(min=MIN_DIVISOR)).clamp(least - 1, MAX_GAIN - 1)


def at_pixels(tiles: Tensor, height: int, width: int, tile: int = TILE) -> Tensor:
    """Tiles (B, 1, h, w) of `tile` px, interpolated bilinearly between their centres: (B, 1, H, W)."""
    for dim, size in ((-2, height), (-1, width)):
        before, after, share = (each.to(tiles.device) for each in between_tiles(size, tile))
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
