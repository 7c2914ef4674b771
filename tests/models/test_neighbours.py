"""models.neighbours against sums taken tap by tap, and the kernel against PyTorch."""

import pytest
import torch

from models import compiled
from models.neighbours import mesh_sums


@pytest.mark.parametrize(("height", "width", "step"), [(1, 1, 1), (4, 7, 1), (9, 5, 3), (20, 70, 3)])
def test_sums_are_over_the_own_mesh(height: int, width: int, step: int) -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(2, 3, height, width, generator=generator)
    mesh = torch.randint(0, 3, (2, 1, height, width), generator=generator).float()
    sums = mesh_sums(image, mesh, step)
    with compiled.disabled():
        torch.testing.assert_close(mesh_sums(image, mesh, step), sums)
    expected = torch.zeros_like(image)
    for y in range(height):
        for x in range(width):
            for to_y in (y - step, y, y + step):
                for to_x in (x - step, x, x + step):
                    if 0 <= to_y < height and 0 <= to_x < width:
                        same = mesh[:, :, y, x] == mesh[:, :, to_y, to_x]
                        expected[:, :, y, x] += torch.where(same, image[:, :, to_y, to_x], 0)
    torch.testing.assert_close(sums, expected)
