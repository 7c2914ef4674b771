"""LBF: learning-based filtering (Kalantari et al. 2015), with its cross-bilateral filter.

A small network sees statistics of the features around a pixel, the secondary features, and sets the parameters of a
cross-bilateral filter there; it is trained through the filter. Then spikes that are left are removed (§4.3). We do not
have the whole of the paper's text: numbers are those of the code that its authors published, the shape of the network
(36, 10 and 6; sigmoid, then ln(1 + e^x)), the kinds and blocks of secondary features, the filter's window of 55 x 55,
its terms (Eq. 11, 12), the fixed β = 7 of colours, and the factor of spikes.

What is ours, as frames have one sample a pixel and features free of noise:

- Of the paper's features, what the second hit of a path sees of textures is not among our channels; roughness, which
  tells where things are reflected, has its place. Visibility is whether direct light arrives: the mean over 3 x 3
  pixels of the own mesh, whose variance p (1 - p) / 9 has its p from 9 x 9.
- The paper takes the variances of all else from the samples of a pixel, and filters features by them before it begins.
  Here the variance of colours is how far they spread over 9 x 9 pixels of the own mesh, however many samples a pixel
  is the mean of; that of other features is 0, so that there is nothing to filter.
- It filters irradiance: among other pixels, texture would count as noise. Spikes are looked for there, too.
- Positions are relative to the camera, in units of the running median depth.
- The authors divide secondary features by their deviations over the training set; ours have about one scale.
- Gradients are magnitudes, by Sobel; MADs are computed once for 2 x 2 pixels.
- Weights begin so that the filter is neither a pixel nor the whole window wide: s = ln(1 + e^-4).
- Background is in no window and in no statistic.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from datasets.frame import Frame, Signal
from models.compiled.cross_bilateral import FEATURE_GROUPS
from models.denoiser import Denoiser, State, matching_state
from models.filters.neighbours import mesh_means, mesh_variance, shifted
from models.history.running_scale import RunningScale, running_scale
from models.history.surfaces import positions_around_eye, ray_axes
from models.networks.cross_bilateral import Pixels, cross_bilateral
from models.networks.secondary_features import SECONDARY, secondary_features
from models.operators import MAX_LUMINANCE

HIDDEN = 10
FARTHEST = 1e3  # running median depths; positions further off look alike
LEAST_FEATURE_VARIANCE = 1e-4  # δ: what features are compared by where they have no noise
FIRST_BIAS = -4.0
SPIKE = 2.0  # standard deviations


def visibility(frame: Frame) -> tuple[Tensor, Tensor]:
    """Which share of a surface's samples direct light reaches, and the variance of that: both (B, 1, H, W)."""
    lit = (frame.direct.amax(dim=1, keepdim=True) > 0).to(frame.direct)
    near, around, _ = mesh_means(lit.expand(-1, 3, -1, -1), frame.mesh_id)
    share = around[:, :1]
    return near[:, :1], share * (1 - share).clamp(min=0) / 9


def features_of(frame: Frame, scale: RunningScale) -> tuple[Tensor, Tensor]:
    """The features (B, sum(FEATURE_GROUPS), H, W) and the variance of their noise, (B, groups, H, W)."""
    unit = torch.exp(scale.log_depth.value)[:, None, None, None]
    position = (positions_around_eye(frame.depth, ray_axes(frame.now)) / unit).clamp(-FARTHEST, FARTHEST)
    visible, variance = visibility(frame)
    features = torch.cat([position.to(frame.depth), frame.normal, frame.albedo, frame.roughness, visible], dim=1)
    return features, torch.cat([torch.zeros_like(variance)] * (len(FEATURE_GROUPS) - 1) + [variance], dim=1)


def remove_spikes(image: Tensor, surface: Tensor) -> Tensor:
    """The image (B, 3, H, W) with medians in place of what stands out from the 3 x 3 pixels around (§4.3).

    A pixel is a spike if one of its colours is more than SPIKE standard deviations from the mean of its neighbours'.
    Only pixels with a `surface` (B, 1, H, W) count; of two in the middle, the median is the larger.
    """
    taps = shifted(image, 1)
    shown = shifted(surface, 1)
    beside = shown.clone()
    beside[:, :, 4] = 0
    count = beside.sum(dim=2)
    mean = (taps * beside).sum(dim=2) / count.clamp(min=1)
    variance = ((taps - mean[:, :, None]).square() * beside).sum(dim=2) / (count - 1).clamp(min=1)
    stands_out = ((image - mean).square() > SPIKE**2 * variance).any(dim=1, keepdim=True)
    ordered = torch.where(shown > 0, taps, torch.inf).sort(dim=2).values
    middle = ((count + 1) / 2).long()[:, :, None].expand(-1, 3, -1, -1, -1)
    median = ordered.gather(2, middle)[:, :, 0]
    return torch.where(stands_out & (count > 1) & (surface > 0), median, image)


@dataclass(frozen=True)
class LBFState(State):
    """Running exposure and depth scale, and the widths of the filter, to look at."""

    scale: RunningScale
    sharpness: Tensor  # (B, 1 + groups, H, W)

    def pictures(self) -> dict[str, Tensor]:
        return {"width of the filter (px)": (2 * self.sharpness[:, :1]) ** -0.5}


class LBF(Denoiser):
    """Filters each frame by itself, within the range of its irradiance, in seconds."""

    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id")
    refuses = dict.fromkeys(
        (torch.bfloat16, torch.float16), "the sums of its filter need float32, and its network is too small to gain"
    )
    is_network = True
    offline = True
    convex = True

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.inputs = {"secondary features": SECONDARY}
        last = nn.Linear(HIDDEN, 1 + len(FEATURE_GROUPS))
        nn.init.constant_(last.bias, FIRST_BIAS)
        self.network = nn.Sequential(nn.Linear(SECONDARY, HIDDEN), nn.Sigmoid(), last, nn.Softplus())

    def sharpness(self, features: Tensor, variance: Tensor, surface: Tensor, samples: Tensor) -> Tensor:
        """What the filter multiplies squared distances by, (B, 1 + groups, H, W); see features_of (Eq. 12)."""
        seen = secondary_features(features, variance, surface, samples)
        said = self.network(seen.movedim(1, -1)).movedim(-1, 1).to(features)
        return said / torch.cat([torch.ones_like(surface), variance.clamp(min=LEAST_FEATURE_VARIANCE)], dim=1)

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, LBFState]:
        """Filtered irradiance (B, 3, H, W), before spikes are removed, and the state for the next frame."""
        before = matching_state(state, LBFState, frame)
        surface = (frame.depth > 0).to(frame.depth)
        colour = frame.irradiance(self.signal).clamp(-MAX_LUMINANCE, MAX_LUMINANCE) * surface
        scale = running_scale(colour * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        features, variance = features_of(frame, scale)
        sharpness = self.sharpness(features, variance, surface, frame.samples)
        pixels = Pixels(colour, mesh_variance(colour, frame.mesh_id), features, surface)
        return cross_bilateral(pixels, sharpness), LBFState(frame.moment, scale, sharpness.detach())

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        filtered, after = self.predict(frame, state)
        surface = (frame.depth > 0).to(frame.depth)
        return frame.remodulate(remove_spikes(filtered, surface), self.signal), after
