"""Temporal accumulation on still walls, by hand."""

from contextlib import nullcontext

import numpy as np
import pytest
import torch

from models import compiled
from models.accumulation import Accumulation, accumulate
from models.surfaces import Surfaces
from tests.helpers.frames import flat_frame


def test_accumulation_averages_five_frames_then_moves_on():
    """alpha = 1, 1/2, 1/3, 1/4, 1/5, 1/5, ...: on a still wall, an even mean of five and then an exponential one."""
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
        torch.zeros(1, 3, 4, 6), torch.full((1, 1, 4, 6), 7.0), Surfaces.of(flat_frame(4, 6, mesh_id=mesh))
    )
    history = accumulate(frame, frame.irradiance("total"), before)
    assert (history.length[..., 4:] == 1).all() and (history.irradiance[..., 4:] == 2).all()
    assert (history.length[..., :3] == 8).all()
    torch.testing.assert_close(history.irradiance[..., :3], torch.full((1, 3, 4, 3), 0.4))


@pytest.mark.parametrize("compile_kernels", [True, False])
def test_change_moves_alpha_towards_one_and_shortens_the_history(compile_kernels):
    """alpha = lerp(max(0.2, 1/(n+1)), 1, change), and the length is at most 1 / alpha: after 1 and after 9 frames."""
    change = torch.tensor([0.0, 0.25, 1.0]).repeat_interleave(2).expand(1, 1, 4, 6).contiguous()
    frame = flat_frame(4, 6, irradiance=torch.full((1, 3, 4, 6), 2.0))
    for n, plain in ((1.0, 1 / 2), (9.0, 0.2)):
        before = Accumulation(torch.full((1, 3, 4, 6), 1.0), torch.full((1, 1, 4, 6), n), Surfaces.of(frame))
        with nullcontext() if compile_kernels else compiled.disabled():
            after = accumulate(frame, frame.irradiance("total"), before, change)
        alpha = plain + (1 - plain) * change
        torch.testing.assert_close(after.irradiance, (1 + alpha).expand(1, 3, 4, 6))
        torch.testing.assert_close(after.length, (1 / alpha).clamp(max=n + 1))
