"""Furniture, decor and pictures for a room, at rest or moving."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from scenes.animation import RigidMotion, Track, still
from scenes.boxes import overlaps, transformed_box
from scenes.camera import Array
from scenes.draws import Rng, one_of
from scenes.layout import GAP, Group, Layout, bounds_of, pose
from scenes.objects.decor import BODIES, VESSELS, make_basket
from scenes.objects.fittings import make_floor_lamp, make_glazed_mirror, make_photo, make_picture
from scenes.objects.furniture import CASES, make_column, make_pane, make_screen, make_showcase, make_table
from scenes.objects.library import makers_of, open_libraries
from scenes.objects.plants import make_floor_plant, make_small_plant
from scenes.objects.seating import SEATS, UPHOLSTERED, make_bench, make_chair
from scenes.objects.thing import Maker, Stock, Thing

# Rooms draw from these in this order.
FURNITURE: tuple[Maker, ...] = (
    make_table,
    *SEATS,
    *UPHOLSTERED,
    *CASES,
    make_screen,
    make_floor_plant,
    make_floor_lamp,
    make_column,
)
DECOR: tuple[Maker, ...] = (*VESSELS, *BODIES, make_small_plant, make_basket, make_photo)
GLAZING: tuple[Maker, ...] = (make_showcase, make_pane)
AGAINST_WALLS: tuple[Maker, ...] = (*UPHOLSTERED, *CASES, make_bench, make_screen)
OWN_STOCK = Stock(FURNITURE, DECOR, AGAINST_WALLS, gloss=(-0.3, 0.5))
FURNISHED_GLOSS = (0.2, 1.0)  # as in other people's scenes (docs/experiments.md)
MODELS_TO_OWN = 2  # pieces of libraries for each of ours
MIN_THINGS = 15


@cache
def stock_of(models: Path | None) -> Stock:
    """Our own things, and mostly pieces of the furniture libraries in the folder `models`, if there is one.

    Raises BadInput where it has no libraries or none that can furnish rooms.
    """
    if models is None:
        return OWN_STOCK
    found = makers_of(open_libraries(models))
    floor, small, backed = (
        (*own, *[maker] * MODELS_TO_OWN * len(own)) for own, maker in zip(OWN_STOCK[:3], found, strict=True)
    )
    return Stock(floor, small, backed, FURNISHED_GLOSS)


def scatter(rng: Rng, small: Sequence[Maker], support: Array, most: int) -> Group:
    """Up to `most` small things with their poses on a support (2, 3), without overlap."""
    low, high = support[:, [0, 2]]
    level = support[0, 1] + GAP
    placed: Group = []
    taken = np.empty((0, 2, 3))
    for _ in range(2 * most):
        if len(placed) == most:
            break
        thing = one_of(rng, small)(rng)
        angle = rng.uniform(-np.pi, np.pi)
        size = transformed_box(thing.bounds, pose(0, 0, 0, angle))
        room_low, room_high = low - size[0, [0, 2]], high - size[1, [0, 2]]
        if (room_low >= room_high).any() or level + size[1, 1] >= support[1, 1]:
            continue
        x, z = rng.uniform(room_low, room_high)
        matrix = pose(x, level, z, angle)
        box = transformed_box(thing.bounds, matrix)
        if not overlaps(box, taken):
            placed.append((thing, matrix))
            taken = np.concatenate([taken, box[None]])
    return placed


def laden(layout: Layout, thing: Thing) -> Group:
    """The thing with small ones on most of its supports."""
    rng = layout.rng
    group = [(thing, np.eye(4))]
    for support in thing.supports:
        if rng.random() < 0.8:
            group += scatter(rng, layout.stock.small, support, int(rng.integers(1, 6)))
    return group


def against_walls(layout: Layout, count: int) -> None:
    """Add up to `count` pieces of furniture with their backs to a wall."""
    rng = layout.rng
    backed = layout.stock.backed
    for chosen in rng.integers(len(backed), size=count):
        group = laden(layout, backed[chosen](rng))
        bounds = bounds_of(group)
        for _ in range(8):
            wall = int(rng.integers(4))
            free = layout.wall_width(wall) / 2 - bounds[1, 0]
            if free <= 0:
                continue
            place = [rng.uniform(-free, free), GAP, rng.uniform(0.03, 0.12) - bounds[0, 2], 1]
            motion = still((layout.wall_pose(wall) @ place)[:3], wall * np.pi / 2)
            if layout.try_add(group, motion):
                layout.backs.append((motion, bounds))
                break


def random_motion(layout: Layout, start: Array) -> RigidMotion:
    """A slow rotation, a slide or hops from the place `start` (3,) on the floor."""
    rng = layout.rng
    last = layout.last_frame
    angle = rng.uniform(-np.pi, np.pi)
    turn = rng.uniform(0.01, 0.06) * layout.frames
    slide = rng.uniform(0.005, 0.03) * layout.frames
    kind = rng.integers(3)
    if kind == 0:
        return RigidMotion(Track.constant(start), Track(np.array([angle, angle + turn * rng.choice([-1, 1])]), 0, last))
    heading = rng.uniform(-np.pi, np.pi)
    end = start + min(slide, 1.5) * np.array([np.cos(heading), 0, np.sin(heading)])
    if kind == 1:
        return RigidMotion(Track(np.stack([start, end]), 0, last), Track(np.array([angle, angle + turn / 2]), 0, last))
    up = np.array([0, rng.uniform(0.1, 0.5), 0])
    keys = np.stack([start, (start + end) / 2 + up, end, (start + end) / 2 + up, start])
    return RigidMotion(Track(np.maximum(keys, [-np.inf, GAP, -np.inf]), 0, 2 * last), Track.constant(angle))


def movers(layout: Layout, count: int) -> None:
    for _ in range(12 * count):
        if count > 0:
            maker = one_of(layout.rng, (*layout.stock.floor, *layout.stock.small))
            group = laden(layout, maker(layout.rng))
            count -= layout.try_add(group, random_motion(layout, layout.floor_position(0.2)))


def scattered(layout: Layout, makers: Sequence[Maker], count: int) -> None:
    """Add up to `count` things anywhere on the floor."""
    rng = layout.rng
    for _ in range(count):
        group = laden(layout, one_of(rng, makers)(rng))
        for _ in range(4):
            if layout.try_add(group, still(layout.floor_position(0.15), rng.uniform(-np.pi, np.pi))):
                break


def dining(layout: Layout) -> None:
    rng = layout.rng
    group = laden(layout, make_table(rng))
    if not layout.try_add(group, still(layout.floor_position(1.0), rng.choice([0, np.pi / 2]))):
        return
    low, high = layout.boxes[-1]
    chair = make_chair(rng)
    for side in rng.permutation(4)[: rng.integers(1, 5)]:
        outward = np.array([np.sin(side * np.pi / 2), 0, np.cos(side * np.pi / 2)])
        reach = (high - low) / 2 + chair.bounds[1, 2] + rng.uniform(0.03, 0.25)
        place = np.array([(low[0] + high[0]) / 2, GAP, (low[2] + high[2]) / 2]) + outward * reach
        layout.try_add([(chair, np.eye(4))], still(place, side * np.pi / 2 + np.pi))


def hang_on_walls(layout: Layout, maker: Maker, count: int) -> None:
    """Add up to `count` pictures, or other things to hang, to walls without openings."""
    rng = layout.rng
    for _ in range(count):
        wall = int(rng.integers(4))
        picture = maker(rng)
        half = layout.wall_width(wall) / 2 + picture.bounds[0, 0]
        top = layout.size[1] - picture.bounds[1, 1] - 0.1
        if half > 0 and top > 0.8 and wall not in layout.openings:
            layout.hang(picture, wall, rng.uniform(-half, half), rng.uniform(0.8, top), 0.004)


def furnish(layout: Layout) -> None:
    rng = layout.rng
    if rng.random() < 0.5:
        movers(layout, int(rng.integers(2, 5)))
    if rng.random() < 0.6:
        dining(layout)
    scattered(layout, layout.stock.floor, int(rng.integers(2, 8)))
    hang_on_walls(layout, make_picture, int(rng.integers(0, 6)))
    scattered(layout, layout.stock.small, int(rng.integers(0, 8)))
    while len(layout.centres) < MIN_THINGS:
        scattered(layout, layout.stock.small, MIN_THINGS - len(layout.centres))
    # Clear glass in a third of the rooms, by draws of its own: the others are as they were without it.
    (layout.rng,) = rng.spawn(1)
    if layout.rng.random() < 1 / 3:
        scattered(layout, GLAZING, int(layout.rng.integers(1, 4)))
        hang_on_walls(layout, make_glazed_mirror, int(layout.rng.integers(0, 3)))
    layout.rng = rng
