"""Glass in two layers: each pixel of smooth glass shows two pictures, which are denoised apart and added.

Of the samples of such a pixel, a share takes the branch of the second layer at the first glass. Within a layer, light
is that of the samples that took its branch, over their share; a pixel without such samples takes the mean of those
around it. So each layer looks as if its surfaces were visible directly, and its output counts by the probability of the
branch. The second layer is the fainter one, and is denoised at half the resolution.
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.cameras import Cameras
from datasets.channels import ALBEDO_FLOOR, BACKGROUND, CHANNELS, SECOND
from datasets.frame import Frame
from models import compiled
from models.compiled import layers as kernels
from models.compiled.layers import FILL_WINDOWS
from models.networks.pixel_kernels import window_taps
from models.operators import MIN_DIVISOR, block_sums

LAYER_SCALE = 2  # px, for a pixel of the second layer


def second_share(frame: Frame) -> Tensor:
    """The probability (B, 1, H, W) of the rarer branch at the first glass; 0 without glass."""
    reflectance = frame.channel("glass_reflectance")
    return torch.minimum(reflectance, 1 - reflectance).clamp(min=0)


def window_sums(image: Tensor, mesh_id: Tensor, radius: int, of_mesh: bool) -> Tensor:
    """Sums of an image (B, C, H, W) over windows of 2 radius + 1 pixels a side, or those of the same mesh there."""
    sums = torch.zeros_like(image)
    for _, here, there in window_taps(2 * radius + 1, *mesh_id.shape[-2:]):
        sums[here] += image[there] * (mesh_id[there] == mesh_id[here]) if of_mesh else image[there]
    return sums


@compiled.by(kernels.light_of_samples)
def light_of_samples(
    weighted: Tensor, samples: Tensor, wanted: Tensor, mesh_id: Tensor, albedo: Tensor, otherwise: Tensor
) -> Tensor:
    """Radiance (B, 3, H, W): the mean irradiance of samples times albedo, where that is `wanted` (B, 1, H, W) > 0.

    `weighted` (B, 3, H, W) is irradiance times `samples` (B, 1, H, W). Pixels without samples take the mean over the
    first of FILL_WINDOWS that has any, and are black if none has.
    """
    irradiance = weighted / samples.clamp(min=MIN_DIVISOR) * (samples > 0)
    missing = (wanted > 0) & (samples == 0)
    image = torch.cat([weighted * (samples > 0), samples], dim=1)
    for radius, of_mesh in FILL_WINDOWS if missing.any() else ():
        sums = window_sums(image, mesh_id, radius, of_mesh)
        found = missing & (sums[:, 3:] > 0)
        irradiance = torch.where(found, sums[:, :3] / sums[:, 3:].clamp(min=MIN_DIVISOR), irradiance)
        missing = missing & ~found
    return torch.where(wanted > 0, irradiance * albedo.clamp(min=ALBEDO_FLOOR), otherwise)


@compiled.by(kernels.main_samples)
def main_samples(
    direct: Tensor, indirect: Tensor, second: Tensor, second_samples: Tensor, albedo: Tensor
) -> tuple[Tensor, Tensor]:
    """Irradiance (B, 3, H, W) of the main layer times the share of samples in it, and that share (B, 1, H, W)."""
    light = (direct + indirect - second).clamp(min=0)
    return light / albedo.clamp(min=ALBEDO_FLOOR), (1 - second_samples).clamp(min=0)


@compiled.by(kernels.second_samples)
def second_samples(
    second: Tensor, samples: Tensor, share: Tensor, albedo: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of each block of 2 x 2 pixels: irradiance (B, 3, h, w) times samples, and samples (B, 1, h, w), summed.

    Also the largest share in the block, and the index of its pixel in the image, by rows.
    """
    irradiance = second / albedo.clamp(min=ALBEDO_FLOOR)
    best, chosen = F.max_pool2d(share, LAYER_SCALE, ceil_mode=True, return_indices=True)
    return block_sums(irradiance, LAYER_SCALE), block_sums(samples, LAYER_SCALE), best, chosen


@compiled.by(kernels.pixels_at)
def pixels_at(image: Tensor, chosen: Tensor) -> Tensor:
    """The pixels (B, C, h, w) of an image (B, C, H, W) at indices (B, 1, h, w)."""
    index = chosen.flatten(2).expand(-1, image.shape[1], -1)
    return image.flatten(2).gather(2, index).unflatten(2, chosen.shape[2:])


@compiled.by(kernels.composed)
def composed(main: Tensor, irradiance: Tensor, share: Tensor, albedo: Tensor, emission: Tensor) -> Tensor:
    """Radiance (B, 3, H, W) of both layers.

    `main` is that of the main layer and emission, `irradiance` (B, 3, h, w) that of the second layer.
    """
    height, width = main.shape[-2:]
    blocks = irradiance.repeat_interleave(LAYER_SCALE, 2).repeat_interleave(LAYER_SCALE, 3)[..., :height, :width]
    return torch.lerp(main, blocks * albedo.clamp(min=ALBEDO_FLOOR) + emission, share)


def main_layer(frame: Frame, share: Tensor) -> Frame:
    """The frame with the light of the main layer alone, as if all samples of glass had taken its branch."""
    direct = frame.channels.get("direct", torch.zeros_like(frame.indirect))  # of glass, it is 0
    samples = (frame.channel("second_samples"), frame.albedo)
    weighted, own_samples = main_samples(direct, frame.indirect, frame.channel(SECOND["indirect"]), *samples)
    light = light_of_samples(weighted, own_samples, share, frame.mesh_id, frame.albedo, frame.indirect)
    return frame.with_channels({"indirect": light}).without("second", "buffers")


def halved(cameras: Cameras) -> Cameras:
    """The cameras of an image at half the resolution."""
    half = torch.tensor([1 / LAYER_SCALE, 1 / LAYER_SCALE, 1.0]).to(cameras.K)
    return replace(cameras, K=half[:, None] * cameras.K)


def second_layer(frame: Frame, share: Tensor) -> Frame:
    """The frame of the second layer, at half the resolution: each block has the surface of its pixel of most share."""
    channel = frame.channel
    light = (channel(SECOND["indirect"]), channel("second_samples"))
    weighted, samples, best, chosen = second_samples(*light, share, channel(SECOND["albedo"]))
    channels: dict[str, Tensor] = {}
    for name, tensor in frame.channels.items():
        kind = CHANNELS[name].kind
        if kind == "surface":
            surface = pixels_at(channel(SECOND[name]), chosen)
            channels[name] = torch.where(best > 0, surface, BACKGROUND.get(name, 0.0))
        elif kind == "motion":
            channels[name] = pixels_at(channel(SECOND["motion"]), chosen) / LAYER_SCALE
        elif kind not in ("second", "buffers", "reference"):
            channels[name] = torch.zeros_like(tensor[..., ::LAYER_SCALE, ::LAYER_SCALE])
    surfaces = (channels["mesh_id"], channels["albedo"], channels["indirect"])
    channels["indirect"] = light_of_samples(weighted, samples, best, *surfaces)
    return replace(frame, channels=channels, now=halved(frame.now), previous=halved(frame.previous)).without("second")


def blended(frame: Frame) -> Frame:
    """The frame with albedo and normals blended by the probabilities of both branches, as OIDN's documentation asks."""
    share = second_share(frame)
    guides: dict[str, Tensor] = {
        name: torch.lerp(frame.channels[name], frame.channels[SECOND[name]], share)
        for name in ("albedo", "normal")
        if name in frame.channels
    }
    return frame.with_channels(guides).without("second")
