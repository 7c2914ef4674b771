"""Where errors are, with errors that were put there."""

import numpy as np
import pytest
import torch

from command_line import main
from eval.error_location import by_scale, normalised, places, squared_errors
from tests.helpers.frames import flat_frame

SIZE = 64


def frame_with_edges():
    """A mesh edge at column 16, a crease at column 32, a mirror below row 48."""
    frame = flat_frame(SIZE, SIZE)
    column, row = torch.arange(SIZE), torch.arange(SIZE)[:, None]
    right = (column >= 32).expand(1, 1, SIZE, SIZE)
    channels = {
        "mesh_id": torch.where(column < 16, 1.0, 2.0).expand(1, 1, SIZE, SIZE),
        "normal": torch.where(right, torch.tensor([1.0, 0, 0])[:, None, None], frame.normal),
        "roughness": torch.where(row < 48, 1.0, 0.05).expand(1, 1, SIZE, SIZE),
    }
    return frame.with_channels(channels)


def shares_of(errors: torch.Tensor, noise: float = 0.0) -> dict[str, float]:
    """Shares of errors (1, 3, H, W) of an image, compared with two noisy buffers of a grey reference."""
    rng = np.random.default_rng(0)
    buffers = 0.5 + noise * torch.from_numpy(rng.normal(size=(2, 3, SIZE, SIZE)))
    masks = places(frame_with_edges(), torch.full((1, 3, SIZE, SIZE), 0.5))
    shares = normalised(squared_errors(0.5 + errors, buffers, masks))
    return {name: float(value) for (_, name), value in shares.items()}


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_errors_are_found_where_they_are_in_spite_of_noise(noise):
    errors = torch.zeros(1, 3, SIZE, SIZE, dtype=torch.float64)
    errors[..., 15:17] = 0.3  # both columns of the mesh edge
    errors[..., 48:, 31] = -0.6  # a quarter of one column of the crease
    shares = shares_of(errors, noise)
    edge, crease = 2 * SIZE * 0.3**2, SIZE / 4 * 0.6**2
    assert shares["mesh edges"] == pytest.approx(edge / (edge + crease), abs=0.05)
    assert shares["creases"] == pytest.approx(crease / (edge + crease), abs=0.05)
    assert shares["inside"] == pytest.approx(0, abs=0.05)
    smooth = (2 * 16 * 0.3**2 + crease) / (edge + crease)
    assert shares["α ≤ 0.1"] == pytest.approx(smooth, abs=0.05)
    assert shares["to 0.75"] == pytest.approx(1)


def test_a_perfect_image_has_no_share_anywhere():
    assert set(shares_of(torch.zeros(1, 3, SIZE, SIZE, dtype=torch.float64)).values()) == {0.0}


def test_every_pixel_has_one_place():
    masks = places(frame_with_edges(), torch.rand(1, 3, SIZE, SIZE))
    for question in ("place", "roughness", "displayed"):
        assert (sum(mask.int() for key, mask in masks.items() if key[0] == question) == 1).all()


@pytest.mark.parametrize(("period", "name"), [(2, "below 4 px"), (8, "to 16 px"), (1000, "larger")])
def test_scales_are_those_of_stripes(period, name):
    stripes = torch.where(torch.arange(SIZE) % period < period / 2, 1.0, -1.0).expand(1, 3, SIZE, SIZE)
    shares = normalised(by_scale(stripes, stripes))
    assert float(shares["scale", name]) == pytest.approx(1)


def test_the_command_prints_a_table_for_each_clip(tiny, tmp_path, capsys):
    main(["eval", "noisy", "svgf", "--where", "--data", str(tiny), "--runs", str(tmp_path)])
    printed = capsys.readouterr().out
    assert printed.count("mesh edges") == 2 and "pixels    noisy    svgf" in printed
    assert not (tmp_path / "eval").exists()
