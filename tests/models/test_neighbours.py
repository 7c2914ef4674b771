"""Statistics over the pixels of the same mesh, against slow versions in float64."""

import numpy as np
import pytest
import torch

from models.filters.neighbours import mesh_means, mesh_min, mesh_sums

pytestmark = pytest.mark.usefixtures("implementation")
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def taps(mesh: np.ndarray, y: int, x: int, step: int) -> list[tuple[int, int]]:
    """Those of the 3 x 3 taps that are in the image and on the same mesh."""
    height, width = mesh.shape
    places = [(y + dy, x + dx) for dy in (-step, 0, step) for dx in (-step, 0, step)]
    return [(j, i) for j, i in places if 0 <= j < height and 0 <= i < width and mesh[j, i] == mesh[y, x]]


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 9), (9, 5), (7, 40)])
def test_means_are_over_the_same_mesh(height: int, width: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, height, width, generator=generator)
    mesh_id = torch.randint(0, 3, (2, 1, height, width), generator=generator).float()
    mean_3x3, mean_9x9, deviation = mesh_means(image, mesh_id)
    for item in range(2):
        pixels = image[item].permute(1, 2, 0).numpy().astype(float)
        mesh = mesh_id[item, 0].numpy()
        for y in range(height):
            for x in range(width):
                close = [pixels[at] for at in taps(mesh, y, x, 1)]
                wide = np.array([pixels[at] for far in taps(mesh, y, x, 3) for at in taps(mesh, *far, 1)])
                spread = (wide @ LUMINANCE).std() / (wide @ LUMINANCE).mean()
                np.testing.assert_allclose(mean_3x3[item, :, y, x], np.mean(close, axis=0), rtol=1e-5)
                np.testing.assert_allclose(mean_9x9[item, :, y, x], wide.mean(axis=0), rtol=1e-5)
                assert deviation[item, 0, y, x].item() == pytest.approx(spread, abs=2e-3)


@pytest.mark.parametrize("step", [1, 3, 20])
def test_sums_are_over_the_same_mesh(step: int) -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 5, 13, 17, generator=generator)
    mesh_id = torch.randint(0, 3, (1, 1, 13, 17), generator=generator).float()
    sums = mesh_sums(image, mesh_id, step)
    for y, x in np.ndindex(13, 17):
        expected = sum(image[0, :, *at] for at in taps(mesh_id[0, 0].numpy(), y, x, step))
        torch.testing.assert_close(sums[0, :, y, x], expected)


def test_the_minimum_of_a_single_pixel_is_its_value() -> None:
    assert mesh_min(torch.full((1, 1, 1, 1), 3.0), torch.zeros(1, 1, 1, 1)).item() == 3


def test_light_without_limits_stays_finite() -> None:
    for level in (0.0, 1e-30, 65504.0, 1e35):
        for value in mesh_means(torch.full((1, 3, 4, 6), level), torch.ones(1, 1, 4, 6)):
            assert torch.isfinite(value).all()
