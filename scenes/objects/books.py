"""Books, lying and upright."""

import numpy as np

from scenes.draws import Rng
from scenes.meshes import Surface, join, slab
from scenes.objects.thing import SurfacesBySlot, Thing, merged, standing


def book(width: float, height: float, depth: float) -> tuple[Surface, Surface]:
    """A book lying on the origin, its spine towards -x: cover and pages."""
    board = 0.003
    boards = [slab(width, board, depth), slab(width, board, depth).at(0, height - board)]
    cover = join([*boards, slab(board, height, depth).at(board / 2 - width / 2)])
    return cover, slab(width - 0.008, height - 2 * board, depth - 0.01).at(0, board)


def make_books(rng: Rng) -> Thing:
    """A stack of lying books."""
    surfaces: SurfacesBySlot = {}
    level = 0.0
    for _ in range(rng.integers(2, 7)):
        width = rng.uniform(0.13, 0.22)
        height = rng.uniform(0.012, 0.045)
        depth = rng.uniform(0.18, 0.28)
        angle = rng.normal(0, 0.25)
        cover, pages = (part.turned(angle).at(0, level) for part in book(width, height, depth))
        surfaces = merged(surfaces, {f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        level += height
    return standing("books", surfaces)


def make_book_row(rng: Rng) -> Thing:
    """Books that stand side by side, spines to the front."""
    surfaces: SurfacesBySlot = {}
    x = 0.0
    for _ in range(rng.integers(4, 12)):
        width = rng.uniform(0.13, 0.18)
        height = rng.uniform(0.012, 0.045)
        depth = rng.uniform(0.18, 0.27)
        cover, pages = (
            part.at(width / 2).turned(np.pi / 2, axis=0).turned(np.pi / 2, axis=1).at(x, depth / 2)
            for part in book(width, height, depth)
        )
        surfaces = merged(surfaces, {f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        x += height
    return standing("book_row", surfaces)
