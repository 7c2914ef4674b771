"""NTD: neural temporal denoising of indirect illumination (Zeng et al. 2021)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal, disoccluded
from models.denoiser import NO_FLOAT16, Denoiser, State, matching_state
from models.history.running_scale import RunningScale, running_scale
from models.networks.convolution import ConvReLU, encoded
from models.networks.pixel_kernels import apply_kernels
from models.operators import halve, halve_surface, pad_to_multiple, pyramid, sampling_grid

NTD_INPUTS = {"noisy": 3, "warped": 3, "albedo": 3, "normal": 3, "depth": 1}  # of the network (§4.2)
WIDTHS = (32, 48, 64, 80, 96)  # ours: the paper does not print its own
KERNEL_TAPS = 25  # of a 5 x 5 kernel
Pool = Callable[[Tensor, Tensor | None], Tensor]  # to half the size, rounded up, over surface pixels
MIN_SURFACE_SHARE = 1e-6  # of bilinear taps that show a surface; with less the result is invalid


class Decode(nn.Module):
    """Two convolutions of upsampled features and skip connection.

    The first is a sum of two convolutions, one per source: equal to one over the concatenation, without storing it.
    """

    def __init__(self, below: int, skip: int):
        super().__init__()
        self.skip = nn.Conv2d(skip, skip, 3, padding=1, bias=False)
        self.up = ConvReLU(below, skip)
        self.second = ConvReLU(skip, skip)

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:
        return self.second(self.up(F.interpolate(x, scale_factor=2.0), self.skip(skip)))


class KernelNet(nn.Module):
    """A U-Net (Ronneberger et al. 2015) that predicts kernels and weights in its last three layers (Fig. 6).

    Ours, where the paper is silent: two 3 x 3 convolutions and ReLU per level, nearest upsampling, 1 x 1 heads.
    """

    def __init__(self) -> None:
        super().__init__()
        widths = (sum(NTD_INPUTS.values()), *WIDTHS)
        self.encode = nn.ModuleList(nn.Sequential(ConvReLU(a, b), ConvReLU(b, b)) for a, b in pairwise(widths))
        self.decode = nn.ModuleList(Decode(below, skip) for below, skip in pairwise(WIDTHS[::-1]))
        outputs = (KERNEL_TAPS + 1, KERNEL_TAPS + 1, 2 * KERNEL_TAPS + 1)
        self.heads = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(WIDTHS[2::-1], outputs, strict=True))
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.xavier_uniform_(layer.weight)  # §5
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> list[Tensor]:
        """Predictions at 1/4 and 1/2 (26 channels) and at full resolution (51), from x (B, 13, H, W)."""
        *skips, x = encoded(self.encode, x)
        decoded = []
        for decode, skip in zip(self.decode, skips[::-1], strict=True):
            x = decode(x, skip)
            decoded.append(x)
        return [head(x) for head, x in zip(self.heads, decoded[-3:], strict=True)]


def warp(image: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """image(p + motion(p)), bilinear (Eq. 3), and whether p + motion(p) is inside the image, (B, 1, H, W).

    Outside, the border is repeated. `image` (B, C, H, W); `motion` (B, 2, H, W) in pixels.
    """
    grid = sampling_grid(motion)
    inside = (grid.abs() <= 1).all(dim=-1)[:, None]
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False), inside


def maximum_pool(image: Tensor, surface: Tensor | None = None) -> Tensor:
    """The maximum of 2 x 2 pixels, of an image that is not negative: D of the paper's Eq. 4."""
    return F.max_pool2d(image if surface is None else image * surface, 2, ceil_mode=True)


def combine_levels(
    fine: Tensor, coarse: Tensor, alpha: Tensor, surface: Tensor | None = None, pool: Pool = maximum_pool
) -> Tensor:
    """i_f - U[alpha_c [D i_f]] + U[alpha_c i_c] (Eq. 4): D is `pool`, U is bilinear.

    U is linear, so it is applied once. `fine` (B, C, H, W) is not negative; `coarse` and `alpha` (B, 1, ·, ·) have half
    the size, rounded up. D and U use pixels of the `surface` (B, 1, H, W). With the paper's maximum, more is
    subtracted than added.
    """
    height, width = fine.shape[-2:]

    def enlarge(x: Tensor) -> Tensor:
        return F.interpolate(x, scale_factor=2.0, mode="bilinear")[..., :height, :width]

    change = alpha * (coarse - pool(fine, surface))
    if surface is None:
        return fine + enlarge(change)
    valid = halve_surface(surface)
    return fine + enlarge(change * valid) / enlarge(valid).clamp(min=MIN_SURFACE_SHARE)


def reconstruct_image(
    noisy: Tensor,
    warped: Tensor,
    predictions: Sequence[Tensor],
    surface: Tensor | None = None,
    pool: Pool = maximum_pool,
) -> tuple[Tensor, Tensor]:
    """The denoised image (B, 3, H, W) and alpha_t (B, 1, H, W), the weight of the current frame in it (§4.3, Fig. 6).

    From linear irradiance (B, 3, H, W) of this frame and of the previous output, and the network's predictions, coarse
    to fine, at least as large as the images. `pool` is D of Eq. 4; pixels of the `surface` are gathered.
    """
    output = noisy
    alpha: Tensor | None = None
    # Levels are averages: maxima of noise would be biased.
    for (image, valid), prediction in zip(pyramid(noisy, surface, len(predictions)), predictions, strict=True):
        prediction = prediction[..., : image.shape[-2], : image.shape[-1]]
        filtered = apply_kernels(image, prediction[:, :KERNEL_TAPS], valid)
        output = filtered if alpha is None else combine_levels(filtered, output, alpha, valid, pool)
        alpha = torch.sigmoid(prediction[:, -1:].to(image.dtype))
    assert alpha is not None
    past = apply_kernels(warped, prediction[:, KERNEL_TAPS : 2 * KERNEL_TAPS], surface)
    return torch.lerp(past, output, alpha), alpha


@dataclass(frozen=True)
class NTDState(State):
    """The demodulated output to reproject and the running scales; the rest is for debugging and the loss."""

    irradiance: Tensor  # (B, 3, H, W)
    scale: RunningScale
    warped: Tensor  # (B, 3, H, W), irradiance
    alpha: Tensor  # (B, 1, H, W)
    motion: Tensor
    dual_motion: Tensor | None
    surface: Tensor | None  # see Frame.surface

    def pictures(self) -> dict[str, Tensor]:
        shown = {"alpha_t": self.alpha, "warped previous": self.warped}
        if self.dual_motion is not None:
            shown["disocclusion mask"] = disoccluded(self.motion, self.dual_motion).float()
        return shown


def warp_output(state: NTDState, motion: Tensor) -> tuple[Tensor, Tensor]:
    """The previous output where this frame's pixels were, and where that is valid; background is not gathered."""
    if state.surface is None:
        return warp(state.irradiance, motion)
    past, inside = warp(torch.cat([state.irradiance, state.surface], dim=1), motion)
    share = past[:, 3:]
    return past[:, :3] / share.clamp(min=MIN_SURFACE_SHARE), inside & (share > MIN_SURFACE_SHARE)


class NTD(Denoiser):
    """Predicts kernels for this frame's noise at three resolutions and for the previous output, reprojected.

    Where the motion vector leaves the image or leads to background, this frame's noise replaces the previous output, as
    in the first frame (§5). Like the paper, it validates no surfaces: the network decides. It denoises indirect light
    unless it is created for "total".
    """

    made_from = "paper"
    # the motion channel by which the previous output is reprojected
    vectors: ClassVar[Literal["motion", "dual_motion"]] = "dual_motion"
    # Traditional vectors are needed for the disocclusion mask of the loss.
    reads: tuple[str, ...] = ("indirect", "albedo", "normal", "depth", "motion", "dual_motion")
    pool: Pool = staticmethod(maximum_pool)  # D of Eq. 4
    signal: Signal = "indirect"
    refuses = NO_FLOAT16
    is_network = True
    dispensable: ClassVar = {"albedo": nn.Identity(), "normal": nn.Identity()}
    inputs = NTD_INPUTS
    first_layer = "network.encode.0.0"

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        if self.signal == "total":
            self.reads = ("direct", "emission", *type(self).reads)
        self.network = KernelNet().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def compress(self, irradiance: Tensor, scale: RunningScale, frame: Frame) -> Tensor:
        """Irradiance (B, 3, H, W) into a bounded range: sign(x) log(1 + abs(x)), x = gain · exposure · irradiance."""
        x = irradiance * (scale.exposure() * frame.gain)
        return torch.log1p(x.abs()).copysign(x)

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, NTDState]:
        """Irradiance (B, 3, H, W) of Eq. 4, which may be below 0, and the next state, in which it is clamped."""
        before = matching_state(state, NTDState, frame)
        noisy = frame.irradiance(self.signal).clamp(min=0)
        scale = running_scale(noisy * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        warped = noisy
        if before:
            previous, valid = warp_output(before, frame.channel(self.vectors))
            warped = torch.where(valid, previous, noisy)
        parts = {
            "noisy": self.compress(noisy, scale, frame),
            "warped": self.compress(warped, scale, frame),
            "albedo": frame.albedo,
            "normal": frame.normal,
            "depth": scale.normalised_depth(frame.depth),
        }
        x = torch.cat([parts[name] for name in self.inputs], dim=1)
        x = x.to(self.precision, memory_format=torch.channels_last)
        predictions = self.network(pad_to_multiple(x, 2 ** (len(WIDTHS) - 1)))
        surface = frame.surface
        irradiance, alpha = reconstruct_image(noisy, warped, predictions, surface, self.pool)
        if surface is not None:
            irradiance = irradiance * surface
        dual = frame.dual_motion if self.vectors == "dual_motion" else None
        kept = irradiance.clamp(min=0)
        return irradiance, NTDState(frame.moment, kept, scale, warped, alpha, frame.motion, dual, surface)

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        _, after = self.predict(frame, state)
        return frame.remodulate(after.irradiance, self.signal), after


class NTDTraditional(NTD):
    """The paper's ablation A (§6.3): reprojection by traditional motion vectors."""

    vectors = "motion"
    reads = ("indirect", "albedo", "normal", "depth", "motion")


class NTDMean(NTD):
    """NTD with averages, as in Eq. 7 of WSKP (Fan et al. 2021), in place of the maxima of Eq. 4, which darken; ours."""

    made_from = "paper, changed"
    pool = staticmethod(halve)
