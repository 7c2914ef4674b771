"""Coarse corrections: neighbourhoods of the denoised light get the mean that their samples have.

A filter that reaches across shadows and highlights is biased, and its history may lag. Samples are not: over enough
pixels and frames their mean is nearer to the truth. So the residual of the denoised luminance is summed over tiles and
frames, and the light is multiplied by what the sums of a neighbourhood say, shrunk by their noise. The history of the
denoised light is left as it is: every frame is corrected anew.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.compiled.one import MAX_EXPOSED
from models.history.light_gain import at_pixels, gain_of
from models.operators import block_sums, image_luminance

COARSE_TILE = 8  # px
COARSE_DEVIATIONS = (4, 1)  # tiles, of the Gaussians that weight them: a neighbourhood after the other
COARSE_NOISE = 2.0  # standard errors of a neighbourhood's mean: smaller residuals do not count
COARSE_DARK = 0.3  # exposed luminance: residuals of what is darker count less than relative ones
COARSE_LEAST = 0.0  # gain: where no sample has any light, it is black
COARSE_LENGTH = 4.0  # frames that residuals are averaged over at most


@dataclass(frozen=True)
class CoarseLight:
    """What tiles know of the residual, and what a frame's light is multiplied by."""

    residual: Tensor  # (B, 3, h, w): its sum, the variance of the sum, and of how many frames it is the mean
    gain: Tensor  # (B, 1, h, w)

    def corrected(self, images: Tensor) -> Tensor:
        """Images (B, C, H, W) of light times the gain, interpolated between tiles."""
        height, width = images.shape[-2:]
        return images * at_pixels(self.gain, height, width, COARSE_TILE)


def compared(noisy: Tensor, denoised: Tensor, exposure: Tensor, surface: Tensor, motion: Tensor) -> Tensor:
    """What is summed over tiles, (B, 6, H, W), 0 where no surface is.

    The residual of the luminance of irradiance (B, 3, H, W), its square, the denoised luminance, motion, and 1. Light
    is relative to the denoised one, since bright pixels of a neighbourhood must not outweigh the others; but those that
    are displayed dark count less.
    """
    exposed = (image_luminance(exposure * image).clamp(0.0, MAX_EXPOSED) for image in (noisy, denoised))
    sample, light = exposed
    residual = (sample - light) / (light + COARSE_DARK)
    return surface * torch.cat(
        [residual, residual.square(), light / (light + COARSE_DARK), motion, torch.ones_like(light)], dim=1
    )


def fetched_tiles(tiles: Tensor, motion: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Tiles (B, C, h, w) where `motion` (B, 2, h, w), in px, leads from their centres, and whether that is inside.

    Bilinear, the outermost ones repeated. `size` is (h, w), or less where the last ones are padding.
    """
    places, inside = [], torch.ones_like(motion[:, :1], dtype=torch.bool)
    for axis, count in ((-2, size[0]), (-1, size[1])):
        index = torch.arange(motion.shape[axis], dtype=motion.dtype, device=motion.device)
        place = (index[:, None] if axis == -2 else index) + motion[:, axis + 1] / COARSE_TILE
        inside = inside & ((place >= -0.5) & (place <= count - 0.5))[:, None]
        places.append(place.clamp(0, count - 1))
    down, across = places
    top, left = down.floor(), across.floor()
    bottom, right = (top + 1).clamp(max=size[0] - 1), (left + 1).clamp(max=size[1] - 1)

    def at(row: Tensor, column: Tensor) -> Tensor:
        index = (row * tiles.shape[-1] + column).long().flatten(1)[:, None].expand(-1, tiles.shape[1], -1)
        return tiles.flatten(2).gather(2, index).unflatten(2, motion.shape[-2:])

    above, below = (torch.lerp(at(row, left), at(row, right), (across - left)[:, None]) for row in (top, bottom))
    return torch.lerp(above, below, (down - top)[:, None]), inside


def averaged(sums: Tensor, before: Tensor, motion: Tensor, size: tuple[int, int]) -> Tensor:
    """The residual (CoarseLight) with this frame's `sums` (B, 2, h, w) of it and its square; 0 `before` the first one.

    The mean of all frames up to COARSE_LENGTH, then an exponential one. motion, size: see fetched_tiles.
    """
    past, inside = fetched_tiles(before, motion, size)
    total, variance, length = (past * inside).split(1, dim=1)
    length = (length + 1).clamp(max=COARSE_LENGTH)
    newest = 1 / length
    total = torch.lerp(total, sums[:, :1], newest)
    variance = (1 - newest).square() * variance + newest.square() * sums[:, 1:]
    return torch.cat([total, variance, length], dim=1)


def coarse_gain(residual: Tensor, light: Tensor) -> Tensor:
    """What tiles of light are multiplied by, (B, 1, h, w), from CoarseLight.residual and sums of relative light.

    See light_gain.gain_of; the second, smaller neighbourhoods see what the first ones leave. Tiles count by the frames
    they know.
    """
    total, variance, length = residual.split(1, dim=1)
    gain = torch.ones_like(total)
    for deviation in COARSE_DEVIATIONS:
        rest = total - (gain - 1) * light
        sums = torch.cat([length * gain * light, length * rest, length.square() * variance], dim=1)
        gain = gain * gain_of(sums, deviation, COARSE_NOISE, COARSE_LEAST)
    return gain


def correction_of(sums: Tensor, before: Tensor, size: tuple[int, int]) -> CoarseLight:
    """The correction of a frame from the sums (B, 6, h, w) of what is `compared`, and the residual before."""
    residual, light, motion, pixels = sums.split([2, 1, 2, 1], dim=1)
    after = averaged(residual, before, motion / pixels.clamp(min=1), size)
    return CoarseLight(after, coarse_gain(after, light))


def correct_coarsely(
    noisy: Tensor, denoised: Tensor, exposure: Tensor, surface: Tensor, motion: Tensor, before: CoarseLight | None
) -> CoarseLight:
    """The correction of a frame's `denoised` irradiance by its `noisy` one, (B, 3, H, W), and what the next one needs.

    `exposure` is that of irradiance, `surface` (B, 1, H, W) 1 where a pixel shows one, else 0, and `motion`
    (B, 2, H, W) leads to the previous frame, whose correction is `before`. Without gradients.
    """
    with torch.no_grad():
        sums = block_sums(compared(noisy, denoised, exposure, surface, motion), COARSE_TILE)
        past = torch.zeros_like(sums[:, :3]) if before is None else before.residual
        return correction_of(sums, past, (sums.shape[-2], sums.shape[-1]))
