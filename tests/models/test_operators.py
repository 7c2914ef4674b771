"""Small operators on images."""

import pytest
import torch

from models.operators import finite, image_luminance, pad_to_multiple


def test_luminance_weights():
    rgb = torch.eye(3)[None, :, :, None]
    torch.testing.assert_close(image_luminance(rgb)[0, 0, :, 0], torch.tensor([0.2126, 0.7152, 0.0722]))


@pytest.mark.parametrize("size", [(1, 1), (4, 6), (5, 8), (8, 8)])
def test_padding_repeats_the_borders(size):
    image = torch.rand(2, 3, *size)
    padded = pad_to_multiple(image, 4)
    height, width = padded.shape[-2:]
    assert height % 4 == width % 4 == 0 and height - size[0] < 4 and width - size[1] < 4
    rows = torch.arange(height).clamp(max=size[0] - 1)
    columns = torch.arange(width).clamp(max=size[1] - 1)
    assert torch.equal(padded, image[..., rows, :][..., columns])


def test_what_is_not_finite_becomes_black():
    assert finite(torch.tensor([1.0, torch.nan, torch.inf, -torch.inf, -2.0])).tolist() == [1.0, 0.0, 0.0, 0.0, -2.0]
