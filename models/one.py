"""`one`: our own recurrent denoiser, made of convex kernels on irradiance and of history that surfaces vouch for."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models.denoiser import Denoiser, State, matching_state
from models.operators import image_luminance, pad_to_multiple
from models.reprojection import reproject
from models.running_scale import RunningScale, running_scale
from models.surfaces import Surfaces

LATENT = 6  # channels carried beside images, in [-1, 1]
FEATURES = 8  # that pixels are compared by
LEVELS = 4  # of the filter at full resolution, whose taps are 1, 2, 4 and 8 pixels apart
COARSE_FACTOR = 4
COARSE_LEVELS = 3  # of the filter on a quarter of the resolution
MULTIPLE = 8  # of the sides of an image that the network takes
LARGEST_LOG = 30.0  # of compressed irradiance: what is brighter looks alike to the network


def shifted(x: Tensor, step: int) -> Tensor:
    """The 3 x 3 taps `step` pixels apart around every pixel: (B, C, 9, H, W), 0 outside the image."""
    batch, channels, height, width = x.shape
    taps = F.unfold(x, 3, dilation=step, padding=step)
    return taps.view(batch, channels, 9, height, width)


def mesh_sums(x: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    """Sums (B, C, H, W) over those of the 3 x 3 taps that lie on the pixel's own mesh."""
    same = shifted(mesh_id + 1, step) == mesh_id[:, :, None] + 1
    return (shifted(x, step) * same).sum(dim=2)


def affinity_level(image: Tensor, features: Tensor, sharpness: Tensor, centre: Tensor, surface: Tensor, step: int) -> Tensor:
    """A convex mean over 3 x 3 taps (Işık et al. 2021, Eq. 4): weights exp(-sharpness |f_p - f_q|²), the centre's its own.

    image (B, 3, H, W), features (B, F, H, W), sharpness and centre (B, 1, H, W) > 0, surface (B, 1, H, W) of 1 and 0.
    """
    channels = torch.cat([features, image, surface], dim=1)
    count = features.shape[1]
    taps = shifted(channels, step)
    distance = (taps[:, :count] - features[:, :, None]).square().sum(dim=1)
    weight = torch.exp(-sharpness * distance) * taps[:, -1]
    weight = torch.cat([weight[:, :4], centre, weight[:, 5:]], dim=1)
    total = (taps[:, count:-1] * weight[:, None]).sum(dim=2)
    return total / weight.sum(dim=1, keepdim=True)


def conv(inputs: int, outputs: int, size: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, size, padding=size // 2), nn.ReLU(inplace=True))


class Trunk(nn.Module):
    """A small U-Net at 1/2, 1/4 and 1/8 of the resolution, and what it says at full and at quarter resolution."""

    def __init__(self, inputs: int, full: int, quarter: int, widths: tuple[int, int, int]):
        super().__init__()
        a, b, c = widths
        self.enter = nn.Sequential(conv(4 * inputs, a, 1), conv(a, a, 3))
        self.down_b = nn.Sequential(conv(4 * a, b, 1), conv(b, b, 3))
        self.down_c = nn.Sequential(conv(4 * b, c, 1), conv(c, c, 3), conv(c, c, 3))
        self.up_b = nn.Conv2d(c, 4 * b, 1)
        self.join_b = conv(b, b, 3)
        self.up_a = nn.Conv2d(b, 4 * a, 1)
        self.join_a = conv(a, a, 3)
        self.quarter = nn.Conv2d(b, quarter, 1)
        self.full = nn.Conv2d(a, 4 * full, 1)
        self.detail = nn.Conv2d(inputs, full, 1)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(full (B, ·, H, W), quarter (B, ·, H / 4, W / 4)) of x (B, inputs, H, W), whose sides are multiples of 8."""
        a = self.enter(F.pixel_unshuffle(x, 2))
        b = self.down_b(F.pixel_unshuffle(a, 2))
        c = self.down_c(F.pixel_unshuffle(b, 2))
        b = self.join_b(b + F.pixel_shuffle(self.up_b(c), 2))
        a = self.join_a(a + F.pixel_shuffle(self.up_a(b), 2))
        return F.pixel_shuffle(self.full(a), 2) + self.detail(x), self.quarter(b)


@dataclass(frozen=True)
class OneState(State):
    """What is carried: irradiance denoised and merely accumulated, the effective length of the latter, latent channels."""

    output: Tensor  # (B, 3, H, W)
    accumulated: Tensor  # (B, 3, H, W)
    length: Tensor  # (B, 1, H, W), frames
    latent: Tensor  # (B, LATENT, H, W)
    surfaces: Surfaces
    scale: RunningScale
    alpha: Tensor  # (B, 2, H, W), of accumulation and output; to look at

    def pictures(self) -> dict[str, Tensor]:
        return {
            "history length": self.length,
            "accumulated": self.accumulated,
            "weight of the frame in accumulation": self.alpha[:, :1],
            "weight of the frame in output": self.alpha[:, 1:],
        }


@dataclass(frozen=True)
class Evidence:
    """What is known of each pixel before the network speaks; irradiance, all (B, ·, H, W)."""

    noisy: Tensor
    near: Tensor  # mean over 3 x 3 pixels of the same mesh
    around: Tensor  # over 9 x 9
    deviation: Tensor  # relative one of luminance over 9 x 9
    output: Tensor  # of the frame before, or `around` where it was not found
    accumulated: Tensor
    length: Tensor  # 0 where not found
    latent: Tensor
    found: Tensor


class One(Denoiser):
    """Recurrent kernel prediction. Where no surface vouches for history, there is none: the weight of the frame is 1."""

    reads = (
        "direct",
        "indirect",
        "emission",
        "albedo",
        "normal",
        "depth",
        "roughness",
        "mesh_id",
        "motion",
    )
    refuses: ClassVar = {torch.float16: "it is slower than float32 on processors, which bfloat16 is not"}
    is_network = True
    widths: ClassVar[tuple[int, int, int]] = (40, 56, 64)

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        inputs = 5 * 3 + 3 + LATENT + 8
        self.full_split = (FEATURES, LEVELS, LEVELS, 2, 1, LATENT)
        self.quarter_split = (FEATURES, COARSE_LEVELS, COARSE_LEVELS)
        self.trunk = Trunk(inputs, sum(self.full_split), sum(self.quarter_split), self.widths)

    def compress(self, irradiance: Tensor, scale: RunningScale, frame: Frame) -> Tensor:
        """Irradiance (B, 3, H, W) into the range of logarithms: log(1 + gain · exposure · irradiance)."""
        return torch.log1p((irradiance.clamp(min=0) * (scale.exposure() * frame.gain))).clamp(max=LARGEST_LOG)

    def evidence(self, frame: Frame, noisy: Tensor, before: OneState | None) -> Evidence:
        surface = (frame.depth > 0).to(noisy)
        luminance = image_luminance(noisy)
        each = torch.cat([noisy, luminance, luminance.clamp(max=1e15).square(), torch.ones_like(luminance)], dim=1) * surface
        close = mesh_sums(each, frame.mesh_id, 1)
        wide = mesh_sums(close, frame.mesh_id, 3)
        near = close[:, :3] / close[:, 5:].clamp(min=1)
        mean = wide[:, :5] / wide[:, 5:].clamp(min=1)
        around, first, second = mean[:, :3], mean[:, 3:4], mean[:, 4:]
        deviation = (second - first.square()).clamp(min=0).sqrt() / first.clamp(min=1e-20)
        nothing = torch.zeros_like(luminance)
        output, accumulated, length, latent, found = around, noisy, nothing, nothing.expand(-1, LATENT, -1, -1), nothing
        if before is not None:
            carried = torch.cat([before.output, before.accumulated, before.length, before.latent], dim=1)
            past, where = reproject(frame, carried, before.surfaces)
            where = where & (frame.depth > 0)
            found = where.to(noisy)
            output = torch.where(where, past[:, :3], around)
            accumulated = torch.where(where, past[:, 3:6], noisy)
            length = past[:, 6:7] * found
            latent = past[:, 7:] * found
        return Evidence(noisy, near, around, deviation, output, accumulated, length, latent, found)

    def network_inputs(self, frame: Frame, known: Evidence, scale: RunningScale) -> Tensor:
        images = (known.noisy, known.near, known.around, known.output, known.accumulated)
        numbers = (torch.log1p(known.deviation), 1 / (known.length + 1), known.found)
        surfaces = (frame.albedo, frame.view_normal(), scale.normalised_depth(frame.depth), frame.roughness)
        compressed = [self.compress(image, scale, frame) for image in images]
        return torch.cat([*compressed, *numbers, known.latent, *surfaces], dim=1)

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        """Denoised irradiance (B, 3, H, W), and the state for the next frame."""
        before = matching_state(state, OneState, frame)
        surface = (frame.depth > 0).to(frame.depth)
        noisy = frame.irradiance(self.signal).clamp(min=0) * surface
        scale = running_scale(noisy * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        known = self.evidence(frame, noisy, before)
        height, width = frame.size
        x = pad_to_multiple(self.network_inputs(frame, known, scale), MULTIPLE)
        full, quarter = self.trunk(x.to(self.precision, memory_format=torch.channels_last))
        full = full[..., :height, :width].to(noisy)
        features, sharpness, centre, alphas, mix, latent = full.split(self.full_split, dim=1)
        # The prior of accumulation is the even mean, of which the network says how far to leave it.
        fresh = torch.cat([alphas[:, :1] - torch.log(known.length.clamp(min=1e-3)), alphas[:, 1:]], dim=1)
        alpha = torch.where(known.found > 0, torch.sigmoid(fresh), 1)
        accumulated = torch.lerp(known.accumulated, noisy, alpha[:, :1])
        length = 1 / (alpha[:, :1].square() + (1 - alpha[:, :1]).square() / known.length.clamp(min=1))
        image = self.filtered(accumulated, surface, features, sharpness, centre, mix, quarter.to(noisy))
        output = torch.lerp(known.output, image, alpha[:, 1:]) * surface
        latent = torch.tanh(latent)
        return output, OneState(
            frame.moment, output, accumulated, length, latent, Surfaces.of(frame), scale, alpha.detach()
        )

    def filtered(
        self, image: Tensor, surface: Tensor, features: Tensor, sharpness: Tensor, centre: Tensor, mix: Tensor, quarter: Tensor
    ) -> Tensor:
        """The image after the coarse and the fine filter; each is a convex mean of surfaces' pixels."""
        coarse = self.coarse(image, surface, quarter)
        share = torch.sigmoid(mix)
        image = torch.lerp(image, coarse[0], share * (coarse[1] > 0))
        for level in range(LEVELS):
            sharp = F.softplus(sharpness[:, level : level + 1])
            own = F.softplus(centre[:, level : level + 1]) + 1e-4
            image = affinity_level(image, features, sharp, own, surface, 1 << level)
        return image

    def coarse(self, image: Tensor, surface: Tensor, quarter: Tensor) -> tuple[Tensor, Tensor]:
        """The image filtered on a quarter of the resolution and enlarged, and where surfaces stand behind it."""
        height, width = image.shape[-2:]
        padded = F.pad(torch.cat([image * surface, surface], dim=1), (0, -width % MULTIPLE, 0, -height % MULTIPLE))
        small = F.avg_pool2d(padded, COARSE_FACTOR)
        share = small[:, 3:]
        there = (share > 0).to(image)
        small = small[:, :3] / share.clamp(min=1e-6)
        features, sharpness, centre = quarter.split(self.quarter_split, dim=1)
        for level in range(COARSE_LEVELS):
            sharp = F.softplus(sharpness[:, level : level + 1])
            own = F.softplus(centre[:, level : level + 1]) + 1e-4
            small = affinity_level(small, features, sharp, own, there, 1 << level)
        large = F.interpolate(torch.cat([small * there, there], dim=1), scale_factor=float(COARSE_FACTOR), mode="bilinear")
        large = large[..., :height, :width]
        return large[:, :3] / large[:, 3:].clamp(min=1e-6), large[:, 3:]

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        irradiance, after = self.predict(frame, state)
        return frame.remodulate(irradiance, self.signal), after
