"""Temporal accumulation on static walls, by hand."""

import numpy as np
import pytest
import torch

from models.history.accumulation import Accumulation, accumulate
from models.history.geometry import GBuffer
from tests.helpers.frames import flat_frame


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
