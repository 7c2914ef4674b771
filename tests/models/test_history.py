"""Temporal accumulation before and after a denoiser, and the running scale of exposure and depth, by hand."""

import numpy as np
import pytest
import torch

from models.history.accumulation import Accumulation, accumulate
from models.history.geometry import GBuffer
from models.history.running_scale import running_scale
from models.registry import create
from tests.helpers.frames import flat_frame, play, run


def test_accumulation_averages_five_frames_then_moves_on():
    """alpha = 1, 1/2, 1/3, 1/4, 1/5, 1/5, ...: an even mean of five frames, then an exponential one."""
    history = None
    values = [3.0, 1.0, 4.0, 1.0, 5.0, 9.0, 2.0]
    expected = None
    for n, value in enumerate(values):
        frame = flat_frame(4, 4, irradiance=torch.full((1, 3, 4, 4), value))
        history = accumulate(frame, frame.irradiance("total"), history)
        alpha = max(0.2, 1 / (n + 1))
        expected = value if expected is None else (1 - alpha) * expected + alpha * value
        torch.testing.assert_close(history.irradiance, torch.full((1, 3, 4, 4), expected))
        assert (history.length == n + 1).all()
        if n < 5:
            assert expected == pytest.approx(np.mean(values[: n + 1]))


def test_accumulation_starts_anew_where_disoccluded():
    frame = flat_frame(4, 6, irradiance=torch.full((1, 3, 4, 6), 2.0))
    mesh = torch.ones(1, 1, 4, 6)
    mesh[..., 3:] = 2
    before = Accumulation(
        torch.zeros(1, 3, 4, 6), torch.full((1, 1, 4, 6), 7.0), GBuffer.of(flat_frame(4, 6, mesh_id=mesh))
    )
    history = accumulate(frame, frame.irradiance("total"), before)
    assert (history.length[..., 4:] == 1).all() and (history.irradiance[..., 4:] == 2).all()
    assert (history.length[..., :3] == 8).all()
    torch.testing.assert_close(history.irradiance[..., :3], torch.full((1, 3, 4, 3), 0.4))


@pytest.mark.parametrize("suffix", ["", "+adaptive"])
def test_accumulation_commutes_with_a_denoiser_that_does_nothing(suffix):
    """Before or after, an unfiltered frame is the same; emission is not noise."""
    generator = torch.Generator().manual_seed(0)
    frames = [flat_frame(12, 12, irradiance=torch.rand(1, 3, 12, 12, generator=generator)) for _ in range(7)]
    for frame in frames:
        frame.emission[..., 4:] = 7.0
    after, before = (run(create(f"{name}{suffix}"), frames) for name in ("noisy+accumulated", "accumulated"))
    torch.testing.assert_close(after, before)


def test_the_denoiser_inside_keeps_its_own_history():
    frames = [flat_frame(6, 8)] * 3
    (_, state), (_, own) = (play(create(name), frames) for name in ("svgf+accumulated", "svgf"))
    torch.testing.assert_close(state.inner.history.length, own.history.length)
    assert state.pictures().keys() > own.pictures().keys() - {"history length"}


def test_running_scale_by_hand():
    """Constant luminance y: exposure 0.18 / y. The logarithm averages evenly at first. Black and sky change nothing."""
    grey = torch.full((1, 3, 32, 40), 0.5)
    depth = torch.full((1, 1, 32, 40), 4.0)
    first = running_scale(grey, depth, None)
    assert first.exposure().item() == pytest.approx(0.36)
    assert first.normalised_depth(depth)[0, 0, 0, 0].item() == pytest.approx(0.5)
    second = running_scale(grey * 4, depth * 4, first)
    assert second.exposure().item() == pytest.approx(0.18)  # sqrt(0.5 * 2) = 1
    nothing = running_scale(grey * 0, depth * 0, second)
    assert nothing.exposure().item() == second.exposure().item()
    assert nothing.log_depth.value == second.log_depth.value and nothing.log_depth.count == 2
    black = running_scale(grey * 0, depth * 0, None)
    assert black.exposure().item() == pytest.approx(1)
    assert (black.normalised_depth(depth * 0) == 1).all()
    # A film that starts black: the first frame with light sets the exposure alone.
    light = running_scale(grey, depth, black)
    assert light.exposure().item() == pytest.approx(0.36)
    assert light.normalised_depth(depth)[0, 0, 0, 0].item() == pytest.approx(0.5)
