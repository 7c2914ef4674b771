"""Statistics over the pixels of the same mesh, against slow versions in float64."""

import numpy as np
import pytest
import torch

from models.filters.neighbours import mesh_means, mesh_min, mesh_sums, mesh_variance
from tests.helpers.windows import mesh_window

pytestmark = pytest.mark.usefixtures("implementation")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 9), (9, 5), (7, 40)])
def test_means_and_variances_are_over_the_same_mesh(height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, height, width, generator=generator)
    mesh_id = torch.randint(0, 3, (2, 1, height, width), generator=generator).float()
    mean_3x3, mean_9x9, deviation = mesh_means(image, mesh_id)
    variance = mesh_variance(image, mesh_id)
    for item in range(2):
        pixels = image[item].permute(1, 2, 0).numpy().astype(float)
        mesh = mesh_id[item, 0].numpy()
        for p in np.ndindex(height, width):
            close = [pixels[q] for q in mesh_window(mesh, p, 1)]
            wide = np.array([pixels[q] for far in mesh_window(mesh, p, 1, 3) for q in mesh_window(mesh, far, 1)])
            spread = (wide @ LUMINANCE).std() / (wide @ LUMINANCE).mean()
            np.testing.assert_allclose(mean_3x3[item, :, *p], np.mean(close, axis=0), rtol=1e-5)
            np.testing.assert_allclose(mean_9x9[item, :, *p], wide.mean(axis=0), rtol=1e-5)
            np.testing.assert_allclose(variance[item, :, *p], wide.var(axis=0), rtol=1e-4, atol=1e-6)
            assert deviation[item, 0, *p].item() == pytest.approx(spread, abs=2e-3)


@pytest.mark.parametrize("step", [1, 3, 20])
def test_sums_are_over_the_same_mesh(step: int) -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 5, 13, 17, generator=generator)
    mesh_id = torch.randint(0, 3, (1, 1, 13, 17), generator=generator).float()
    sums = mesh_sums(image, mesh_id, step)
    for p in np.ndindex(13, 17):
        expected = sum(image[0, :, *q] for q in mesh_window(mesh_id[0, 0].numpy(), p, 1, step))
        torch.testing.assert_close(sums[0, :, *p], expected)


def test_the_minimum_of_a_single_pixel_is_its_value() -> None:
    assert mesh_min(torch.full((1, 1, 1, 1), 3.0), torch.zeros(1, 1, 1, 1)).item() == 3


def test_pixels_alone_on_their_mesh_deviate_by_nothing() -> None:
    """Not by the rounding of a square, whose root is 1000 times as large."""
    image = torch.rand(1, 3, 8, 64, generator=torch.Generator().manual_seed(0))
    *_, deviation = mesh_means(image, torch.arange(8.0 * 64).view(1, 1, 8, 64))
    assert (deviation == 0).all()


def test_light_without_limits_stays_finite() -> None:
    for level in (0.0, 1e-30, 65504.0, 1e35):
        for value in mesh_means(torch.full((1, 3, 4, 6), level), torch.ones(1, 1, 4, 6)):
            assert torch.isfinite(value).all()
