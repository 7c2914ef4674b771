"""Windows of pixels, for slow versions of filters."""

from itertools import product

from numpy.typing import NDArray

Pixel = tuple[int, int]


def window(size: Pixel, p: Pixel, radius: int, step: int = 1) -> list[Pixel]:
    """The pixels around p, 2 radius + 1 by as many that are `step` apart, that are in an image of that size."""
    reach = range(-radius * step, radius * step + 1, step)
    rows, columns = ([c + d for d in reach if 0 <= c + d < length] for c, length in zip(p, size, strict=True))
    return list(product(rows, columns))


def mesh_window(mesh: NDArray, p: Pixel, radius: int, step: int = 1) -> list[Pixel]:
    """Those that show the same mesh as p; `mesh` (H, W)."""
    return [q for q in window(mesh.shape, p, radius, step) if mesh[q] == mesh[p]]
