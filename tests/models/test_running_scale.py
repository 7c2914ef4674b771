"""Running exposure and depth scale, by hand."""

import pytest
import torch

from models.history.running_scale import running_scale


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


def test_running_scale_of_sparse_noise_is_near_that_of_its_mean():
    """One pixel in sixteen lit, as 1-spp images are: blocks keep the logarithm from collapsing."""
    generator = torch.Generator().manual_seed(0)
    lit = (torch.rand(1, 1, 128, 128, generator=generator) < 1 / 16).float() * 16 * 0.3
    scale = running_scale(lit.repeat(1, 3, 1, 1), torch.ones(1, 1, 128, 128), None)
    assert scale.exposure().item() == pytest.approx(0.18 / 0.3, rel=0.1)
