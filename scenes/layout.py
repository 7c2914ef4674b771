"""Placing things in a room without contact: everything reserves the box that it ever occupies."""

from dataclasses import dataclass, field

import numpy as np

from scenes.animation import RigidMotion, Shape, still
from scenes.boxes import bounding_box, overlaps, transformed_box
from scenes.camera import Array
from scenes.colours import Bsdf
from scenes.draws import Rng
from scenes.finish import finish
from scenes.meshes import Surface
from scenes.objects.thing import Stock, Thing

MAX_THINGS = 54  # not counting what hangs
GAP = 0.002  # m, between neighbouring things


def pose(x: float, y: float, z: float, angle: float) -> Array:
    """object_to_world (4, 4) at (x, y, z), rotated by `angle` radians about the vertical axis."""
    return still((x, y, z), angle).matrix(0)


# A thing and what stands on it, which move together, with their poses (4, 4) relative to the thing's.
Group = list[tuple[Thing, Array]]


def bounds_of(group: Group) -> Array:
    return bounding_box(np.stack([transformed_box(thing.bounds, matrix) for thing, matrix in group]))


@dataclass
class Layout:
    """The content of a room so far. The room spans x and z from -size / 2 to size / 2, y from 0 to its height."""

    rng: Rng
    size: Array  # (3,) width, height, depth in metres
    frames: int
    gloss: float  # see scenes.finish
    stock: Stock
    shapes: list[Shape] = field(default_factory=list)
    boxes: Array = field(default_factory=lambda: np.empty((0, 2, 3)))  # reserved
    centres: list[Array] = field(default_factory=list)  # (3,) of things
    walls: int = 0  # inside the room; the first boxes are theirs
    # Holes in walls 0 to 3: boxes (2, 2) of x, as seen from inside to the right of the wall's middle, and y, up.
    openings: dict[int, list[Array]] = field(default_factory=dict)
    missing_walls: set[int] = field(default_factory=set)
    backs: list[tuple[RigidMotion, Array]] = field(default_factory=list)  # of furniture before walls: pose, bounds

    @property
    def last_frame(self) -> int:
        """Where tracks end; at least 1, for clips of one frame."""
        return max(self.frames - 1, 1)

    def wall_pose(self, wall: int) -> Array:
        """Pose (4, 4) of wall 0 to 3: x along the wall, y up from the floor, z into the room."""
        distance = self.size[0 if wall % 2 else 2] / 2
        return pose(0, 0, 0, wall * np.pi / 2) @ pose(0, 0, -distance, 0)

    def wall_width(self, wall: int) -> float:
        return float(self.size[2 if wall % 2 else 0])

    def floor_position(self, margin: float) -> Array:
        """A random place (3,) on the floor, at least `margin` from the walls."""
        half = np.maximum(self.size[[0, 2]] / 2 - margin, 0.01)
        return np.insert(self.rng.uniform(-half, half), 1, GAP)

    def swept(self, bounds: Array, motion: RigidMotion) -> Array:
        """The bounding box (2, 3) of `bounds` (2, 3) during the whole clip."""
        frames = range(self.frames) if motion.varies() else range(1)
        return bounding_box(np.stack([transformed_box(bounds, motion.matrix(frame)) for frame in frames]))

    def fits(self, box: Array) -> bool:
        """Whether `box` (2, 3) lies in the room and overlaps no reserved one."""
        x, z = self.size[[0, 2]] / 2
        low = np.array([-x, 0, -z])
        high = np.array([x, self.size[1], z])
        return bool((box[0] > low).all() and (box[1] < high).all()) and not overlaps(box, self.boxes)

    def reserve(self, *boxes: Array) -> None:
        """Keep later things out of these boxes (2, 3)."""
        self.boxes = np.concatenate([self.boxes, np.stack(boxes)])

    def claim(self, box: Array) -> bool:
        """Reserve `box` (2, 3) if it fits; whether it did."""
        fits = self.fits(box)
        if fits:
            self.reserve(box)
        return fits

    def try_add(self, group: Group, motion: RigidMotion) -> bool:
        """Add a group if it fits, with gaps beside it; whether it did."""
        box = self.swept(bounds_of(group) + np.array([[-GAP], [GAP]]) * [1, 0, 1], motion)
        fits = self.fits(box) and len(self.centres) + len(group) <= MAX_THINGS
        if fits:
            self.add(group, motion)
        return fits

    def add(self, group: Group, motion: RigidMotion) -> None:
        self.reserve(self.swept(bounds_of(group), motion))
        for thing, matrix in group:
            name = f"{len(self.centres)}-{thing.name}"
            size = float(np.ptp(thing.bounds, axis=0).max())
            self.centres.append(transformed_box(thing.bounds, motion.matrix(0) @ matrix).mean(axis=0))
            for slot, surface in thing.parts.items():
                bsdf = thing.materials.get(slot) or finish(self.rng, slot, self.gloss, size)
                self.shapes.append(Shape(f"{name}-{slot}", surface.mesh(matrix), bsdf, None, motion, surface.smooth))

    def hang(self, thing: Thing, wall: int, x: float, y: float, z: float) -> None:
        """Add a thing to a wall if it fits, at (x, y) as visible from inside and `z` in front of it."""
        motion = still((self.wall_pose(wall) @ [x, y, z, 1])[:3], wall * np.pi / 2)
        if not overlaps(transformed_box(thing.bounds, motion.matrix(0)), self.boxes):
            self.add([(thing, np.eye(4))], motion)

    def build(self, name: str, surface: Surface, *poses: Array, bsdf: Bsdf | None = None) -> None:
        """Add a part of the building, transformed by `poses` (4, 4); of a wall's material by default."""
        bsdf = bsdf or finish(self.rng, "wall", 0.0, 1.0)
        self.shapes.append(Shape(f"{name}-{len(self.shapes)}", surface.mesh(*poses), bsdf, smooth=surface.smooth))
