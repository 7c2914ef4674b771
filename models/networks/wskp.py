"""WSKP: weight-sharing kernel prediction (Fan et al. 2021), its multi-resolution variant and its baselines KP."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models import compiled
from models.compiled import features as kernels
from models.compiled.features import FEATURE_CHANNELS, GAMMA
from models.compiled.fusion import THREAD_ROWS, WINDOWS
from models.denoiser import State, matching_state
from models.filters.baselines import AccumulatedState, Accumulating
from models.history.running_scale import RunningScale, running_scale
from models.networks.convolution import encoded
from models.networks.fusion import fuse
from models.networks.pixel_kernels import apply_kernels
from models.networks.repvgg import BRANCH_SIZES, merge, repvgg
from models.operators import STRIP_PIXELS, halve, pad_to_multiple, pyramid

WSKP_WIDTH = 24  # ours: the paper does not print its widths
MAX_WHOLE_PIXELS = 1920 * 1080  # larger frames would take gigabytes and are filtered in strips, with the same result


def scaled_normal(normal: Tensor) -> Tensor:
    """A normal's components, from [-1, 1] to [0, 1]."""
    return normal / 2 + 0.5


def feature_images(radiance: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor, names: Sequence[str]) -> Tensor:
    """See network_features: of exposed radiance and normalised depth."""
    parts = {
        "colour": radiance.clamp(0, 1) ** (1 / GAMMA),
        "albedo": albedo,
        "normal": scaled_normal(normal),
        "depth": depth,
    }
    return torch.cat([parts[name] for name in names], dim=1)


@compiled.by(kernels.network_features)
def network_features(
    frame: Frame, irradiance: Tensor, scale: RunningScale, names: Sequence[str] = tuple(FEATURE_CHANNELS)
) -> Tensor:
    """The network's input (B, 10, H, W) in [0, 1] (§5.1), or fewer channels for some `names` of FEATURE_CHANNELS only.

    Accumulated `irradiance` (B, 3, H, W), modulated and displayed (causal exposure, clipped, gamma 2.2); albedo; the
    world-space normal scaled to [0, 1]; the depth d / (d + s) with s its running `scale`, where the paper scales
    it linearly.
    """
    exposed = irradiance * frame.divisor * (scale.exposure() * frame.gain)
    return feature_images(exposed, frame.albedo, frame.normal, scale.normalised_depth(frame.depth), names)


Filtered = tuple[Tensor, Tensor | None]  # irradiance (B, 3, H, W), and parameters of the filter to display, if any


def free_kernels(image: Tensor, predicted: Tensor, surface: Tensor | None) -> Filtered:
    """By one free kernel per pixel, whose logits are `predicted` (B, k², H, W): the paper's baseline (§6.1)."""
    return apply_kernels(image, predicted, surface), None


@dataclass(frozen=True)
class FilteredState(AccumulatedState):
    """Accumulated frames, running exposure and depth scale; for debugging, the filter's parameters."""

    scale: RunningScale
    parameters: Tensor | None = None  # of windows, the logits of the mixture (B, M, H, W)

    def pictures(self) -> dict[str, Tensor]:
        if self.parameters is None:
            return super().pictures()
        windows = torch.tensor(WINDOWS[: self.parameters.shape[1]]).to(self.parameters)
        mean = (torch.softmax(self.parameters, dim=1) * windows[:, None, None]).sum(dim=1, keepdim=True)
        return super().pictures() | {"mean window (px)": mean}


class KernelPredictor(Accumulating):
    """Temporal accumulation, a network that predicts filter parameters, the filter on irradiance, remodulation (§4)."""

    made_from = "paper"
    is_network = True
    inputs: Mapping[str, int] = FEATURE_CHANNELS
    dispensable: ClassVar = {"albedo": nn.Identity(), "normal": scaled_normal}
    filter_reads: tuple[str, ...] = ("emission", "albedo", "normal", "depth")  # channels that `filter` reads
    network: nn.Module
    side_multiple = 1  # of the network's images; they are padded
    reach: int | None = None  # rows above and below that a pixel depends on; None for all

    @staticmethod
    def filter_image(image: Tensor, predicted: Tensor, surface: Tensor | None) -> Filtered:
        """By the first M of WINDOWS, whose importance maps and mixture are `predicted` (B, 2 M, H, W) (§4.1)."""
        importance, mixture = predicted.to(image.dtype).chunk(2, dim=1)
        return fuse(image, importance, mixture, WINDOWS[: mixture.shape[1]], surface), mixture

    def reconstruct(self, irradiance: Tensor, predicted: Tensor, surface: Tensor | None = None) -> Filtered:
        """Irradiance (B, 3, H, W) of surfaces, filtered with the network's output."""
        return self.filter_image(irradiance, predicted, surface)

    def accumulate(self, frame: Frame, state: State | None) -> FilteredState:
        """The state before filtering: accumulated irradiance and running scales."""
        before = matching_state(state, FilteredState, frame)
        history = self.accumulated(frame, before)
        radiance = history.irradiance * frame.divisor
        scale = running_scale(radiance, frame.depth, before.scale if before else None)
        return FilteredState(frame.moment, history, scale)

    def filter(self, frame: Frame, irradiance: Tensor, scale: RunningScale) -> Filtered:
        """Accumulated `irradiance` (B, 3, H, W) filtered, of large images in strips of rows."""
        height, width = frame.size
        if self.reach is None or height * width <= MAX_WHOLE_PIXELS:
            return self.filter_whole(frame, irradiance, scale)
        rows = max(1, STRIP_PIXELS // width // THREAD_ROWS) * THREAD_ROWS
        strips = []
        mixtures = []
        for top in range(0, height, rows):
            first = max(0, top - self.reach) // THREAD_ROWS * THREAD_ROWS  # the kernel's strips decide rounding
            needed = slice(first, top + rows + self.reach)
            inner = slice(top - first, top + rows - first)
            part = replace(frame, channels={name: frame.channels[name][..., needed, :] for name in self.filter_reads})
            filtered, mixture = self.filter_whole(part, irradiance[..., needed, :], scale)
            strips.append(filtered[..., inner, :])
            if mixture is not None:
                mixtures.append(mixture[..., inner, :])
        return torch.cat(strips, dim=-2), torch.cat(mixtures, dim=-2) if mixtures else None

    def filter_whole(self, frame: Frame, irradiance: Tensor, scale: RunningScale) -> Filtered:
        """`filter`, in one piece."""
        x = pad_to_multiple(network_features(frame, irradiance, scale, tuple(self.inputs)), self.side_multiple)
        predicted = self.network(x.to(self.precision, memory_format=torch.channels_last))
        return self.reconstruct(irradiance, predicted, frame.surface)

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        after = self.accumulate(frame, state)
        irradiance, parameters = self.filter(frame, after.history.irradiance, after.scale)
        return frame.remodulate(irradiance, self.signal), replace(after, parameters=parameters)

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        merge(self.network)  # in the precision of training
        self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        super().prepare(precision)


class TrunkPredictor(KernelPredictor):
    """A trunk of RepVGG blocks that predicts windows or kernels of up to 13 x 13 pixels."""

    convex = True
    first_layer = "network.0.branches"
    layers: ClassVar[int] = 6
    outputs: ClassVar[int]

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.network = repvgg([sum(FEATURE_CHANNELS.values()), *[WSKP_WIDTH] * (self.layers - 1), self.outputs])
        self.reach = self.layers * (max(BRANCH_SIZES) // 2) + max(WINDOWS) // 2


class WSKP(TrunkPredictor):
    """ImportanceNet of 3 or 6 RepVGG blocks; importance maps and shares of windows 3, 5, ..., 13 (§4.1, §5.3)."""

    evaluated_with: tuple[str, ...] = ("adaptive",)
    outputs = 2 * len(WINDOWS)


class WSKP3(WSKP):
    """The smaller of the paper's two networks."""

    evaluated_with = ()
    layers = 3


class KP(TrunkPredictor):
    """The paper's baseline (§6.1): the trunk of wskp6, and one free 13 x 13 kernel per pixel."""

    outputs = max(WINDOWS) ** 2
    filter_image = staticmethod(free_kernels)


def convolutions(inputs: int, outputs: int) -> nn.Sequential:
    layers = [nn.Conv2d(inputs, outputs, 3, padding=1), nn.Conv2d(outputs, outputs, 3, padding=1)]
    return nn.Sequential(layers[0], nn.ReLU(inplace=True), layers[1], nn.ReLU(inplace=True))


class MultiResolutionNet(nn.Module):
    """A U-Net with an output at each of its three resolutions (§5.2). The widths are ours."""

    widths = (32, 48, 64)

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        fine, middle, coarse = self.widths
        self.down = nn.ModuleList(convolutions(a, b) for a, b in pairwise((inputs, fine, middle, coarse)))
        self.up = nn.ModuleList([convolutions(coarse + middle, middle), convolutions(middle + fine, fine)])
        self.heads = nn.ModuleList(nn.Conv2d(width, outputs, 1) for width in self.widths[::-1])

    def forward(self, x: Tensor) -> list[Tensor]:
        """Predictions (B, outputs, H / 2^k, W / 2^k) for k = 2, 1, 0. H and W are multiples of 4."""
        *skips, x = encoded(self.down, x)
        predictions = [self.heads[0](x)]
        for block, head, skip in zip(self.up, list(self.heads)[1:], skips[::-1], strict=True):
            x = block(torch.cat([F.interpolate(x, scale_factor=2.0), skip], dim=1))
            predictions.append(head(x))
        return predictions


def combine_resolutions(fine: Tensor, coarse: Tensor, alpha: Tensor, surface: Tensor | None = None) -> Tensor:
    """i_f - alpha [U D i_f] + alpha [U i_c] (Eq. 7): D is `halve`, U repeats pixels; alpha (B, 1, H, W)."""
    return fine + alpha * F.interpolate(coarse - halve(fine, surface), scale_factor=2.0)


class MultiResolution(KernelPredictor):
    """A filter at each of three resolutions, combined by Eq. 7 (§5.2): not convex, so it is clamped at 0."""

    maps: ClassVar[int]  # channels of filter parameters at each resolution
    side_multiple = 4
    first_layer = "network.down.0.0"

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.network = MultiResolutionNet(sum(FEATURE_CHANNELS.values()), self.maps + 1)

    def reconstruct(  # type: ignore[override]
        self, irradiance: Tensor, predicted: Sequence[Tensor], surface: Tensor | None = None
    ) -> Filtered:
        height, width = irradiance.shape[-2:]
        surface = None if surface is None else pad_to_multiple(surface, self.side_multiple)
        levels = pyramid(pad_to_multiple(irradiance, self.side_multiple), surface, len(predicted))
        output: Tensor | None = None
        for (image, valid), predictions in zip(levels, predicted, strict=True):
            maps, alpha = predictions.to(image.dtype).split([self.maps, 1], dim=1)
            fine, mixture = self.filter_image(image, maps, valid)
            output = fine if output is None else combine_resolutions(fine, output, torch.sigmoid(alpha), valid)
        assert output is not None
        if mixture is not None:
            mixture = mixture[..., :height, :width]
        return output[..., :height, :width].clamp(min=0), mixture


class WSKPMR(MultiResolution):
    """Windows 3 and 5 at three resolutions (§5.3)."""

    maps = 4


class MRKP(MultiResolution):
    """The network of wskp-mr with a 5 x 5 kernel per pixel at each resolution, as the paper describes it (§6.1).

    Ours, after the code of Meng et al. 2020; their published baseline has five levels of 48 channels, and filters four.
    """

    made_from = "ours, after code"
    maps = 25
    filter_image = staticmethod(free_kernels)
