"""Temporal accumulation around a denoiser: NAME+accumulated after it, NAME+adaptive, our own, in place of its own.

NAME+adaptive follows changes of light and suppresses fireflies. Plain accumulation lags behind light that changes, and
shows a firefly until its weight has faded. So before a frame is blended into its history, two things are done, both
from neighbourhoods of the same surface: 7 x 7 strata of 3 x 3 pixels.

- Samples brighter than three times the mean are clamped to that, and the energy removed is spread evenly over the
  neighbourhood: fireflies become faint blotches, and on average no energy is lost.
- Where the mean of the newest frame differs from that of its history by more than noise explains, the history is
  multiplied by their ratio. Light mostly changes in a whole neighbourhood at once, so the history stays as free of
  noise as it was, which a larger weight of the newest frame would not preserve.

The noise is estimated from the differences themselves: t² = (Σ w d)² / Σ w² d² for d of mean 0, which a single pixel
cannot raise above 1.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from errors import BadInput
from models.compiled.accumulation import MIN_ALPHA
from models.denoiser import Denoiser, State, matching_state
from models.filters.asvgf import repeat_strata, strata_centres, strata_sums
from models.filters.atrous import Tap, strip_taps
from models.filters.baselines import AccumulatedState, Accumulating
from models.filters.svgf import geometry_weight, pack_geometry
from models.history.accumulation import Accumulation
from models.history.geometry import GBuffer
from models.history.light_gain import MAX_GAIN, MIN_GAIN
from models.history.reprojection import reproject
from models.operators import MAX_IRRADIANCE, MAX_LUMINANCE, MIN_DIVISOR, image_luminance
from models.wrappers.wrapper import Wrapper

STRATA_RADIUS = 3  # windows of 7 x 7 strata
FIREFLY_RATIO = 3.0  # largest luminance of a sample, times the mean of its neighbourhood
T_SQUARED_OF_NOISE = 6.0  # up to which a difference counts as noise; 1.4 % of normally distributed ones are larger
T_SQUARED_OF_CHANGE = 12.0  # from which on it counts in full; 0.05 %
GAIN_ITERATIONS = 3  # towards the limit at which the newest frame is to be clamped


class SurfaceNeighbourhoods:
    """Windows of 7 x 7 strata around each stratum of a frame, which end at edges as SVGF's filter does.

    A stratum has the surface of its centre; only pixels of that mesh are `members` (B, 1, H, W).
    """

    def __init__(self, frame: Frame):
        mesh_id = strata_centres(frame.mesh_id)
        geometry = pack_geometry(strata_centres(frame.depth), strata_centres(frame.normal), mesh_id)[:, 0]
        self.size = frame.size
        self.members = (frame.depth > 0) & (frame.mesh_id == repeat_strata(mesh_id, frame.size))
        self.taps: list[tuple[Tap, Tensor]] = [
            (tap, geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy))
            for tap in strip_taps(geometry.shape[-2:], STRATA_RADIUS)
        ]

    def sums(self, image: Tensor, power: int = 1) -> Tensor:
        """Sums (B, C, h, w) over each window of an image (B, C, H, W), weighted by w^power."""
        strata = strata_sums(image)
        total = strata.clone()
        for tap, weight in self.taps:
            total[tap.p].addcmul_(weight**power, strata[tap.q])
        return total

    def means(self, image: Tensor) -> Tensor:
        """Means (B, C, H, W) over the members of each window of an image (B, C, H, W), weighted by w; 0 off members."""
        members = self.members.to(image)
        total, count = self.sums(torch.cat([image * members, members], dim=1)).split([image.shape[1], 1], dim=1)
        return repeat_strata(total / count.clamp(min=1), self.size) * members


def firefly_limit(expected: Tensor, near: SurfaceNeighbourhoods) -> Tensor:
    """The largest luminance (B, 1, H, W) of a sample: three times the neighbourhood's mean of `expected` luminance."""
    return torch.where(near.members, FIREFLY_RATIO * near.means(expected), torch.inf)


def spread_fireflies(irradiance: Tensor, limit: Tensor, near: SurfaceNeighbourhoods) -> Tensor:
    """Irradiance (B, 3, H, W) clamped to the luminance `limit` (B, 1, H, W), its excess spread over neighbourhoods."""
    luminance = image_luminance(irradiance)
    kept = torch.where(luminance > limit, limit / luminance.clamp(min=MIN_DIVISOR), 1)
    return irradiance * kept + near.means(irradiance * (1 - kept))


def significance(difference: Tensor, near: SurfaceNeighbourhoods) -> Tensor:
    """From 0, noise, to 1, change: of the sum of differences (B, 1, H, W) over each neighbourhood, (B, 1, h, w)."""
    variance = near.sums(difference.square(), power=2)
    t_squared = near.sums(difference).square() / variance.clamp(min=MIN_DIVISOR)
    return ((t_squared - T_SQUARED_OF_NOISE) / (T_SQUARED_OF_CHANGE - T_SQUARED_OF_NOISE)).clamp(0, 1)


def history_gain(newest: Tensor, past: Tensor, clamped: Tensor, limit: Tensor, near: SurfaceNeighbourhoods) -> Tensor:
    """The factor for history, (B, 1, H, W): 1 where its difference from the newest frame may well be noise.

    From the luminances of the `newest` frame, of the `past`, and of the past `clamped` at `limit`; all (B, 1, H, W), 0
    where they are not comparable. The newest frame has to be clamped at the limit that the past would have had in the
    new light: `limit` times the gain itself. Clamping separates changes from fireflies, but where limits have changed
    its ratio may be too large, so the gain is at most that of the unclamped luminances.
    """
    changed = significance(torch.minimum(newest, limit) - clamped, near)
    now, then, then_clamped = (near.sums(torch.cat([newest, past, clamped], dim=1)) + MIN_DIVISOR).split(1, dim=1)
    unclamped = (now / then).clamp(MIN_GAIN, MAX_GAIN)
    gain = torch.ones_like(past)
    for _ in range(GAIN_ITERATIONS):
        ratio = (near.sums(torch.minimum(newest, limit * gain)) + MIN_DIVISOR) / then_clamped
        gain = repeat_strata(ratio.clamp(unclamped.clamp(max=1), unclamped.clamp(min=1)) ** changed, near.size)
    return gain


def finite_luminance(irradiance: Tensor) -> Tensor:
    """Luminance (B, 1, H, W) whose squares can be summed."""
    return image_luminance(irradiance).clamp(0, MAX_LUMINANCE)


@dataclass(frozen=True)
class AdaptiveAccumulation(Accumulation):
    """Also the history of luminance clamped at firefly limits, from which changes are detected."""

    clamped: Tensor  # (B, 1, H, W)


def accumulate_adaptively(frame: Frame, irradiance: Tensor, previous: Accumulation | None) -> Accumulation:
    """As models.history.accumulation.accumulate, with fireflies spread out and a history that follows the light."""
    irradiance = irradiance.clamp(max=MAX_IRRADIANCE)
    luminance = finite_luminance(irradiance)
    near = SurfaceNeighbourhoods(frame)
    if not isinstance(previous, AdaptiveAccumulation):
        limit = firefly_limit(luminance, near)
        clamped = torch.minimum(luminance, limit)
        even = spread_fireflies(irradiance, limit, near)
        return AdaptiveAccumulation(even, torch.ones_like(clamped), GBuffer.of(frame), clamped)
    images = torch.cat([previous.irradiance, previous.length, previous.clamped], dim=1)
    history, has_history = reproject(frame, images, previous.gbuffer)
    past, n, past_clamped = history.split([3, 1, 1], dim=1)
    past_luminance = finite_luminance(past)
    limit = firefly_limit(torch.where(has_history, past_luminance, luminance), near)
    comparable = has_history & near.members
    gain = history_gain(luminance * comparable, past_luminance * comparable, past_clamped * comparable, limit, near)
    limit = limit * gain
    alpha = torch.where(has_history, (1 / (n + 1)).clamp(min=MIN_ALPHA), 1)
    return AdaptiveAccumulation(
        torch.lerp(past * gain, spread_fireflies(irradiance, limit, near), alpha),
        torch.where(has_history, n + 1, 1),
        GBuffer.of(frame),
        torch.lerp(past_clamped * gain, torch.minimum(luminance, limit), alpha),
    )


class Adaptive(Wrapper):
    """The same denoiser on adaptively accumulated frames. Raises BadInput for one of other input than `accumulated`."""

    def __init__(self, inner: Denoiser):
        if not isinstance(inner, Accumulating):
            raise BadInput(
                f"{type(inner).__name__} does not filter what `accumulated` returns, which +adaptive replaces: leave "
                "+adaptive out, or put +accumulated before it"
            )
        super().__init__(inner)
        inner.accumulation = accumulate_adaptively

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return self.inner.run(frame, state)


@dataclass(frozen=True)
class AccumulatedAfterState(AccumulatedState):
    """The history of denoised irradiance, and the inner denoiser's state."""

    inner: State

    def pictures(self) -> dict[str, Tensor]:
        return super().pictures() | self.inner.pictures()


class AccumulatedAfter(Wrapper, Accumulating):
    """Denoised irradiance averaged over frames along motion vectors, as models.filters.baselines.Accumulated does.

    With +adaptive after it, by adaptive accumulation.
    """

    needs = ("emission", "albedo", "normal", "depth", "mesh_id", "motion")

    def __init__(self, inner: Denoiser):
        super().__init__(inner)
        self.convex = inner.convex
        self.separates_lights = inner.separates_lights

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, AccumulatedAfterState, frame)
        output, inner = self.inner.run(frame, previous.inner if previous else None)
        irradiance = frame.demodulate(output, self.signal)
        history = self.accumulation(frame, irradiance, previous.history if previous else None)
        return frame.remodulate(history.irradiance, self.signal), AccumulatedAfterState(frame.moment, history, inner)
