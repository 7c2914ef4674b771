"""SVGF: spatiotemporal variance-guided filtering (Schied et al. 2017).

Where the paper is silent, we choose:

- While the history is short, samples are averaged evenly, α = max(0.2, 1 / n), and the spatial estimate of variance is
  multiplied by 4 / n, as in the authors' published code.
- The history length of a sample includes the sample; "< 4 frames" (§4.2) compares it, rounded, with 4.
- The temporal variance of single samples enters the first level unscaled, although integration has averaged it.
- Depths are along the viewing axis (clip-space depth is affine in them). ∇z is, along each axis, the smaller difference
  to the two neighbours of the same mesh, so that it never crosses a silhouette; 0 without any.
- ε of Eq. 3 is relative to the depth, so that the scene's scale cancels; ε of Eq. 5 is below any radiance's square.
- The spatial estimate (§4.2) averages the integrated moments over 7 × 7 pixels with the weights w_z · w_n.
- The 3 × 3 Gaussian is (1/4, 1/2, 1/4) along each axis, over pixels that show surfaces.
- Background has no normal: it has weight 0 for all other pixels, so it is neither filtered nor mixed with surfaces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models import compiled
from models.compiled import svgf as kernels
from models.compiled.accumulation import MIN_ALPHA
from models.compiled.svgf import EPSILON_L, EPSILON_Z, SIGMA_L, SIGMA_Z, SPATIAL_RADIUS, SQUARINGS
from models.denoiser import CLASSICAL, Denoiser, State, matching_state
from models.filters.atrous import ATROUS_STEPS, CENTRE, RADIUS, b3_spline, strip_taps
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from models.operators import MAX_LUMINANCE, MIN_DIVISOR, image_luminance

MIN_TEMPORAL_LENGTH = 4  # §4.2: frames of history from which on the temporal variance is used


class Integrated(NamedTuple):
    """Temporally integrated samples of S signals, the history of the next frame (§4.1, §4.2)."""

    colour: Tensor  # (B, S, 3, H, W), irradiance
    moments: Tensor  # (B, S, 2, H, W), raw moments of its luminance
    length: Tensor  # (B, 1, H, W), frames
    gbuffer: GBuffer


def luminance_moments(colour: Tensor) -> Tensor:
    """Raw moments (B, S, 2, H, W) of the luminance of single samples (B, S, 3, H, W)."""
    y = image_luminance(colour.flatten(0, 1)).clamp(-MAX_LUMINANCE, MAX_LUMINANCE)
    return torch.cat([y, y.square()], dim=1).unflatten(0, colour.shape[:2])


@compiled.by(kernels.integrate_samples)
def integrate_samples(
    frame: Frame, noisy: Tensor, previous: Integrated, change: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """`integrate` where there is a previous frame: colour, moments and length of Integrated."""
    past = [previous.colour.flatten(1, 2), previous.moments.flatten(1, 2), previous.length]
    history, has_history = reproject(frame, torch.cat(past, dim=1), previous.gbuffer)
    change = torch.zeros_like(previous.length) if change is None else change
    colour, moments, length = history.split([image.shape[1] for image in past], dim=1)
    newest = (1 / (length + 1)).clamp(min=MIN_ALPHA)
    alpha = torch.where(has_history, (1 - change) * newest + change, 1)
    return (
        torch.lerp(colour.view_as(noisy), noisy, alpha[:, None]),
        torch.lerp(moments.view_as(previous.moments), luminance_moments(noisy), alpha[:, None]),
        torch.where(has_history, length * (1 - change) + 1, 1),
    )


def integrate(frame: Frame, colour: Tensor, previous: Integrated | None, change: Tensor | None = None) -> Integrated:
    """Blend a frame's irradiance (B, S, 3, H, W) into its history: C' = C where it has none (§4.1).

    `change` (B, 1, H, W) in [0, 1] is the share of the history to discard (see models.filters.asvgf), by default none.
    """
    if previous is None:
        return Integrated(colour, luminance_moments(colour), torch.ones_like(frame.depth), GBuffer.of(frame))
    return Integrated(*integrate_samples(frame, colour, previous, change), GBuffer.of(frame))


def slope(depth: Tensor, mesh_id: Tensor, dim: int) -> Tensor:
    """Change of depth per pixel along `dim`: the smaller of the differences to the two neighbours on the same mesh."""
    depth = depth.movedim(dim, -1)
    mesh_id = mesh_id.movedim(dim, -1)
    step = torch.where(mesh_id[..., 1:] == mesh_id[..., :-1], depth.diff(dim=-1), torch.inf)
    ahead = F.pad(step, (0, 1), value=torch.inf)
    behind = F.pad(step, (1, 0), value=torch.inf)
    smaller = torch.where(ahead.abs() < behind.abs(), ahead, behind)
    return torch.where(smaller.isinf(), 0, smaller).movedim(-1, dim)


@compiled.by(kernels.pack_geometry)
def pack_geometry(depth: Tensor, normal: Tensor, mesh_id: Tensor) -> Tensor:
    """The geometry that edge-stopping functions compare, (B, 1, 7, H, W).

    Unit normal (3; 0 for background), depth, σ_z ∇z (2: along x and y, per pixel), ε of Eq. 3.
    """
    unit = torch.where(depth > 0, F.normalize(normal, dim=1, eps=MIN_DIVISOR), 0)
    gradient = [SIGMA_Z * slope(depth, mesh_id, dim) for dim in (-1, -2)]
    epsilon = EPSILON_Z * depth.abs() + MIN_DIVISOR
    return torch.cat([unit, depth, *gradient, epsilon], dim=1)[:, None]


def geometry_weight(p: Tensor, q: Tensor, dx: int, dy: int) -> Tensor:
    """w_z · w_n (Eq. 3 and 4), (..., 1, h, w), of q = p + (dx, dy), from the geometry (..., 7, h, w) at p and q."""
    x, y, z, depth, along_x, along_y, epsilon = p.split(1, dim=-3)
    to_x, to_y, to_z, to_depth = q.split(1, dim=-3)[:4]
    w_n = (x * to_x).addcmul_(y, to_y).addcmul_(z, to_z).clamp_(min=0)
    for _ in range(SQUARINGS):
        w_n.square_()
    expected = (along_x * dx).add_(along_y, alpha=dy).abs_()
    return w_n.mul_((depth - to_depth).abs_().div_(expected.add_(epsilon)).neg_().exp_())


@compiled.by(kernels.spatial_variance)
def spatial_variance(variance: Tensor, mean: Tensor, geometry: Tensor, where: Tensor) -> Tensor:
    """Variance (B, S, 1, H, W) of luminance, replaced `where` (B, 1, H, W) by a 7 x 7 bilateral estimate (§4.2).

    `variance` and `mean` (B, S, 1, H, W) are those of the integrated moments. The estimate is the mean of the variances
    plus the variance of the means about the window's centre: that of the averaged moments, without their cancellation.
    """
    total = torch.ones_like(geometry[:, :, :1])
    variances = variance.clone()
    first = torch.zeros_like(mean)
    second = torch.zeros_like(mean)
    for tap in strip_taps(mean.shape[-2:], SPATIAL_RADIUS):
        weight = geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy)
        difference = mean[tap.q] - mean[tap.p]
        total[tap.p].add_(weight)
        variances[tap.p].addcmul_(weight, variance[tap.q])
        first[tap.p].addcmul_(weight, difference)
        second[tap.p].addcmul_(weight, difference.square_())
    estimate = (variances + second) / total - (first / total).square()
    return torch.where(where[:, None], estimate.clamp(min=0), variance)


def estimate_variance(integrated: Integrated, geometry: Tensor) -> Tensor:
    """Variance (B, S, 1, H, W) of luminance: temporal, or spatial while the history is short (§4.2)."""
    mean, square = integrated.moments.split(1, dim=2)
    variance = (square - mean.square()).clamp(min=0)
    length = integrated.length.round()  # interpolated from whole numbers, not always exactly
    short = length < MIN_TEMPORAL_LENGTH
    if not short.any():
        return variance
    boost = (MIN_TEMPORAL_LENGTH / length.clamp(min=1)).clamp(min=1)
    return spatial_variance(variance, mean, geometry, short) * boost[:, None]


def edge_scale(variance: Tensor, surface: Tensor) -> Tensor:
    """1 / (σ_l √(g₃ₓ₃(Var) + ε)) of Eq. 5, (B, S, 1, H, W); g covers pixels that show a `surface` (B, 1, 1, H, W)."""
    surfaces = surface.to(variance)
    variances = variance * surface
    total, mean = surfaces / 4, variances / 4
    for tap in strip_taps(variance.shape[-2:], 1):
        weight = 1 / 4 / 2 ** (abs(tap.dx) + abs(tap.dy))
        total[tap.p].add_(surfaces[tap.q], alpha=weight)
        mean[tap.p].add_(variances[tap.q], alpha=weight)
    return 1 / (SIGMA_L * (mean / total.clamp(min=1 / 16) + EPSILON_L).sqrt())


def svgf_level(colour: Tensor, variance: Tensor, geometry: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """Colour (B, S, 3, H, W) and variance (B, S, 1, H, W) after a level (§4.3) with taps `step` pixels apart."""
    y = image_luminance(colour.flatten(0, 1)).view_as(variance)
    scale = edge_scale(variance, geometry[:, :, 3:4] > 0)
    total = torch.full_like(variance, CENTRE)
    mean = CENTRE * colour
    variances = CENTRE**2 * variance
    for tap in strip_taps(variance.shape[-2:], RADIUS, step):
        w_l = (y[tap.p] - y[tap.q]).abs_().mul_(scale[tap.p]).neg_().exp_()
        w_zn = geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy)
        weight = w_l.mul_(w_zn.mul_(b3_spline(tap, step)))
        total[tap.p].add_(weight)
        mean[tap.p].addcmul_(weight, colour[tap.q])
        variances[tap.p].addcmul_(weight.square_(), variance[tap.q])
    return mean / total, variances / total.square()


@compiled.by(kernels.svgf_levels)
def svgf_levels(
    colour: Tensor, variance: Tensor, geometry: Tensor, steps: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """Levels of the à-trous transform, with these steps: the colour of the first, colour and variance of the last."""
    first, variance = svgf_level(colour, variance, geometry, steps[0])
    colour = first
    for step in steps[1:]:
        colour, variance = svgf_level(colour, variance, geometry, step)
    return first, colour, variance


@dataclass(frozen=True)
class SVGFState(State):
    """The history of the next frame, and the estimated variance (B, S, 1, H, W) of this one."""

    history: Integrated
    variance: Tensor

    def pictures(self) -> dict[str, Tensor]:
        names = ("variance direct", "variance indirect")[-self.variance.shape[1] :]
        variances = dict(zip(names, self.variance.unbind(dim=1), strict=True))
        return {"history length": self.history.length} | variances


def irradiances(frame: Frame, signal: Signal) -> Tensor:
    """Noisy direct and indirect irradiance, (B, 2, 3, H, W), or indirect alone, (B, 1, 3, H, W)."""
    parts = [frame.direct, frame.indirect] if signal == "total" else [frame.indirect]
    return torch.stack([part / frame.divisor for part in parts], dim=1)


class SVGF(Denoiser):
    """Filters direct and indirect irradiance separately, each within its own [min, max] since the last reset."""

    made_from = "paper, code"
    reads: tuple[str, ...] = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id", "motion")
    refuses = CLASSICAL
    convex = True
    separates_lights = True
    baseline_for: tuple[Signal, ...] = ("total", "indirect")

    def change(self, frame: Frame) -> Tensor | None:
        """The share of the history to discard, (B, 1, H, W) in [0, 1]; None for none."""
        return None

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, SVGFState, frame)
        history = previous.history if previous else None
        integrated = integrate(frame, irradiances(frame, self.signal), history, self.change(frame))
        geometry = pack_geometry(frame.depth, frame.normal, frame.mesh_id)
        variance = estimate_variance(integrated, geometry)
        first, colour, _ = svgf_levels(integrated.colour, variance, geometry, ATROUS_STEPS)
        history = integrated._replace(colour=first)  # §4.3: the first level's output
        return frame.remodulate(colour.sum(dim=1), self.signal), SVGFState(frame.moment, history, variance)
