"""Surfaces to build objects from: boxes, superellipsoids, lathes, tubes, sheets, blobs. Metres, y up; uv in metres."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from scenes.animation import Track
from scenes.camera import Y_UP, Array, axis_rotation, cross, unit
from scenes.draws import Rng

Faces = NDArray[np.int64]

CREASE = np.cos(np.radians(40))  # profiles that bend more than this keep a sharp edge


@dataclass(frozen=True)
class Surface:
    """Triangles, counter-clockwise from outside, with a normal and texture coordinates at every vertex."""

    points: Array  # (V, 3)
    normals: Array  # (V, 3), unit length, outward
    uv: Array  # (V, 2)
    faces: Faces  # (F, 3)
    smooth: bool  # shade with the interpolated normals

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> "Surface":
        return replace(self, points=self.points + np.array([x, y, z]))

    def turned(self, angle: float, axis: int = 1) -> "Surface":
        """Rotated by `angle` radians about the x, y or z axis (`axis` 0, 1, 2)."""
        matrix = axis_rotation(axis, angle)
        return replace(self, points=self.points @ matrix.T, normals=self.normals @ matrix.T)

    def mesh(self, *poses: Array) -> trimesh.Trimesh:
        """As a mesh, transformed by each of the `poses` (4, 4) in turn."""
        visual = trimesh.visual.TextureVisuals(uv=self.uv)
        mesh = trimesh.Trimesh(self.points, self.faces, vertex_normals=self.normals, visual=visual, process=False)
        for pose in poses:
            mesh.apply_transform(pose)
        return mesh


def join(surfaces: Sequence[Surface]) -> Surface:
    """All triangles as one surface, smooth if any is (flat ones stay flat: their facets share no vertices)."""
    starts = np.cumsum([0] + [len(surface.points) for surface in surfaces])
    return Surface(
        np.concatenate([surface.points for surface in surfaces]),
        np.concatenate([surface.normals for surface in surfaces]),
        np.concatenate([surface.uv for surface in surfaces]),
        np.concatenate([surface.faces + start for surface, start in zip(surfaces, starts, strict=False)]),
        any(surface.smooth for surface in surfaces),
    )


def area_vectors(points: Array, faces: Faces) -> Array:
    """Normals (F, 3) of the triangles, as long as twice their areas."""
    a, b, c = (points[corner] for corner in faces.T)
    return cross(b - a, c - a)


def arc_lengths(path: Array) -> Array:
    """The length (N,) of a `path` (N, D) up to each of its points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])


def full_turn(segments: int) -> Array:
    """Angles (segments + 1,) around a circle; the last is the first, bit for bit."""
    return np.asarray(2 * np.pi / segments * (np.arange(segments + 1) % segments))


def mean_normals(points: Array, faces: Faces) -> Array:
    """Unit normals (V, 3): means of the adjacent triangles' normals, weighted by area."""
    areas = np.repeat(area_vectors(points, faces), 3, axis=0)
    return unit(np.stack([np.bincount(faces.ravel(), areas[:, k], len(points)) for k in range(3)], axis=1))


def box_mapped(points: Array, normals: Array, faces: Faces, smooth: bool) -> Surface:
    """Box mapping: every triangle is projected along the axis that it mostly faces."""
    axis = np.abs(area_vectors(points, faces)).argmax(axis=1)
    keys, corners = np.unique(3 * faces + axis[:, None], return_inverse=True)
    vertex = keys // 3
    uv = np.take_along_axis(points[vertex], np.array([[2, 1], [0, 2], [0, 1]])[keys % 3], axis=1)
    return Surface(points[vertex], normals[vertex], uv, corners.reshape(-1, 3), smooth)


def flat_shaded(points: Array, faces: Faces) -> Surface:
    normals = np.repeat(unit(area_vectors(points, faces)), 3, axis=0)
    return box_mapped(points[faces].reshape(-1, 3), normals, np.arange(faces.size).reshape(-1, 3), False)


@cache
def unit_box(subdivisions: int) -> tuple[Array, Faces]:
    """Points (V, 3) and the 12 * 4^subdivisions triangles of the cube -1..1."""
    box = trimesh.creation.box((2, 2, 2))
    for _ in range(subdivisions):
        box = box.subdivide()
    return np.array(box.vertices), np.array(box.faces)


@cache
def unit_sphere(subdivisions: int) -> tuple[Array, Faces]:
    """Points (V, 3) and the 20 * 4^subdivisions triangles of a subdivided icosahedron."""
    sphere = trimesh.creation.icosphere(subdivisions)
    return np.array(sphere.vertices), np.array(sphere.faces)


def horizontal_rectangle(width: float, depth: float) -> Surface:
    """A rectangle in the xz plane, facing up."""
    x, z = width / 2, depth / 2
    return flat_shaded(np.array([(-x, 0, z), (x, 0, z), (x, 0, -z), (-x, 0, -z)]), np.array([[0, 1, 2], [0, 2, 3]]))


def slab(width: float, height: float, depth: float) -> Surface:
    """A box along x, y, z, standing on the origin."""
    points, faces = unit_box(0)
    return flat_shaded((points + Y_UP) * (width / 2, height / 2, depth / 2), faces)


def superellipsoid(width: float, height: float, depth: float, power: float, subdivisions: int = 2) -> Surface:
    """A box with soft edges, the unit sphere of the `power` norm, standing on the origin; an ellipsoid for power 2.

    Barr 1981, "Superquadrics and angle-preserving transformations", with equal exponents.
    """
    points, faces = unit_box(subdivisions)
    points = np.sin(np.pi / 2 * points)  # more points near the edges
    points = points / np.linalg.norm(points, ord=power, axis=1, keepdims=True)
    points = (points + Y_UP) * (width / 2, height / 2, depth / 2)
    return box_mapped(points, mean_normals(points, faces), faces, True)


def blob(rng: Rng, radius: float, roughness: float, subdivisions: int) -> Surface:
    """A ball of `radius` displaced by smooth noise of relative amplitude `roughness`, about the origin."""
    points, faces = unit_sphere(subdivisions)
    noise = np.sin(points @ rng.normal(0, 2.0, (3, 12)) + rng.uniform(0, 2 * np.pi, 12)).sum(axis=1) / np.sqrt(6)
    points = points * radius * np.exp(roughness * noise)[:, None]
    return box_mapped(points, mean_normals(points, faces), faces, True)


def gem(rng: Rng, radius: float, subdivisions: int) -> Surface:
    """Facets of a jittered icosahedron (20 triangles, or 80), about the origin."""
    points, faces = unit_sphere(subdivisions)
    return flat_shaded(points * radius * rng.uniform(0.75, 1.0, (len(points), 1)), faces)


def sheet(points: Array, uv: Array, normals: Array | None = None) -> Surface:
    """A grid of points (R, C, 3) with uv (R, C, 2), facing the side from which columns run right and rows run up.

    Smooth, unless `normals` (R, C, 3) are given. Triangles without area are left out.
    """
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (corner.ravel() for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    points = points.reshape(-1, 3)
    faces = faces[np.linalg.norm(area_vectors(points, faces), axis=1) > 1e-12]
    normals = mean_normals(points, faces) if normals is None else normals.reshape(-1, 3)
    return Surface(points, normals, uv.reshape(-1, 2), faces, True)


def profile_normals(profile: Array) -> Array:
    """Normals (2 N - 2, 2) at the start and at the end of every piece of a lathe's profile (N, 2)."""
    normals = unit(np.diff(profile, axis=0)[:, ::-1] * (1, -1))
    before, after = np.roll(normals, 1, axis=0), np.roll(normals, -1, axis=0)
    if not np.array_equal(profile[0], profile[-1]):
        # On the axis the profile continues as its mirror image, elsewhere it just ends.
        mirror = np.array([-1, 1])
        before[0] = normals[0] * mirror if profile[0, 0] == 0 else normals[0]
        after[-1] = normals[-1] * mirror if profile[-1, 0] == 0 else normals[-1]

    def blend(other: Array) -> Array:
        soft = (normals * other).sum(axis=1, keepdims=True) > CREASE
        return unit(np.where(soft, normals + other, normals))

    return np.stack([blend(before), blend(after)], axis=1).reshape(-1, 2)


def lathe(profile: ArrayLike, segments: int = 32) -> Surface:
    """The surface of revolution of `profile` (N, 2), radii and heights, about the y axis.

    The outside is to the right of the profile: it runs outward along the bottom, up, and inward along the top. u runs
    around and repeats seamlessly, v runs along the profile at the same scale, about a metre each.
    """
    profile = np.asarray(profile, dtype=np.float64)
    # Every segment has two rows of vertices of its own, for normals of its own. Gaps between them have no area.
    rows = np.repeat(profile, 2, axis=0)[1:-1]
    v = np.repeat(arc_lengths(profile), 2)[1:-1]
    angle = full_turn(segments)
    around = np.stack([np.cos(angle), -np.sin(angle)], axis=1)

    def sweep(pairs: Array) -> Array:
        level = pairs[:, None, :1] * around
        height = np.broadcast_to(pairs[:, None, 1:], (*level.shape[:2], 1))
        return np.concatenate([level[..., :1], height, level[..., 1:]], axis=2)

    circumference = 2 * np.pi * profile[:, 0].max()
    repeats = max(1, round(circumference))
    u = np.broadcast_to(np.linspace(0, repeats, segments + 1), (len(rows), segments + 1))
    uv = np.stack([u, np.broadcast_to(v[:, None] * repeats / circumference, u.shape)], axis=2)
    return sheet(sweep(rows), uv, sweep(profile_normals(profile)))


def silhouette(radii: ArrayLike, height: float, count: int = 20) -> Array:
    """A smooth profile (count, 2) up to `height` through `radii` at even heights."""
    spline = Track(np.asarray(radii, dtype=np.float64))
    t = np.linspace(0, 1, count)
    return np.stack([np.maximum([spline.at(x) for x in t], 0.002), t * height], axis=1)


def solid(outer: ArrayLike) -> Array:
    """The closed profile of a solid whose side is `outer` (N, 2)."""
    outer = np.asarray(outer, dtype=np.float64)
    return np.concatenate([[(0, outer[0, 1])], outer, [(0, outer[-1, 1])]])


def hollow(outer: Array, wall: float, base: float) -> Array:
    """The closed profile of a vessel with the side `outer` (N, 2), `wall` thickness and a floor at `base`."""
    inner = outer[(outer[:, 1] > base) & (outer[:, 0] > 1.5 * wall)] - (wall, 0)
    return np.concatenate([[(0, outer[0, 1])], outer, inner[::-1], [(0, base)]])


def circle(radius: float, thickness: float, segments: int = 10) -> Array:
    """The profile (segments + 1, 2) of a torus: a circle of radius `thickness` about (`radius`, 0)."""
    angle = full_turn(segments)
    return np.stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)], axis=1)


def disc(radius: float, thickness: float, segments: int = 40) -> Surface:
    """A round board with bevelled edges, standing on the origin."""
    bevel = min(radius, thickness) * 0.15
    side = [(radius - bevel, 0), (radius, bevel), (radius, thickness - bevel), (radius - bevel, thickness)]
    turned = lathe(solid(side), segments)
    return box_mapped(turned.points, turned.normals, turned.faces, True)


def tube(path: ArrayLike, radius: ArrayLike, segments: int = 8) -> Surface:
    """A closed round tube along `path` (N, 3), of constant `radius` or of one (N,) at every point."""
    path = np.asarray(path, dtype=np.float64)
    radii = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(path))
    step = unit(np.diff(path, axis=0))
    tangent = unit(np.concatenate([step[:1], step]) + np.concatenate([step, step[-1:]]))
    right = np.empty_like(path)
    side = np.eye(3)[np.abs(tangent[0]).argmin()]
    for k, forward in enumerate(tangent):
        side = unit(side - forward * (side @ forward))  # twists as little as possible
        right[k] = side
    angle = full_turn(segments)[:, None]
    around = np.cos(angle) * right[:, None] + np.sin(angle) * cross(tangent, right)[:, None]
    # Caps: a ring with the cap's normal, and the centre.
    ends = [0, 0, *range(len(path)), -1, -1]
    radii = np.concatenate([[0, radii[0]], radii, [radii[-1], 0]])
    points = path[ends][:, None] + radii[:, None, None] * around[ends]
    cap = np.broadcast_to(tangent[[0, 0, -1, -1], None], (4, segments + 1, 3)) * np.array([-1, -1, 1, 1])[:, None, None]
    normals = np.concatenate([cap[:2], around, cap[2:]])
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi * radii.max(), segments + 1), arc_lengths(points[:, 0]))
    return sheet(points, np.stack([u, v], axis=2), normals)


def leaf(path: Array, width: float, fold: float) -> Surface:
    """A thin pointed leaf along `path` (N, 3) in a vertical plane, its middle `fold` * `width` lower than its edges."""
    across = unit(cross(path[-1] - path[0], Y_UP))
    share = np.sin(np.pi * np.linspace(0.04, 0.98, len(path)) ** 0.8) * width / 2
    side = share[:, None] * across
    edge = path + Y_UP * (fold * share)[:, None]
    points = np.stack([edge - side, path, edge + side], axis=1)
    along = np.broadcast_to(arc_lengths(path)[:, None], (len(path), 3))
    uv = np.stack([share[:, None] * (-1, 0, 1), along], axis=2)
    return sheet(points, uv)
