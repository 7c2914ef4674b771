"""Small things that stand on furniture and floors: books, plain bodies, tableware and candles."""

import numpy as np
from numpy.typing import ArrayLike

from scenes.draws import Rng, one_of, uniforms
from scenes.meshes import Surface, blob, circle, gem, hollow, join, lathe, silhouette, slab, solid, superellipsoid, tube
from scenes.objects.thing import SurfacesBySlot, Thing, evenly, standing


def book(width: float, height: float, depth: float) -> tuple[Surface, Surface]:
    """Cover and pages of a book lying on the origin, its spine towards -x."""
    board = 0.003
    boards = [slab(width, board, depth), slab(width, board, depth).at(0, height - board)]
    cover = join([*boards, slab(board, height, depth).at(board / 2 - width / 2)])
    return cover, slab(width - 0.008, height - 2 * board, depth - 0.01).at(0, board)


def make_books(rng: Rng) -> Thing:
    volumes: list[SurfacesBySlot] = []
    level = 0.0
    for _ in range(rng.integers(2, 7)):
        width, height, depth = uniforms(rng, (0.13, 0.22), (0.012, 0.045), (0.18, 0.28))
        angle = rng.normal(0, 0.25)
        cover, pages = (part.turned(angle).at(0, level) for part in book(width, height, depth))
        volumes.append({f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        level += height
    return standing("books", *volumes)


def make_book_row(rng: Rng) -> Thing:
    """A row of upright books, spines to the front."""
    volumes: list[SurfacesBySlot] = []
    x = 0.0
    for _ in range(rng.integers(4, 12)):
        width, height, depth = uniforms(rng, (0.13, 0.18), (0.012, 0.045), (0.18, 0.27))
        lying = (part.at(width / 2) for part in book(width, height, depth))
        upright = (part.turned(np.pi / 2, axis=0).turned(np.pi / 2, axis=1) for part in lying)
        cover, pages = (part.at(x, depth / 2) for part in upright)
        volumes.append({f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        x += height
    return standing("book_row", *volumes)


def make_box(rng: Rng) -> Thing:
    """A chest with a lid, or a bare block."""
    width, height, depth = uniforms(rng, (0.06, 0.35), (0.05, 0.3), (0.06, 0.3))
    body = slab(width, height, depth)
    if rng.random() < 0.5:
        return standing("box", {"body": [body]})
    lid = slab(width + 0.008, height * rng.uniform(0.1, 0.3), depth + 0.008).at(0, height)
    return standing("box", {"body": [body], "front": [lid]})


def make_ball(rng: Rng) -> Thing:
    size = rng.uniform(0.06, 0.3)
    return standing("ball", {"body": [superellipsoid(size, size, size, 2, 3)]})


def make_ring(rng: Rng) -> Thing:
    radius = rng.uniform(0.04, 0.15)
    torus = lathe(circle(radius, radius * rng.uniform(0.1, 0.45), 16), 48)
    return standing("ring", {"body": [torus.turned(np.pi / 2 * rng.integers(2), axis=0)]})


def make_lump(rng: Rng) -> Thing:
    subdivisions = int(rng.integers(3, 5))
    return standing("lump", {"body": [blob(rng, rng.uniform(0.05, 0.16), rng.uniform(0.05, 0.3), subdivisions)]})


def make_crystal(rng: Rng) -> Thing:
    return standing("crystal", {"body": [gem(rng, rng.uniform(0.04, 0.16), int(rng.integers(2)))]})


def vessel(rng: Rng, name: str, radii: ArrayLike, radius: float, height: float, slots: tuple[str, ...]) -> Thing:
    """A hollow body of revolution with the side `radii` * `radius`, of one of the `slots`."""
    wall = radius * rng.uniform(0.04, 0.1)
    outer = silhouette(np.asarray(radii) * radius, height, 24)
    return standing(name, {one_of(rng, slots): [lathe(hollow(outer, wall, 2 * wall), 40)]})


def make_vase(rng: Rng) -> Thing:
    radii = rng.uniform(0.35, 1.0, 5)
    radius, height = uniforms(rng, (0.05, 0.13), (0.12, 0.42))
    return vessel(rng, "vase", radii, radius, height, ("ceramic", "glass", "metal"))


def make_bowl(rng: Rng) -> Thing:
    radii = np.linspace(rng.uniform(0.05, 0.2), 1, 6) ** rng.uniform(0.3, 0.7)
    radius, height = uniforms(rng, (0.07, 0.2), (0.05, 0.12))
    return vessel(rng, "bowl", radii, radius, height, ("ceramic", "wood", "metal", "glass"))


def make_bottle(rng: Rng) -> Thing:
    neck, shoulder = uniforms(rng, (0.28, 0.45), (0.85, 1.0))
    radii = (0.95, 1, 1, shoulder, neck, neck, neck * 1.1)
    radius, height = uniforms(rng, (0.03, 0.06), (0.18, 0.34))
    return vessel(rng, "bottle", radii, radius, height, ("glass", "glass", "ceramic"))


def make_cup(rng: Rng) -> Thing:
    """A cup with a handle, with or without a saucer."""
    radius, height = uniforms(rng, (0.035, 0.05), (0.06, 0.11))
    outer = silhouette(radius * np.array([0.8, 0.95, 1, rng.uniform(0.9, 1.1)]), height, 12)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 10)
    out = np.cos(angle) * height * 0.3 + radius * 0.92
    up = height * (0.5 + 0.3 * np.sin(angle))
    handle = tube(np.stack([out, up, 0 * angle], axis=1), height * 0.05)
    surfaces = [lathe(hollow(outer, 0.004, 0.006), 32).at(0, 0.004), handle.at(0, 0.004)]
    if rng.random() < 0.5:
        surfaces.append(lathe(hollow(silhouette(radius * np.array([0.9, 1.5, 1.8]), 0.015, 8), 0.004, 0.004), 32))
    return standing("cup", {"ceramic": surfaces})


def make_glass(rng: Rng) -> Thing:
    """A tumbler or a goblet: one thin-walled closed surface."""
    radius = rng.uniform(0.03, 0.045)
    if rng.random() < 0.5:
        height = rng.uniform(0.08, 0.15)
        outer = silhouette([radius * rng.uniform(0.75, 1.0), radius, radius], height, 10)
        base = 0.008
    else:
        height, bulge, mouth = uniforms(rng, (0.14, 0.22), (0.9, 1.1), (0.75, 1.0))
        outer = silhouette(radius * np.array([0.85, 0.1, 0.1, 0.12, 0.9 * bulge, bulge, mouth]), height, 36)
        base = height * 0.53
    return standing("glass", {"glass": [lathe(hollow(outer, 0.0015, base), 40)]})


def make_basket(rng: Rng) -> Thing:
    radius, height, wire = uniforms(rng, (0.07, 0.16), (0.08, 0.25), (0.0015, 0.0035))
    outer = silhouette(radius * np.array([rng.uniform(0.6, 0.95), rng.uniform(0.8, 1.1), 1]), height, 7)
    hoops = [lathe(circle(r, wire, 5), 28).at(0, y) for r, y in outer]
    side = np.concatenate([[(0, 0)], outer])
    upright = tube(np.stack([side[:, 0], side[:, 1], np.zeros(len(side))], axis=1), wire, 4)
    return standing("basket", {"metal": hoops + [upright.turned(angle) for angle in evenly(2 * np.pi, 20)]})


def make_candle(rng: Rng) -> Thing:
    height, radius, wax = uniforms(rng, (0.05, 0.28), (0.04, 0.07), (0.008, 0.02))
    holder = silhouette(radius * np.array([1, *rng.uniform(0.2, 0.6, 4), 0.8]), height, 24)
    stick = lathe(solid([(wax, 0), (wax * 0.95, rng.uniform(0.06, 0.18))]), 20).at(0, height)
    return standing("candle", {one_of(rng, ("metal", "ceramic", "wood")): [lathe(solid(holder))], "wax": [stick]})


VESSELS = (make_vase, make_bowl, make_bottle, make_cup, make_glass)
BODIES = (make_books, make_book_row, make_box, make_ball, make_ring, make_lump, make_crystal, make_candle)
