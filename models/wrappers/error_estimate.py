"""How far a denoised frame is from the truth, as the two independent halves of its own samples tell.

F(A) does not depend on the noise of B, so (F(A) - B)² - (A - B)² / 2 estimates its squared error without bias. In the
same way that of M, the mean of F(A) and F(B), beside the mean N of all samples, whose variance is v = (A - B)² / 4:

    e² = (M - N)² - v + 2 c = (A - M) (B - M) + 2 c,  where  c = (F(A) - F(B)) (A - B) / 4

estimates the product of M's error with the noise of N. M is taken for F(N), whose error is the same or a little less
(docs/experiments.md, Error map). What is mixed of both, M + ρ (N - M), has the squared error

    (1 - ρ)² e² + 2 ρ (1 - ρ) c + ρ² v.

History may be the same for both halves: only the noise of this frame has to be independent. So F(A) and F(B) begin with
the state of F(N), and theirs are dropped: three passes of the filter in all.

One pixel's estimate says nothing, so it is averaged over windows for a map. A mean over many pixels needs no smoothing.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from errors import BadInput
from models.denoiser import State
from models.filters.neighbours import mesh_sums
from models.operators import MIN_DIVISOR, image_luminance
from models.wrappers.shrinkage import Shrunk, believed, denoised_irradiance, mixture, relative, share_let_in, unit_of

MOST_SAMPLES = 2.0**20  # a pixel; nobody is told to take more


@dataclass(frozen=True)
class ErrorEstimate:
    """Of one frame: squares of irradiance relative to `unit`, (B, 3, H, W).

    Attributes:
        filter_error: squared error of what the filter returned; unbiased, so below 0 in places.
        spread: the part of it that this frame's noise makes, never below 0.
        covariance: of the filter's error with the frame's.
        variance: of the frame.
        share: ρ of the noise that was let in.
        unit: luminance of the irradiance around each pixel, (B, 1, H, W), not 0.
        frame: the frame.
    """

    filter_error: Tensor
    spread: Tensor
    covariance: Tensor
    variance: Tensor
    share: Tensor
    unit: Tensor
    frame: Frame

    def mixed(self, filter_error: Tensor) -> Tensor:
        """The squared error of the output, but for the covariance, for that of what the filter returned."""
        rho = self.share
        return (1 - rho).square() * filter_error + rho.square() * self.variance

    @property
    def squared(self) -> Tensor:
        """The squared error of the output, as noisy as it is unbiased."""
        return self.mixed(self.filter_error) + 2 * self.share * (1 - self.share) * self.covariance

    def smoothed(self, squares: Tensor, least: Tensor, weight: Tensor) -> Tensor:
        """Means of `squares`, which have `weight` times the noise, over 81 x 81 pixels of the own mesh.

        Over 27 x 27 and 9 x 9 where these differ by more than chance; nowhere less than `least`, over 9 x 9. All
        (B, 3, H, W).
        """
        mesh = self.frame.mesh_id
        chance = 2 * (weight * self.variance).square()
        sums = mesh_sums(torch.cat([squares, chance, least, torch.ones_like(mesh)], dim=1), mesh, 1)
        windows = []
        for step in (3, 9, 27):
            sums = mesh_sums(sums, mesh, step)
            windows.append(sums)
        smooth = windows[-1][:, :3] / windows[-1][:, 9:]
        for sums in reversed(windows[:-1]):
            pixels = sums[:, 9:]
            off = sums[:, :3] / pixels - smooth
            smooth = smooth + believed(off, sums[:, 3:6].sqrt() / pixels) * off
        return torch.maximum(smooth, windows[0][:, 6:9] / windows[0][:, 9:])

    @property
    def scale(self) -> Tensor:
        """From relative irradiance to radiance, (B, 3, H, W); 0 for background, which has no error."""
        return self.frame.complete(self.unit * self.frame.divisor, "indirect")

    def radiance(self) -> Tensor:
        """The error to expect of each pixel, (B, 3, H, W): a root mean square, in radiance."""
        squared = self.smoothed(self.squared, self.mixed(self.spread), (1 - self.share).square())
        return squared.sqrt() * self.scale

    def over_surfaces(self, squares: Tensor) -> float:
        """The mean over all pixels but background; 0 without any."""
        surface = self.frame.surface
        if surface is None:
            return float(squares.mean())
        return float((squares * surface).sum() / (3 * surface.sum()).clamp(min=1))

    def relative_error(self) -> float:
        """Of the frame: the root of the mean squared error relative to `unit`. Not smoothed, so without its bias."""
        return max(self.over_surfaces(self.squared), 0.0) ** 0.5

    def chance(self) -> float:
        """Two standard errors of the mean squared error relative to `unit`."""
        colours = self.squared.mean(dim=1, keepdim=True)
        off = (colours - self.over_surfaces(self.squared)).square().expand_as(self.squared)
        pixels = self.unit.numel() if self.frame.surface is None else float(self.frame.surface.sum())
        return 2 * (self.over_surfaces(off) / max(pixels, 1)) ** 0.5

    def most_relative_error(self) -> float:
        """The same as `relative_error`, with what may be chance added."""
        return max(self.over_surfaces(self.squared) + self.chance(), 0.0) ** 0.5

    def samples_for(self, target: float) -> float:
        """Samples a pixel, the own among them, by which `most_relative_error` is down to `target`, by shrinkage.

        Of a filter's squared error e², which is taken to stay, and noise of variance v / k for k times the samples, the
        best mixture has e² v / (k e² + v). By as much as the mean of that falls, the error is taken to fall, and chance
        by k. Infinite beyond MOST_SAMPLES.
        """
        error = self.smoothed(self.filter_error, self.spread, torch.ones_like(self.variance)).clamp(min=MIN_DIVISOR)
        now, chance = self.relative_error() ** 2, self.chance()

        def mixture(k: float) -> float:
            return self.over_surfaces(error * self.variance / (k * error + self.variance).clamp(min=MIN_DIVISOR))

        def left(k: float) -> float:
            return now * mixture(k) / max(mixture(1.0), MIN_DIVISOR) + chance / k

        own = float(self.frame.samples.mean())
        if self.most_relative_error() <= target:
            return own
        low, high = 1.0, MOST_SAMPLES / own
        if left(high) > target**2:
            return torch.inf
        while high / low > 1.01:
            k = (low * high) ** 0.5
            low, high = (k, high) if left(k) > target**2 else (low, k)
        return own * high


def with_error(denoiser: Shrunk, frame: Frame, state: State | None) -> tuple[Tensor, State, ErrorEstimate]:
    """What NAME+js makes of a frame, its state, and the estimate of its error. Raises BadInput without halves."""
    if not frame.has_buffers:
        raise BadInput(f"{frame.source} has no halves of its samples: how far it is from the truth cannot be told")
    frame = frame.finite()
    inner, signal = denoiser.inner, denoiser.signal
    output, after = inner(frame, state)
    filtered = denoised_irradiance(output, frame, signal)
    share = share_let_in(frame, filtered, signal)
    halves = [frame.buffer(which) for which in (0, 1)]
    passes = [denoised_irradiance(inner(half, state)[0], half, signal) for half in halves]
    estimate = estimated(frame, filtered, passes, [half.irradiance(signal) for half in halves], share)
    return frame.remodulate(mixture(frame, filtered, share, signal), signal), after, estimate


def estimated(
    frame: Frame, filtered: Tensor, passes: list[Tensor], halves: list[Tensor], share: Tensor
) -> ErrorEstimate:
    """The estimate from irradiance (B, 3, H, W): F(N), F(A) and F(B), A and B."""
    mesh = frame.mesh_id
    counted = torch.cat([image_luminance(filtered), torch.ones_like(mesh)], dim=1)
    sums = mesh_sums(mesh_sums(counted, mesh, 1), mesh, 3)
    unit = unit_of(sums[:, :1] / sums[:, 1:])
    mean = (passes[0] + passes[1]) / 2
    off_a, off_b = (relative(half - mean, unit) for half in halves)
    between = relative(passes[0] - passes[1], unit)
    covariance = between * (off_a - off_b) / 4
    return ErrorEstimate(
        filter_error=off_a * off_b + 2 * covariance,
        spread=between.square() / 4,
        covariance=covariance,
        variance=(off_a - off_b).square() / 4,
        share=share,
        unit=unit,
        frame=frame,
    )
