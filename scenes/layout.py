"""Putting things into a room so that nothing touches: everything reserves the box it ever occupies."""

from dataclasses import dataclass, field

import numpy as np

from scenes.animation import Array, RigidMotion, Shape
from scenes.finish import Bsdf, finish
from scenes.meshes import Surface, join
from scenes.objects import DECOR, Support, Thing
from scenes.shell import Opening, pose, still, wall_pose

Rng = np.random.Generator
MOST_THINGS = 54  # leaves a few for what hangs
GAP = 0.002  # m, between things that stand on or beside each other


def box_of(bounds: Array, matrix: Array) -> Array:
    """The axis-aligned box (2, 3) around the box `bounds` (2, 3) moved by `matrix`."""
    corners = np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3)
    moved = corners @ matrix[:3, :3].T + matrix[:3, 3]
    return np.stack([moved.min(axis=0), moved.max(axis=0)])


def overlap(a: Array, boxes: Array) -> bool:
    """Whether box `a` (2, 3) meets any of `boxes` (N, 2, 3)."""
    return bool(((a[0] < boxes[:, 1]) & (a[1] > boxes[:, 0])).all(axis=1).any())


@dataclass(frozen=True)
class Group:
    """A thing and what stands on it, in the frame of that thing: they move together."""

    members: tuple[tuple[Thing, Array], ...]  # thing, its pose (4, 4) in the group

    @property
    def bounds(self) -> Array:
        boxes = np.stack([box_of(thing.bounds, matrix) for thing, matrix in self.members])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @staticmethod
    def of(thing: Thing) -> "Group":
        return Group(((thing, np.eye(4)),))


def scatter(rng: Rng, support: Support, most: int) -> list[tuple[Thing, Array]]:
    """Up to `most` small things on a support, apart from each other."""
    low, high = np.array(support.low), np.array(support.high)
    placed: list[tuple[Thing, Array]] = []
    taken = np.empty((0, 2, 3))
    makers = list(DECOR.values())
    for _ in range(2 * most):
        if len(placed) == most:
            break
        thing = makers[int(rng.integers(len(makers)))](rng)
        angle = rng.uniform(-np.pi, np.pi)
        size = box_of(thing.bounds, pose(0, 0, 0, angle))
        room_low, room_high = low - size[0, [0, 2]], high - size[1, [0, 2]]
        if (room_low >= room_high).any() or size[1, 1] + GAP >= support.clearance:
            continue
        x, z = rng.uniform(room_low, room_high)
        matrix = pose(x, support.height + GAP, z, angle)
        box = box_of(thing.bounds, matrix)
        if not overlap(box, taken):
            placed.append((thing, matrix))
            taken = np.concatenate([taken, box[None]])
    return placed


def laden(rng: Rng, thing: Thing, share: float = 0.8) -> Group:
    """The thing with small ones on its supports."""
    group = [(thing, np.eye(4))]
    for support in thing.supports:
        if rng.random() < share:
            group += scatter(rng, support, int(rng.integers(1, 6)))
    return Group(tuple(group))


@dataclass
class Layout:
    """What is in a room so far. The room spans x and z from -size / 2 to size / 2 and y from 0 to its height."""

    rng: Rng
    size: Array  # (3,) width, height, depth in metres
    frames: int
    gloss: float  # see scenes.finish
    shapes: list[Shape] = field(default_factory=list)
    boxes: Array = field(default_factory=lambda: np.empty((0, 2, 3)))  # taken
    centres: list[Array] = field(default_factory=list)  # of things, worth looking at
    moving: int = 0
    walls: int = 0  # the first boxes, those of walls inside the room
    openings: dict[int, list[Opening]] = field(default_factory=dict)  # of walls 0 to 3
    backs: list[tuple[RigidMotion, Array]] = field(default_factory=list)  # of furniture before walls: pose, bounds

    @property
    def things(self) -> int:
        return len(self.centres)

    def swept(self, bounds: Array, motion: RigidMotion) -> Array:
        """The box that `bounds` ever occupies during the clip."""
        times = range(self.frames) if motion.varies() else range(1)
        boxes = np.stack([box_of(bounds, motion.matrix(frame)) for frame in times])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    def fits(self, box: Array) -> bool:
        x, z = self.size[[0, 2]] / 2
        low, high = np.array([-x, 0, -z]), np.array([x, self.size[1], z])
        return bool((box[0] > low).all() and (box[1] < high).all()) and not overlap(box, self.boxes)

    def reserve(self, *boxes: Array) -> None:
        self.boxes = np.concatenate([self.boxes, np.stack(boxes)])

    def try_add(self, group: Group, motion: RigidMotion) -> bool:
        """Add the group where `motion` takes it, if nothing is in its way."""
        box = self.swept(group.bounds + np.array([[-GAP], [GAP]]) * [1, 0, 1], motion)
        if not self.fits(box) or self.things + len(group.members) > MOST_THINGS:
            return False
        self.add(group, motion)
        return True

    def add(self, group: Group, motion: RigidMotion) -> None:
        """Add the group without looking."""
        self.reserve(self.swept(group.bounds, motion))
        for thing, matrix in group.members:
            number, size = self.things, float(np.ptp(thing.bounds, axis=0).max())
            self.centres.append(box_of(thing.bounds, motion.matrix(0) @ matrix).mean(axis=0))
            for part in thing.parts:
                mesh = part.mesh.copy(include_cache=True)  # without it the authored normals are lost
                mesh.apply_transform(matrix)
                bsdf = finish(self.rng, part.slot, self.gloss, size)
                self.shapes.append(Shape(f"{number}-{thing.name}-{part.slot}", mesh, bsdf, None, motion, part.smooth))
        self.moving += motion.varies()

    def hang(self, thing: Thing, wall: int, x: float, y: float, z: float) -> None:
        """Put a thing on a wall, if nothing is in its way, at (x, y) seen from inside and `z` before it."""
        place = wall_pose(wall, self.size) @ [x, y, z, 1]
        motion, group = still(place[:3], wall * np.pi / 2), Group.of(thing)
        if not overlap(self.swept(group.bounds, motion), self.boxes):
            self.add(group, motion)

    def build(self, name: str, surfaces: list[Surface], matrix: Array, bsdf: Bsdf | None = None) -> None:
        """Add a fixed part of the building, given in the frame `matrix` (4, 4); painted like a wall by default."""
        surface = join(surfaces)
        mesh = surface.mesh()
        mesh.apply_transform(matrix)
        bsdf = bsdf or finish(self.rng, "wall", 0.0, 1.0)
        self.shapes.append(Shape(f"{name}-{len(self.shapes)}", mesh, bsdf, smooth=surface.smooth))
