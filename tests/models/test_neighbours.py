"""models.filters.neighbours against means taken pixel by pixel in float64, by kernels and by PyTorch."""

import contextlib

import numpy as np
import pytest
import torch

from models import compiled
from models.filters.neighbours import mesh_means

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def taps(mesh: np.ndarray, y: int, x: int, step: int) -> list[tuple[int, int]]:
    """The 3 x 3 pixels around one that are in the image and on its mesh."""
    height, width = mesh.shape
    around = [(y + dy, x + dx) for dy in (-step, 0, step) for dx in (-step, 0, step)]
    return [(j, i) for j, i in around if 0 <= j < height and 0 <= i < width and mesh[j, i] == mesh[y, x]]


@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 9), (9, 5), (7, 40)])
def test_means_are_over_the_own_mesh(kernels: bool, height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, height, width, generator=generator)
    mesh_id = torch.randint(0, 3, (2, 1, height, width), generator=generator).float()
    with contextlib.nullcontext() if kernels else compiled.disabled():
        near, around, deviation = mesh_means(image, mesh_id)
    for item in range(2):
        pixels = image[item].permute(1, 2, 0).numpy().astype(float)
        mesh = mesh_id[item, 0].numpy()
        for y in range(height):
            for x in range(width):
                close = [pixels[at] for at in taps(mesh, y, x, 1)]
                wide = np.array([pixels[at] for far in taps(mesh, y, x, 3) for at in taps(mesh, *far, 1)])
                spread = (wide @ LUMINANCE).std() / (wide @ LUMINANCE).mean()
                np.testing.assert_allclose(near[item, :, y, x], np.mean(close, axis=0), rtol=1e-5)
                np.testing.assert_allclose(around[item, :, y, x], wide.mean(axis=0), rtol=1e-5)
                assert deviation[item, 0, y, x].item() == pytest.approx(spread, abs=2e-3)


def test_light_without_limits_stays_finite() -> None:
    for level in (0.0, 1e-30, 65504.0, 1e35):
        for value in mesh_means(torch.full((1, 3, 4, 6), level), torch.ones(1, 1, 4, 6)):
            assert torch.isfinite(value).all()
