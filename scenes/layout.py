"""Placing things in a room without contact: everything reserves the box that it ever occupies."""

from dataclasses import dataclass, field

import numpy as np

from scenes.animation import RigidMotion, Shape, still
from scenes.boxes import enclosing_box, overlaps, transformed_box
from scenes.bsdf import Bsdf
from scenes.camera import Array
from scenes.draws import Rng, one_of
from scenes.finish import finish
from scenes.meshes import Surface, join
from scenes.objects.catalogue import DECOR
from scenes.objects.thing import Support, Thing
from scenes.shell import Opening, pose, wall_pose

MAX_THINGS = 54  # not counting what hangs
GAP = 0.002  # m, between neighbouring things


@dataclass(frozen=True)
class Group:
    """A thing and what stands on it, which move together."""

    members: tuple[tuple[Thing, Array], ...]  # thing, its pose (4, 4) in the group

    @property
    def bounds(self) -> Array:
        return enclosing_box(np.stack([transformed_box(thing.bounds, matrix) for thing, matrix in self.members]))

    @staticmethod
    def of(thing: Thing) -> "Group":
        return Group(((thing, np.eye(4)),))


def scatter(rng: Rng, support: Support, most: int) -> list[tuple[Thing, Array]]:
    """Up to `most` small things with their poses (4, 4) on a support, without overlap."""
    low, high = np.array(support.low), np.array(support.high)
    placed: list[tuple[Thing, Array]] = []
    taken = np.empty((0, 2, 3))
    makers = list(DECOR.values())
    for _ in range(2 * most):
        if len(placed) == most:
            break
        thing = one_of(rng, makers)(rng)
        angle = rng.uniform(-np.pi, np.pi)
        size = transformed_box(thing.bounds, pose(0, 0, 0, angle))
        room_low, room_high = low - size[0, [0, 2]], high - size[1, [0, 2]]
        if (room_low >= room_high).any() or size[1, 1] + GAP >= support.clearance:
            continue
        x, z = rng.uniform(room_low, room_high)
        matrix = pose(x, support.height + GAP, z, angle)
        box = transformed_box(thing.bounds, matrix)
        if not overlaps(box, taken):
            placed.append((thing, matrix))
            taken = np.concatenate([taken, box[None]])
    return placed


def laden(rng: Rng, thing: Thing) -> Group:
    """The thing with small ones on most of its supports."""
    members = [(thing, np.eye(4))]
    for support in thing.supports:
        if rng.random() < 0.8:
            members += scatter(rng, support, int(rng.integers(1, 6)))
    return Group(tuple(members))


@dataclass
class Layout:
    """The content of a room so far. The room spans x and z from -size / 2 to size / 2, y from 0 to its height."""

    rng: Rng
    size: Array  # (3,) width, height, depth in metres
    frames: int
    gloss: float  # see scenes.finish
    shapes: list[Shape] = field(default_factory=list)
    boxes: Array = field(default_factory=lambda: np.empty((0, 2, 3)))  # reserved
    centres: list[Array] = field(default_factory=list)  # (3,) of things
    moving: int = 0  # groups
    walls: int = 0  # inside the room; the first boxes are theirs
    openings: dict[int, list[Opening]] = field(default_factory=dict)  # of walls 0 to 3
    missing_walls: set[int] = field(default_factory=set)
    backs: list[tuple[RigidMotion, Array]] = field(default_factory=list)  # of furniture before walls: pose, bounds

    @property
    def things(self) -> int:
        return len(self.centres)

    @property
    def last_frame(self) -> int:
        """Where tracks end; at least 1, for clips of one frame."""
        return max(self.frames - 1, 1)

    def floor_position(self, margin: float) -> tuple[float, float]:
        """A random place (x, z) at least `margin` from the walls."""
        half = np.maximum(self.size[[0, 2]] / 2 - margin, 0.01)
        x, z = self.rng.uniform(-half, half)
        return float(x), float(z)

    def swept(self, bounds: Array, motion: RigidMotion) -> Array:
        """The bounding box (2, 3) of `bounds` (2, 3) during the whole clip."""
        frames = range(self.frames) if motion.varies() else range(1)
        return enclosing_box(np.stack([transformed_box(bounds, motion.matrix(frame)) for frame in frames]))

    def fits(self, box: Array) -> bool:
        """Whether `box` (2, 3) lies in the room and overlaps no reserved one."""
        x, z = self.size[[0, 2]] / 2
        low = np.array([-x, 0, -z])
        high = np.array([x, self.size[1], z])
        return bool((box[0] > low).all() and (box[1] < high).all()) and not overlaps(box, self.boxes)

    def reserve(self, *boxes: Array) -> None:
        """Keep later things out of these boxes (2, 3)."""
        self.boxes = np.concatenate([self.boxes, np.stack(boxes)])

    def try_add(self, group: Group, motion: RigidMotion) -> bool:
        box = self.swept(group.bounds + np.array([[-GAP], [GAP]]) * [1, 0, 1], motion)
        if not self.fits(box) or self.things + len(group.members) > MAX_THINGS:
            return False
        self.add(group, motion)
        return True

    def add(self, group: Group, motion: RigidMotion) -> None:
        self.reserve(self.swept(group.bounds, motion))
        for thing, matrix in group.members:
            number = self.things
            size = float(np.ptp(thing.bounds, axis=0).max())
            self.centres.append(transformed_box(thing.bounds, motion.matrix(0) @ matrix).mean(axis=0))
            for part in thing.parts:
                mesh = part.mesh.copy(include_cache=True)  # without it the authored normals are lost
                mesh.apply_transform(matrix)
                bsdf = finish(self.rng, part.slot, self.gloss, size)
                self.shapes.append(Shape(f"{number}-{thing.name}-{part.slot}", mesh, bsdf, None, motion, part.smooth))
        self.moving += motion.varies()

    def hang(self, thing: Thing, wall: int, x: float, y: float, z: float) -> None:
        """Add a thing to a wall if it fits, at (x, y) as visible from inside and `z` in front of it."""
        motion = still((wall_pose(wall, self.size) @ [x, y, z, 1])[:3], wall * np.pi / 2)
        group = Group.of(thing)
        if not overlaps(self.swept(group.bounds, motion), self.boxes):
            self.add(group, motion)

    def build(self, name: str, surfaces: list[Surface], matrix: Array, bsdf: Bsdf | None = None) -> None:
        """Add a part of the building, transformed by `matrix` (4, 4); of a wall's material by default."""
        surface = join(surfaces)
        mesh = surface.mesh()
        mesh.apply_transform(matrix)
        bsdf = bsdf or finish(self.rng, "wall", 0.0, 1.0)
        self.shapes.append(Shape(f"{name}-{len(self.shapes)}", mesh, bsdf, smooth=surface.smooth))
