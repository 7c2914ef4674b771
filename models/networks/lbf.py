"""LBF: learning-based filtering (Kalantari et al. 2015), with its cross-bilateral filter.

The filter has parameters of its own at every pixel:

    output(p) = sum_q w(p, q) image(q) / sum_q w(p, q)
    w(p, q) = exp(-s_0 |p - q|² - d(p, q) / 2 β² - sum_k s_k |f_k(p) - f_k(q)|²)

with the sharpnesses s of pixel p, features f_k and, as colours are noisy, their distance in units of the noise,
d(p, q) = sum (image(p) - image(q))² / (var(p) + var(q)), summed over colours.

A small network maps statistics of the features around a pixel, the secondary features, to the sharpnesses there; it is
trained through the filter. Remaining spikes are removed (§4.3). The paper's full
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
- Before training it is a filter with the same sharpness everywhere, FIRST_WIDTHS.
- Background is in no window and in no statistic.
"""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models import compiled
from models.compiled import cross_bilateral as kernels
from models.compiled.cross_bilateral import COLOUR_SHARPNESS, FEATURE_GROUPS, FILTER_RADIUS, MAX_EXPONENT
from models.denoiser import State
from models.filters.baselines import Accumulated, AccumulatedState
from models.filters.neighbours import mesh_means, mesh_variance, taps_3x3
from models.history.geometry import positions_around_eye, ray_axes
from models.history.running_scale import RunningScale
from models.networks.pixel_kernels import window_taps
from models.networks.wskp import FilteredState, KernelPredictor
from models.operators import MAX_LUMINANCE, MIN_DIVISOR, pad_to_multiple

BLOCK = 7  # px: what statistics are taken of
SMALL_BLOCK = 3
GAUSSIAN_MEDIAN = 0.6745  # of the absolute value of normal noise of deviation 1
SPREAD = 0.01  # the network cannot distinguish spreads far below this
KINDS = 7  # of statistics, one for each group
SECONDARY = KINDS * len(FEATURE_GROUPS) + 1
HIDDEN_UNITS = 10
MAX_POSITION = 1e3  # running median depths
MIN_FEATURE_VARIANCE = 1e-4  # δ: for features without noise
# Before training, weights are e^-0.5 at this distance: in pixels, then in each of FEATURE_GROUPS. Visibility, which its
# variance divides, hardly counts.
FIRST_WIDTHS = (4.0, 0.1, 0.2, 0.2, 0.2, 0.2)
SPIKE = 2.0  # standard deviations
SIDE = 2 * FILTER_RADIUS + 1


# The statistics below are taken of features (B, sum(FEATURE_GROUPS), H, W), channel by channel, and averaged over those
# of a group. `surface` (B, 1, H, W) is 1 for pixels that count: background and what is outside the image is in none.


def box_sum(image: Tensor, side: int) -> Tensor:
    """Sums of (B, C, H, W) over blocks of side x side pixels around each."""
    return F.avg_pool2d(image, side, stride=1, padding=side // 2, divisor_override=1)


def block_statistics(features: Tensor, surface: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation over blocks of 7 x 7 pixels."""
    exact = features.double()  # squares too: the rounding of a square in float32 would look like a spread of 2e-4 of it
    counted = torch.cat([exact, exact.square(), torch.ones_like(surface)], dim=1) * surface
    count = features.shape[1]
    total, square, pixels = box_sum(counted, BLOCK).split([count, count, 1], dim=1)
    mean = total / pixels.clamp(min=1)
    variance = (square - mean * total).clamp(min=0) / (pixels - 1).clamp(min=1)
    return mean.to(features), variance.sqrt().to(features)


def mean_deviation(features: Tensor, surface: Tensor) -> Tensor:
    """Mean absolute difference of the pixels in blocks of 3 x 3 from the blocks' means."""
    pixels = box_sum(surface, SMALL_BLOCK).clamp(min=1)
    mean = box_sum(features * surface, SMALL_BLOCK) / pixels
    total = torch.zeros_like(features)
    for _, here, there in window_taps(SMALL_BLOCK, *surface.shape[-2:]):
        total[here] += (features[there] - mean[here]).abs() * surface[there]
    return total / pixels


def gradients(features: Tensor, surface: Tensor) -> Tensor:
    """How much features change from pixel to pixel, by Sobel; what does not count takes the value of the pixel."""
    across = torch.zeros_like(features)
    down = torch.zeros_like(features)
    for index, here, there in window_taps(3, *surface.shape[-2:]):
        dy, dx = (offset - 1 for offset in divmod(index, 3))
        step = (features[there] - features[here]) * surface[there] / 8
        across[here] += dx * (2 - abs(dy)) * step
        down[here] += dy * (2 - abs(dx)) * step
    return torch.hypot(across, down)


def noise(features: Tensor, surface: Tensor) -> Tensor:
    """The standard deviation of noise, by the median absolute deviation (MAD) of Haar wavelets' details.

    The details of 2 x 2 pixels, diagonal to diagonal, around which the median is taken over 4 x 4 of them; of the
    results, the largest of 3 x 3 pixels. Details that are not all of surfaces count as 0.
    """
    height, width = surface.shape[-2:]
    values, shown = (pad_to_multiple(x, 2).unflatten(3, (-1, 2)).unflatten(2, (-1, 2)) for x in (features, surface))
    signs = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).to(features)[:, None]
    details = ((signs * values).sum(dim=(3, 5)) / 2).abs() * shown.amin(dim=(3, 5))
    blocks = F.pad(details, (2, 1, 2, 1), mode="replicate").unfold(2, 4, 1).unfold(3, 4, 1).flatten(4)
    medians = [channel.sort(dim=-1).values[..., 7:9].mean(dim=-1) for channel in blocks.unbind(dim=1)]
    median = torch.stack(medians, dim=1)
    pixels = F.interpolate(median / GAUSSIAN_MEDIAN, scale_factor=2.0)[..., :height, :width]
    return F.max_pool2d(pixels, 3, stride=1, padding=1)


def group_means(features: Tensor) -> Tensor:
    """Means over the channels of each group, (B, groups, H, W)."""
    return torch.cat([group.mean(dim=1, keepdim=True) for group in features.split(FEATURE_GROUPS, dim=1)], dim=1)


def secondary_features(features: Tensor, variance: Tensor, surface: Tensor, samples: Tensor) -> Tensor:
    """The network's input, (B, SECONDARY, H, W).

    Of each group: noise, mean deviation, gradient, deviation of the pixel and of the block around, values of the pixel,
    their mean over the block; last, 1 / `samples`, which are (B, 1, 1, 1). `variance` (B, groups, H, W) is that of the
    noise in features. Values go in as they are, spreads x as ln(1 + x / SPREAD).
    """
    mean, deviation = block_statistics(features, surface)
    spreads = [group_means(kind(features, surface)) for kind in (noise, mean_deviation, gradients)]
    spreads += [variance.sqrt(), group_means(deviation)]
    means = [group_means(features), group_means(mean), (1 / samples).expand_as(surface)]
    return torch.cat([*(torch.log1p(spread / SPREAD) for spread in spreads), *means], dim=1)


class Pixels(NamedTuple):
    """What is filtered, and what pixels are compared by; all float32 and (B, ·, H, W)."""

    image: Tensor  # 3 channels
    variance: Tensor  # of the noise in each of these
    features: Tensor  # sum(FEATURE_GROUPS) channels
    surface: Tensor  # 1 for pixels that count, 0 for those that are left out like what is outside the image


def tap_weights(pixels: Pixels, sharpness: Tensor) -> Iterator[tuple[Any, Any, Tensor, Tensor]]:
    """Of each tap: the pixels that have it and those it is, as indices; w (B, 1, h, w); the distances that s scales.

    The distances (B, 1 + groups, h, w) are 0 where so little weight is left that it does not change with them.
    """
    image, variance, features, surface = pixels
    for index, here, there in window_taps(SIDE, *image.shape[-2:]):
        dy, dx = (offset - FILTER_RADIUS for offset in divmod(index, SIDE))
        noise = MIN_DIVISOR + variance[here] + variance[there]
        apart = ((image[there] - image[here]).square() / noise).sum(dim=1, keepdim=True)
        squares = (features[there] - features[here]).square().split(FEATURE_GROUPS, dim=1)
        in_image = torch.full_like(apart, dy * dy + dx * dx)
        distances = torch.cat([in_image, *(square.sum(dim=1, keepdim=True) for square in squares)], dim=1)
        exponent = COLOUR_SHARPNESS * apart + (sharpness[here] * distances).sum(dim=1, keepdim=True)
        weight = torch.exp(-exponent.clamp(max=MAX_EXPONENT)) * surface[there]
        yield here, there, weight, distances * (exponent < MAX_EXPONENT)


@compiled.by(kernels.weighted_mean)
def weighted_mean(pixels: Pixels, sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """The filtered image, and the sums of weights (B, 1, H, W); both 0 off surfaces."""
    out = torch.zeros_like(pixels.image)
    total = torch.zeros_like(pixels.surface)
    for here, there, weight, _ in tap_weights(pixels, sharpness):
        out[here].addcmul_(weight, pixels.image[there])
        total[here] += weight
    return out * pixels.surface / total.clamp(min=MIN_DIVISOR), total * pixels.surface


@compiled.by(kernels.pull_sharpness)
def pull_sharpness(gradient: Tensor, pixels: Pixels, sharpness: Tensor, out: Tensor, total: Tensor) -> Tensor:
    """The gradient of the sharpness (B, 1 + groups, H, W), from that of what weighted_mean returned."""
    pulled = torch.zeros_like(sharpness)
    scaled = gradient * pixels.surface / total.clamp(min=MIN_DIVISOR)
    dot = (scaled * out).sum(dim=1, keepdim=True)
    for here, there, weight, distances in tap_weights(pixels, sharpness):
        pull = weight * ((scaled[here] * pixels.image[there]).sum(dim=1, keepdim=True) - dot[here])
        pulled[here].addcmul_(pull, distances, value=-1)
    return pulled


class CrossBilateral(torch.autograd.Function):
    """Computes all weights once more on the way back, rather than keep thousands of images."""

    @staticmethod
    def forward(ctx: Any, sharpness: Tensor, *pixels: Tensor) -> Tensor:
        out, total = weighted_mean(Pixels(*pixels), sharpness)
        ctx.save_for_backward(*pixels, sharpness, out, total)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *pixels, sharpness, out, total = ctx.saved_tensors
        return pull_sharpness(gradients[0], Pixels(*pixels), sharpness, out, total), *[None] * len(pixels)


def cross_bilateral(pixels: Pixels, sharpness: Tensor) -> Tensor:
    """The filtered image (B, 3, H, W), a convex mean of surfaces around each pixel, 0 off them.

    Differentiable in the sharpness (B, 1 + groups, H, W) >= 0: that of the distance in the image, then of each group
    of features. Colours lie within ±MAX_LUMINANCE.
    """
    return cast(Tensor, CrossBilateral.apply(sharpness, *pixels))


def features_of(frame: Frame, scale: RunningScale) -> tuple[Tensor, Tensor]:
    """The features (B, sum(FEATURE_GROUPS), H, W) and the variance of their noise, (B, groups, H, W)."""
    unit = torch.exp(scale.log_depth.value)[:, None, None, None]
    position = (positions_around_eye(frame.depth, ray_axes(frame.now)) / unit).clamp(-MAX_POSITION, MAX_POSITION)
    lit = (frame.direct.amax(dim=1, keepdim=True) > 0).to(frame.direct)
    mean_3x3, mean_9x9, _ = mesh_means(lit.expand(-1, 3, -1, -1), frame.mesh_id)
    visible, share = mean_3x3[:, :1], mean_9x9[:, :1]  # of samples that direct light reaches
    variance = share * (1 - share).clamp(min=0) / 9
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


class LBFState(FilteredState):
    """With the sharpness (B, 1 + groups, H, W) as the filter's parameters."""

    def pictures(self) -> dict[str, Tensor]:
        assert self.parameters is not None
        width = (2 * self.parameters[:, :1]) ** -0.5
        return AccumulatedState.pictures(self) | {"width of the filter (px)": width}


def first_bias() -> Tensor:
    """What the softplus of the last layer maps to the sharpness of FIRST_WIDTHS."""
    sharpness = 0.5 * torch.tensor(FIRST_WIDTHS, dtype=torch.float64) ** -2
    sharpness[1:] *= MIN_FEATURE_VARIANCE  # by which the sharpness of features is divided
    return torch.log(torch.expm1(sharpness))


class LBF(KernelPredictor):
    """Filters accumulated irradiance within its range since the last reset; takes seconds a frame."""

    made_from = "code"
    reads = (*Accumulated.reads, "roughness")
    filter_reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id")
    refuses = dict.fromkeys(
        (torch.bfloat16, torch.float16), "the sums of its filter need float32, and its network is too small to gain"
    )
    offline = True
    convex = True
    dispensable: ClassVar = {}

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        last = nn.Linear(HIDDEN_UNITS, 1 + len(FEATURE_GROUPS))
        nn.init.zeros_(last.weight)
        last.bias.data = first_bias().to(last.bias)
        self.network = nn.Sequential(nn.Linear(SECONDARY, HIDDEN_UNITS), nn.Sigmoid(), last, nn.Softplus())

    def sharpness(self, features: Tensor, variance: Tensor, surface: Tensor, samples: Tensor) -> Tensor:
        """The factors of squared distances, (B, 1 + groups, H, W); see features_of (Eq. 12)."""
        statistics = secondary_features(features, variance, surface, samples).movedim(1, -1)
        factors = self.network(statistics).movedim(-1, 1).to(features)
        return factors / torch.cat([torch.ones_like(surface), variance.clamp(min=MIN_FEATURE_VARIANCE)], dim=1)

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
        return frame.remodulate(irradiance, self.signal), LBFState(frame.moment, after.history, after.scale, sharpness)
