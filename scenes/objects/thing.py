"""Things, and functions that their makers share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from scenes.boxes import bounding_box
from scenes.camera import Array
from scenes.colours import Bsdf
from scenes.draws import Rng
from scenes.meshes import Surface, join

SurfacesBySlot = dict[str, list[Surface]]


@dataclass(frozen=True)
class Thing:
    """An object in its rest pose, its lowest point at y = 0.

    Furniture and decor are centred on the y axis; what hangs is centred on x = 0. A slot suggests a material: wood,
    front (doors, lids, panels), metal, stone, ceramic, glass, clear (smooth glass), mirror, wax, body (anything),
    fabric, cushion, blanket, shade, slat, leaf, stem, soil, paper, cover-1 to cover-3, frame, or print (uv in 0..1).
    """

    name: str
    parts: dict[str, Surface]  # by slot
    supports: Sequence[Array] = ()  # boxes (2, 3) for smaller things to stand in, infinitely high if open above
    materials: Mapping[str, Bsdf] = field(default_factory=dict)  # by slot, where they are not drawn

    @property
    def bounds(self) -> Array:
        return bounding_box(np.concatenate([surface.points for surface in self.parts.values()]))


Maker = Callable[[Rng], Thing]


class Stock(NamedTuple):
    """What rooms are furnished with; each maker is drawn as often as the others of its kind."""

    floor: Sequence[Maker]
    small: Sequence[Maker]  # for supports and the floor
    backed: Sequence[Maker]  # against walls
    gloss: tuple[float, float]  # of rooms, see scenes.finish: drawn from this range; below 0 none


def shifted(surfaces: SurfacesBySlot, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> SurfacesBySlot:
    return {slot: [surface.at(x, y, z) for surface in of_slot] for slot, of_slot in surfaces.items()}


def assembled(name: str, *groups: SurfacesBySlot) -> Thing:
    """A thing of the surfaces of all groups as they are."""
    surfaces: SurfacesBySlot = {}
    for group in groups:
        for slot, of_slot in group.items():
            surfaces[slot] = surfaces.get(slot, []) + of_slot
    return Thing(name, {slot: join(of_slot) for slot, of_slot in surfaces.items()})


def standing(name: str, *groups: SurfacesBySlot, supports: Sequence[Array] = ()) -> Thing:
    """A thing of surfaces and supports, translated to stand on y = 0, centred on the y axis."""
    thing = assembled(name, *groups)
    low, high = thing.bounds
    shift = -np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    parts = {slot: surface.at(*shift) for slot, surface in thing.parts.items()}
    return Thing(name, parts, [support + shift for support in supports])


def top_support(width: float, depth: float, height: float, clearance: float = np.inf, margin: float = 0.01) -> Array:
    """The support on a board `width` x `depth` about the y axis with its top at `height`, less a `margin`."""
    x, z = width / 2 - margin, depth / 2 - margin
    return np.array([[-x, height, -z], [x, height + clearance, z]])


def evenly(width: float, count: int) -> Array:
    """The centres (count,) of `count` equal intervals of -width / 2..width / 2."""
    return ((np.arange(count) + 0.5) / count - 0.5) * width
