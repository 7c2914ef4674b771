"""Padding of images."""

import numpy as np
import pytest
import torch

from models.operators import pad_to_multiple


@pytest.mark.parametrize("size", [(1, 1), (4, 6), (5, 8), (8, 8)])
def test_padding_repeats_the_borders(size):
    image = torch.rand(2, 3, *size)
    expected = np.pad(image, [(0, 0), (0, 0), *((0, -length % 4) for length in size)], mode="edge")
    np.testing.assert_array_equal(pad_to_multiple(image, 4), expected)
