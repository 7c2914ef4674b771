"""The error of a denoised frame, estimated from two independent buffers A and B of its own samples.

F(A) does not depend on the noise of B, so (F(A) - B)² - (A - B)² / 2 estimates its squared error without bias. So does,
for M, the mean of F(A) and F(B), and the mean N of all samples, whose variance is v = (A - B)² / 4:

    e² = (M - N)² - v + 2 c = (A - M) (B - M) + 2 c,  where  c = (F(A) - F(B)) (A - B) / 4

estimates the product of M's error with the noise of N. M stands for F(N), whose error is the same or slightly smaller.
A blend of both, M + ρ (N - M), has the squared error

    (1 - ρ)² e² + 2 ρ (1 - ρ) c + ρ² v.

Only the noise of this frame has to be independent, not the history. So F(A) and F(B) begin with the state of F(N), and
their own states are dropped: three passes of the filter in all.

The light of the second layer of glass has no buffers. So frames with glass pass as one layer, with the history of the
main one: F(A) - F(B) shows what noise does, more of it than in two layers, and M is F(N) itself. The error in glass is
overestimated.

The estimate of a single pixel is pure noise, so a map averages it over windows. A mean over many pixels needs none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import torch
from torch import Tensor

from datasets.frame import Frame
from errors import BadInput
from models.denoiser import LayeredState, State
from models.filters.neighbours import mesh_sums, mesh_sums_9x9
from models.operators import MIN_DIVISOR, image_luminance
from models.wrappers import shrinkage
from models.wrappers.shrinkage import JamesStein

MAX_SAMPLES = 2.0**20  # per pixel; no larger number is recommended


@dataclass(frozen=True)
class ErrorEstimate:
    """Of one frame: squares of irradiance relative to `unit`, (B, 3, H, W)."""

    filter_error: Tensor  # squared error of the filter's output; unbiased, so below 0 in places
    filter_variance: Tensor  # the part of it that this frame's noise causes, never below 0
    covariance: Tensor  # of the filter's error with the frame's
    variance: Tensor  # of the frame
    rho: Tensor  # the weight of the frame in the output
    unit: Tensor  # mean luminance of the irradiance near each pixel, (B, 1, H, W), not 0
    frame: Frame

    def blended(self, filter_error: Tensor) -> Tensor:
        """The squared error of the output, without its covariance term, for a squared error of the filter."""
        return (1 - self.rho).square() * filter_error + self.rho.square() * self.variance

    @property
    def squared_error(self) -> Tensor:
        """The squared error of the output, unbiased and noisy."""
        return self.blended(self.filter_error) + 2 * self.rho * (1 - self.rho) * self.covariance

    def smoothed(self, squares: Tensor, minimum: Tensor, weight: Tensor) -> Tensor:
        """Means of `squares`, which have `weight` times the noise, over 81 x 81 pixels of the same mesh.

        Over 27 x 27 and 9 x 9 where these differ by more than chance; at least the 9 x 9 means of `minimum`.
        """
        mesh = self.frame.mesh_id
        chance = 2 * (weight * self.variance).square()
        sums = mesh_sums(torch.cat([squares, chance, minimum, torch.ones_like(mesh)], dim=1), mesh, 1)
        _, small, middle, wide = accumulate((3, 9, 27), lambda sums, step: mesh_sums(sums, mesh, step), initial=sums)
        smooth = wide[:, :3] / wide[:, 9:]
        for sums in (middle, small):
            pixels = sums[:, 9:]
            correction = sums[:, :3] / pixels - smooth
            smooth = smooth + shrinkage.significant_part(correction, sums[:, 3:6].sqrt() / pixels) * correction
        return torch.maximum(smooth, small[:, 6:9] / small[:, 9:])

    @property
    def radiance_scale(self) -> Tensor:
        """From relative irradiance to radiance, (B, 3, H, W); 0 for background, which has no error."""
        return self.frame.complete(self.unit * self.frame.divisor, "indirect")

    def radiance_error(self) -> Tensor:
        """The expected error of each pixel, a root mean square of radiance, (B, 3, H, W)."""
        squared = self.smoothed(self.squared_error, self.blended(self.filter_variance), (1 - self.rho).square())
        return squared.sqrt() * self.radiance_scale

    def surface_mean(self, squares: Tensor) -> float:
        """The mean over all pixels that show surfaces; 0 without any."""
        surface = self.frame.surface
        if surface is None:
            return float(squares.mean())
        return float((squares * surface).sum() / (3 * surface.sum()).clamp(min=1))

    def relative_error(self) -> float:
        """The root of the frame's mean squared error relative to `unit`. Not smoothed, so unbiased."""
        return max(self.surface_mean(self.squared_error), 0.0) ** 0.5

    def two_standard_errors(self) -> float:
        """Of the mean squared error relative to `unit`."""
        colours = self.squared_error.mean(dim=1, keepdim=True)
        deviation = (colours - self.surface_mean(self.squared_error)).square().expand_as(self.squared_error)
        pixels = self.unit.numel() if self.frame.surface is None else float(self.frame.surface.sum())
        return 2 * (self.surface_mean(deviation) / max(pixels, 1)) ** 0.5

    def max_relative_error(self) -> float:
        """An upper bound of `relative_error`: by two standard errors."""
        return max(self.surface_mean(self.squared_error) + self.two_standard_errors(), 0.0) ** 0.5

    def samples_for(self, target: float) -> float:
        """Samples per pixel, those of this frame included, at which shrinkage takes `max_relative_error` to `target`.

        For a filter's squared error e², assumed constant, and noise of variance v / k at k times the samples, the best
        blend has e² v / (k e² + v). The error is assumed to fall like the mean of that, and its standard error by k.
        Infinite beyond MAX_SAMPLES.
        """
        ones = torch.ones_like(self.variance)
        error = self.smoothed(self.filter_error, self.filter_variance, ones).clamp(min=MIN_DIVISOR)
        now, chance = self.relative_error() ** 2, self.two_standard_errors()

        def best_blend(k: float) -> float:
            return self.surface_mean(error * self.variance / (k * error + self.variance).clamp(min=MIN_DIVISOR))

        def remaining(k: float) -> float:
            return now * best_blend(k) / max(best_blend(1.0), MIN_DIVISOR) + chance / k

        samples = float(self.frame.samples.mean())
        if self.max_relative_error() <= target:
            return samples
        low, high = 1.0, MAX_SAMPLES / samples
        if remaining(high) > target**2:
            return torch.inf
        while high / low > 1.01:
            k = (low * high) ** 0.5
            low, high = (k, high) if remaining(k) > target**2 else (low, k)
        return samples * high


def denoise_with_error(denoiser: JamesStein, frame: Frame, state: State | None) -> tuple[Tensor, State, ErrorEstimate]:
    """The output and state of NAME+js for a frame, and the error. Raises BadInput without sample buffers."""
    if not frame.has_buffers:
        raise BadInput(f"{frame.source} has no two sample buffers: its error cannot be estimated")
    frame = frame.finite()
    inner, signal = denoiser.inner, denoiser.signal
    output, after = inner(frame, state)
    filtered, rho = denoiser.weighed(frame, output)
    buffers = [frame.buffer(which) for which in (0, 1)]
    before = of_one_layer(state) if state else None
    passes = [buffer.demodulate(inner(buffer, before)[0], signal) for buffer in buffers]
    if frame.has_layers:
        offset = filtered - (passes[0] + passes[1]) / 2
        passes = [each + offset for each in passes]
    estimate = estimate_error(frame, filtered, passes, [buffer.irradiance(signal) for buffer in buffers], rho)
    return denoiser.shrunk(frame, filtered, rho), after, estimate


def of_one_layer(state: State) -> State:
    """A state, of wrappers too, with the history of the main layer of glass in place of that of both."""
    if isinstance(state, LayeredState):
        return state.main
    inner: State | None = getattr(state, "inner", None)  # of a wrapper
    return replace(state, inner=of_one_layer(inner)) if inner else state  # type: ignore[call-arg]


def estimate_error(
    frame: Frame, filtered: Tensor, passes: Sequence[Tensor], buffers: Sequence[Tensor], rho: Tensor
) -> ErrorEstimate:
    """The estimate from irradiance (B, 3, H, W): F(N), [F(A), F(B)] and [A, B]."""
    mesh = frame.mesh_id
    sums = mesh_sums_9x9(torch.cat([image_luminance(filtered), torch.ones_like(mesh)], dim=1), mesh)
    unit = shrinkage.comparison_unit(sums[:, :1] / sums[:, 1:])
    mean = (passes[0] + passes[1]) / 2
    error_a, error_b = (shrinkage.relative(buffer - mean, unit) for buffer in buffers)
    difference = shrinkage.relative(passes[0] - passes[1], unit)
    covariance = difference * (error_a - error_b) / 4
    return ErrorEstimate(
        filter_error=error_a * error_b + 2 * covariance,
        filter_variance=difference.square() / 4,
        covariance=covariance,
        variance=(error_a - error_b).square() / 4,
        rho=rho,
        unit=unit,
        frame=frame,
    )
