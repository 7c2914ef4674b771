"""Things, their parts and supports, and functions that their makers share."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh

from scenes.boxes import enclosing_box
from scenes.camera import Array
from scenes.draws import Rng
from scenes.meshes import Surface, join

SurfacesBySlot = dict[str, list[Surface]]


@dataclass(frozen=True)
class ThingPart:
    """One mesh of a thing, with texture coordinates and unit outward vertex normals.

    Its slot suggests a material: wood, front (doors, lids, panels), metal, stone, ceramic, glass, clear (smooth glass),
    mirror, wax, body (anything), fabric, cushion, blanket, shade, slat, leaf, stem, soil, paper, cover-1 to cover-3,
    frame, or print (uv in 0..1).
    """

    mesh: trimesh.Trimesh
    slot: str
    smooth: bool = False  # shade with the mesh's vertex normals


@dataclass(frozen=True)
class Support:
    """A horizontal rectangle for smaller things to stand on; metres."""

    low: tuple[float, float]  # x, z
    high: tuple[float, float]  # x, z
    height: float  # y
    clearance: float = math.inf  # free height above

    def at(self, x: float, y: float, z: float) -> "Support":
        low = (self.low[0] + x, self.low[1] + z)
        high = (self.high[0] + x, self.high[1] + z)
        return replace(self, low=low, high=high, height=self.height + y)


@dataclass(frozen=True)
class Thing:
    """An object in its rest pose, with one part for each slot, its lowest point at y = 0.

    Furniture and decor are centred on the y axis; what hangs is centred on x = 0.
    """

    name: str
    parts: tuple[ThingPart, ...]
    supports: tuple[Support, ...] = ()

    @property
    def bounds(self) -> Array:
        return enclosing_box(np.array([part.mesh.bounds for part in self.parts]))


Maker = Callable[[Rng], Thing]


def shifted(surfaces: SurfacesBySlot, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> SurfacesBySlot:
    return {slot: [surface.at(x, y, z) for surface in of_slot] for slot, of_slot in surfaces.items()}


def merged(*groups: SurfacesBySlot) -> SurfacesBySlot:
    surfaces: SurfacesBySlot = {}
    for group in groups:
        for slot, of_slot in group.items():
            surfaces[slot] = surfaces.get(slot, []) + of_slot
    return surfaces


def assembled(name: str, surfaces: SurfacesBySlot) -> Thing:
    """A thing of surfaces as they are, without empty slots."""
    joined = {slot: join(of_slot) for slot, of_slot in surfaces.items() if of_slot}
    return Thing(name, tuple(ThingPart(surface.mesh(), slot, surface.smooth) for slot, surface in joined.items()))


def standing(name: str, surfaces: SurfacesBySlot, supports: Sequence[Support] = ()) -> Thing:
    """A thing of surfaces and supports, translated to stand on y = 0, centred on the y axis."""
    points = np.concatenate([surface.points for of_slot in surfaces.values() for surface in of_slot])
    low, high = points.min(axis=0), points.max(axis=0)
    shift = (float(-(low[0] + high[0]) / 2), float(-low[1]), float(-(low[2] + high[2]) / 2))
    thing = assembled(name, shifted(surfaces, *shift))
    return replace(thing, supports=tuple(support.at(*shift) for support in supports))


def top_support(
    width: float, depth: float, height: float, clearance: float = math.inf, margin: float = 0.01
) -> Support:
    """The support on a board `width` x `depth` about the y axis with its top at `height`, less a `margin`."""
    x, z = width / 2 - margin, depth / 2 - margin
    return Support((-x, -z), (x, z), height, clearance)


def evenly(width: float, count: int) -> Array:
    """The centres (count,) of `count` equal intervals of -width / 2..width / 2."""
    return ((np.arange(count) + 0.5) / count - 0.5) * width
