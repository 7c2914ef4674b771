"""Accumulation that follows light and holds fireflies down, for whatever denoiser begins with it: NAME+adaptive. Ours.

Plain accumulation lags behind light that changes, and shows a firefly for as long as its weight takes to fade. Two
things are done before the newest frame is blended into its history, both from what the frames show of a surface around
a pixel, here 7 x 7 strata of 3 x 3 pixels:

- Samples brighter than three times the mean are cut to that, and every pixel gets the mean of what was cut off around
  it: fireflies become faint blotches, and on average no energy is lost.
- Where the surface's newest mean differs from that of its history by more than noise explains, the history is
  multiplied by their ratio. Light mostly changes in a whole neighbourhood at once, so the history remains as free of
  noise as it was, which a larger weight of the newest frame would give up.

The noise is estimated from the differences themselves, t² = (Σ w d)² / Σ w² d² for d with mean 0, which a single pixel
cannot make larger than 1.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from errors import BadInput
from models.compiled.accumulation import MIN_ALPHA
from models.denoiser import Denoiser, State
from models.filters.atrous import Tap, WindowSum, strip_taps
from models.filters.baselines import Accumulating
from models.filters.svgf import geometry_weight, pack_geometry
from models.history.accumulation import Accumulation
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from models.history.strata import repeat_strata, strata_centres, strata_sums
from models.operators import MAX_LUMINANCE, MIN_DIVISOR, image_luminance
from models.wrappers.wrapper import Wrapper

RADIUS = 3  # strata: windows of 7 x 7
BRIGHTEST = 3.0  # times the mean around it: what a sample may count
INSIGNIFICANT = 6.0  # t² up to which a difference counts as noise; of normal ones, 1.4 % are larger
SIGNIFICANT = 12.0  # and from which on it is believed as it is; 0.05 %
LARGEST_GAIN = 4.0  # of history, in one frame
GAIN_STEPS = 3  # each comes closer to where the newest frame is to be cut
LARGEST_IRRADIANCE = 1e30  # whose sums stay finite


class Neighbourhoods:
    """The surface around each stratum of a frame: windows of 7 x 7 strata, which end at edges as SVGF's filter does.

    A stratum stands for the surface in its middle; pixels of other meshes are none of its `members` (B, 1, H, W).
    """

    def __init__(self, frame: Frame):
        mesh_id = strata_centres(frame.mesh_id)
        geometry = pack_geometry(strata_centres(frame.depth), strata_centres(frame.normal), mesh_id)[:, 0]
        self.size = frame.size
        self.members = (frame.depth > 0) & (frame.mesh_id == repeat_strata(mesh_id, frame.size))
        self.taps: list[tuple[Tap, Tensor]] = [
            (tap, geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy))
            for tap in strip_taps(geometry.shape[-2:], RADIUS)
        ]

    def sums(self, image: Tensor, power: int = 1) -> Tensor:
        """Sums (B, C, h, w) over each window of an image (B, C, H, W), weighted by w^power."""
        window = WindowSum(strata_sums(image), 1)
        for tap, weight in self.taps:
            window.add(tap, weight**power)
        return window.sum

    def means(self, image: Tensor) -> Tensor:
        """Means (B, C, H, W) over the members of each window of an image (B, C, H, W), weighted by w; else 0."""
        members = self.members.to(image)
        total, count = self.sums(torch.cat([image * members, members], dim=1)).split([image.shape[1], 1], dim=1)
        return repeat_strata(total / count.clamp(min=1), self.size) * members


def brightest(expected: Tensor, around: Neighbourhoods) -> Tensor:
    """The luminance (B, 1, H, W) that a sample may have: three times the mean of what is `expected` around it."""
    return torch.where(around.members, BRIGHTEST * around.means(expected), torch.inf)


def bounded(irradiance: Tensor, limit: Tensor, around: Neighbourhoods) -> Tensor:
    """Irradiance (B, 3, H, W) of which what exceeds the luminance `limit` (B, 1, H, W) is shared out around it."""
    luminance = image_luminance(irradiance)
    kept = torch.where(luminance > limit, limit / luminance.clamp(min=MIN_DIVISOR), 1)
    return irradiance * kept + around.means(irradiance * (1 - kept))


def trust(difference: Tensor, around: Neighbourhoods) -> Tensor:
    """How far to believe that the sum of differences (B, 1, H, W) around each stratum is no noise, (B, 1, h, w)."""
    variance = around.sums(difference.square(), power=2)
    t_squared = around.sums(difference).square() / variance.clamp(min=MIN_DIVISOR)
    return ((t_squared - INSIGNIFICANT) / (SIGNIFICANT - INSIGNIFICANT)).clamp(0, 1)


def gain(newest: Tensor, past: Tensor, cut: Tensor, limit: Tensor, around: Neighbourhoods) -> Tensor:
    """What to multiply history by, (B, 1, H, W): 1 where its difference from the newest frame may well be noise.

    From the luminance of the `newest` frame and of the `past`, and that of the past `cut` at `limit`; all (B, 1, H, W),
    and 0 where they are not to be compared. The newest one is to be cut where history would have been in today's light:
    at `limit` times the gain itself. What is cut tells changes from fireflies, but where limits have changed its ratio
    may be too large: the gain is at most that of the whole.
    """
    believed = trust(torch.minimum(newest, limit) - cut, around)
    now, then, then_cut = (around.sums(torch.cat([newest, past, cut], dim=1)) + MIN_DIVISOR).split(1, dim=1)
    whole = (now / then).clamp(1 / LARGEST_GAIN, LARGEST_GAIN)
    factor = torch.ones_like(past)
    for _ in range(GAIN_STEPS):
        ratio = (around.sums(torch.minimum(newest, limit * factor)) + MIN_DIVISOR) / then_cut
        factor = repeat_strata(ratio.clamp(whole.clamp(max=1), whole.clamp(min=1)) ** believed, around.size)
    return factor


def luminance_of(irradiance: Tensor) -> Tensor:
    """Luminance (B, 1, H, W) whose squares can be summed."""
    return image_luminance(irradiance).clamp(0, MAX_LUMINANCE)


@dataclass(frozen=True)
class AdaptiveAccumulation(Accumulation):
    """Also the history of luminance without what was shared out, by which changes are told."""

    cut: Tensor  # (B, 1, H, W)


def accumulate_adaptively(frame: Frame, irradiance: Tensor, history: Accumulation | None) -> Accumulation:
    """As models.history.accumulation.accumulate, with fireflies shared out and a history that follows the light."""
    irradiance = irradiance.clamp(max=LARGEST_IRRADIANCE)
    luminance = luminance_of(irradiance)
    around = Neighbourhoods(frame)
    if not isinstance(history, AdaptiveAccumulation):
        limit = brightest(luminance, around)
        cut = torch.minimum(luminance, limit)
        shared = bounded(irradiance, limit, around)
        return AdaptiveAccumulation(shared, torch.ones_like(cut), GBuffer.of(frame), cut)
    before = torch.cat([history.irradiance, history.length, history.cut], dim=1)
    fetched, found = reproject(frame, before, history.gbuffer)
    past, n, past_cut = fetched.split([3, 1, 1], dim=1)
    past_luminance = luminance_of(past)
    limit = brightest(torch.where(found, past_luminance, luminance), around)
    comparable = found & around.members
    factor = gain(luminance * comparable, past_luminance * comparable, past_cut * comparable, limit, around)
    limit = limit * factor
    alpha = torch.where(found, (1 / (n + 1)).clamp(min=MIN_ALPHA), 1)
    return AdaptiveAccumulation(
        torch.lerp(past * factor, bounded(irradiance, limit, around), alpha),
        torch.where(found, n + 1, 1),
        GBuffer.of(frame),
        torch.lerp(past_cut * factor, torch.minimum(luminance, limit), alpha),
    )


class Adaptive(Wrapper):
    """The same denoiser on adaptively accumulated frames. Raises BadInput for one that does not accumulate."""

    def __init__(self, inner: Denoiser):
        if not isinstance(inner, Accumulating):
            raise BadInput(f"{type(inner).__name__} does not begin with temporal accumulation: leave out +adaptive")
        super().__init__(inner)
        inner.accumulation = accumulate_adaptively

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return self.inner.forward(frame, state)
