"""LBF: learning-based filtering (Kalantari et al. 2015), with its cross-bilateral filter.

A small network maps statistics of the features around a pixel, the secondary features, to the parameters of a
cross-bilateral filter there; it is trained through the filter. Remaining spikes are removed (§4.3). The paper's full
text was not available: constants follow the authors' code, such as the network (36, 10, 6; sigmoid, then softplus),
kinds and blocks of secondary features, the window of 55 x 55, its terms (Eq. 11, 12), β = 7, the spike threshold.

What differs, since frames have 1 spp and noise-free features:

- As in SVGF's evaluation (Schied et al. 2017, §5.1), the light that it filters has been accumulated over frames.
- Roughness replaces the textures of the second hit. Visibility is whether direct light arrives: the mean over 3 x 3
  pixels of the same mesh, with variance p (1 - p) / 9 and p from 9 x 9.
- The variance of colours is their spread over 9 x 9 pixels of the same mesh; other features have variance 0 and are not
  prefiltered.
- It filters irradiance, and removes spikes there: textures would count as noise.
- Positions are relative to the camera, in units of the running median depth.
- Secondary features have about one scale, where the authors normalise by the training set.
- Gradients are Sobel magnitudes; MADs are computed once per 2 x 2 pixels.
- The filter's initial sharpness is s = ln(1 + e^-4): neither one pixel nor the whole window.
- Background is in no window and in no statistic.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from datasets.frame import Frame, Signal
from models.compiled.cross_bilateral import FEATURE_GROUPS
from models.denoiser import State, matching_state
from models.filters.baselines import Accumulated, AccumulatedState, Accumulating
from models.filters.neighbours import mesh_means, mesh_variance, taps_3x3
from models.history.geometry import positions_around_eye, ray_axes
from models.history.running_scale import RunningScale, running_scale
from models.networks.cross_bilateral import Pixels, cross_bilateral
from models.networks.secondary_features import SECONDARY, secondary_features
from models.operators import MAX_LUMINANCE

HIDDEN_UNITS = 10
MAX_POSITION = 1e3  # running median depths
MIN_FEATURE_VARIANCE = 1e-4  # δ: for features without noise
FIRST_BIAS = -4.0
SPIKE = 2.0  # standard deviations


def visibility(frame: Frame) -> tuple[Tensor, Tensor]:
    """The share of samples that direct light reaches, and its variance: both (B, 1, H, W)."""
    lit = (frame.direct.amax(dim=1, keepdim=True) > 0).to(frame.direct)
    mean_3x3, mean_9x9, _ = mesh_means(lit.expand(-1, 3, -1, -1), frame.mesh_id)
    share = mean_9x9[:, :1]
    return mean_3x3[:, :1], share * (1 - share).clamp(min=0) / 9


def features_of(frame: Frame, scale: RunningScale) -> tuple[Tensor, Tensor]:
    """The features (B, sum(FEATURE_GROUPS), H, W) and the variance of their noise, (B, groups, H, W)."""
    unit = torch.exp(scale.log_depth.value)[:, None, None, None]
    position = (positions_around_eye(frame.depth, ray_axes(frame.now)) / unit).clamp(-MAX_POSITION, MAX_POSITION)
    visible, variance = visibility(frame)
    features = torch.cat([position.to(frame.depth), frame.normal, frame.albedo, frame.roughness, visible], dim=1)
    return features, torch.cat([torch.zeros_like(variance)] * (len(FEATURE_GROUPS) - 1) + [variance], dim=1)


def remove_spikes(image: Tensor, surface: Tensor) -> Tensor:
    """The image (B, 3, H, W) with outliers of 3 x 3 pixels replaced by medians (§4.3).

    A pixel is a spike if one of its colours is more than SPIKE standard deviations from the mean of its neighbours'.
    Only pixels with a `surface` (B, 1, H, W) count; of two in the middle, the median is the larger.
    """
    taps = taps_3x3(image, 1)
    shown = taps_3x3(surface, 1)
    beside = shown.clone()
    beside[:, :, 4] = 0
    count = beside.sum(dim=2)
    mean = (taps * beside).sum(dim=2) / count.clamp(min=1)
    variance = ((taps - mean[:, :, None]).square() * beside).sum(dim=2) / (count - 1).clamp(min=1)
    is_spike = ((image - mean).square() > SPIKE**2 * variance).any(dim=1, keepdim=True)
    middle = ((count + 1) / 2).long()[:, :, None].expand(-1, 3, -1, -1, -1)
    median = torch.where(shown > 0, taps, torch.inf).sort(dim=2).values.gather(2, middle)[:, :, 0]
    return torch.where(is_spike & (count > 1) & (surface > 0), median, image)


@dataclass(frozen=True)
class LBFState(AccumulatedState):
    """Accumulated irradiance, running exposure and depth scale; for debugging, the filter's sharpness."""

    scale: RunningScale
    sharpness: Tensor | None = None  # (B, 1 + groups, H, W)

    def pictures(self) -> dict[str, Tensor]:
        if self.sharpness is None:
            return super().pictures()
        return super().pictures() | {"width of the filter (px)": (2 * self.sharpness[:, :1]) ** -0.5}


class LBF(Accumulating):
    """Filters accumulated irradiance within its range since the last reset; takes seconds a frame."""

    made_from = "code"
    reads = (*Accumulated.reads, "roughness")
    filter_reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id")
    refuses = dict.fromkeys(
        (torch.bfloat16, torch.float16), "the sums of its filter need float32, and its network is too small to gain"
    )
    is_network = True
    offline = True
    convex = True

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.inputs = {"secondary features": SECONDARY}
        last = nn.Linear(HIDDEN_UNITS, 1 + len(FEATURE_GROUPS))
        nn.init.constant_(last.bias, FIRST_BIAS)
        self.network = nn.Sequential(nn.Linear(SECONDARY, HIDDEN_UNITS), nn.Sigmoid(), last, nn.Softplus())

    def sharpness(self, features: Tensor, variance: Tensor, surface: Tensor, samples: Tensor) -> Tensor:
        """The factors of squared distances, (B, 1 + groups, H, W); see features_of (Eq. 12)."""
        statistics = secondary_features(features, variance, surface, samples).movedim(1, -1)
        factors = self.network(statistics).movedim(-1, 1).to(features)
        return factors / torch.cat([torch.ones_like(surface), variance.clamp(min=MIN_FEATURE_VARIANCE)], dim=1)

    def accumulate(self, frame: Frame, state: State | None) -> LBFState:
        """The state before filtering: accumulated irradiance and running scales."""
        before = matching_state(state, LBFState, frame)
        history = self.accumulated(frame, before)
        scale = running_scale(history.irradiance * frame.divisor, frame.depth, before.scale if before else None)
        return LBFState(frame.moment, history, scale)

    def filter(self, frame: Frame, irradiance: Tensor, scale: RunningScale) -> tuple[Tensor, Tensor]:
        """Filtered irradiance (B, 3, H, W), before spikes are removed, and the filter's sharpness."""
        surface = (frame.depth > 0).to(frame.depth)
        colour = irradiance.clamp(-MAX_LUMINANCE, MAX_LUMINANCE) * surface
        features, variance = features_of(frame, scale)
        sharpness = self.sharpness(features, variance, surface, frame.samples)
        pixels = Pixels(colour, mesh_variance(colour, frame.mesh_id), features, surface)
        return cross_bilateral(pixels, sharpness), sharpness.detach()

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        after = self.accumulate(frame, state)
        filtered, sharpness = self.filter(frame, after.history.irradiance, after.scale)
        surface = (frame.depth > 0).to(frame.depth)
        irradiance = remove_spikes(filtered, surface)
        return frame.remodulate(irradiance, self.signal), replace(after, sharpness=sharpness)
