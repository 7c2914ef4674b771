"""NAME+accumulated: temporal accumulation of what a denoiser returns."""

import torch

from models.registry import create
from tests.helpers.frames import flat_frame, run


def walls(*levels: float):
    frames = [flat_frame(6, 8, irradiance=torch.full((1, 3, 6, 8), level)) for level in levels]
    for frame in frames:
        frame.emission[..., 4:] = 7.0
    return frames


def test_outputs_are_averaged_evenly_and_later_with_a_fifth():
    """Of the denoiser that returns its input: irradiance alone, since emission is not noise."""
    levels = [3.0, 1.0, 5.0, 2.0, 4.0, 9.0, 0.0]
    frames = walls(*levels)
    expected = 0.0
    for n, (output, level, frame) in enumerate(
        zip(run(create("noisy+accumulated"), frames), levels, frames, strict=True)
    ):
        alpha = max(0.2, 1 / (n + 1))
        expected = alpha * level + (1 - alpha) * expected
        torch.testing.assert_close(output, expected * frame.divisor + frame.emission)


def test_it_commutes_with_a_denoiser_that_does_nothing():
    """Accumulated before or after, plainly or adaptively, an unfiltered frame is the same."""
    generator = torch.Generator().manual_seed(0)
    frames = [flat_frame(12, 12, irradiance=torch.rand(1, 3, 12, 12, generator=generator)) for _ in range(6)]
    for suffix in ("", "+adaptive"):
        before = run(create(f"accumulated{suffix}"), frames)
        for output, expected in zip(run(create(f"noisy+accumulated{suffix}"), frames), before, strict=True):
            torch.testing.assert_close(output, expected)


def test_the_denoiser_inside_keeps_its_own_history():
    frames = walls(1.0, 2.0, 3.0)
    denoiser, inner = create("svgf+accumulated"), create("svgf")
    state = own = None
    for frame in frames:
        _, state = denoiser(frame, state)
        _, own = inner(frame, own)
    torch.testing.assert_close(state.inner.history.length, own.history.length)
    assert state.pictures().keys() > own.pictures().keys() - {"history length"}
