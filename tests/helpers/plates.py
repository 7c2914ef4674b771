"""Plates in front of a wall that faces the camera, where similar triangles give what is visible."""

import numpy as np
import trimesh
from numpy.typing import NDArray

from render.clip import Arrays, Sampling, render_clip
from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.colours import Bsdf

SIZE = 48  # px, at a field of view of 90°
DISTANCE = 4.0  # of the eye from the wall at z = 0
FOCAL = SIZE / 2
Triangles = tuple[tuple[int, int, int], ...]
GREY: Bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
SAMPLING = Sampling(realisations=1, noisy_spp=1, reference_spp=2)
TO_THE_EYE = ((0, 1, 2), (0, 2, 3))
TO_THE_WALL = ((6, 5, 4), (7, 6, 4))


def plate(
    name: str,
    side: float,
    place: tuple[float, float, float],
    bsdf: Bsdf = GREY,
    slides: float = 0.0,
    radiance: float | None = None,
    faces: Triangles = (*TO_THE_EYE, *TO_THE_WALL),
) -> Shape:
    """A square parallel to the wall that slides to the right by so much a frame. `faces` are its sides, or one."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) * side / 2
    mesh = trimesh.Trimesh(np.concatenate([corners, corners]), faces, process=False)
    start = np.array(place, float)
    track = Track(np.stack([start, start + np.array([3 * slides, 0, 0])]), 0, 3) if slides else Track.constant(start)
    shine = None if radiance is None else Track.constant([radiance] * 3)
    return Shape(name, mesh, bsdf, motion=RigidMotion(track, Track.constant(0.0)), radiance=shine)


def frames_of(
    *shapes: Shape,
    eye_slides: float = 0.0,
    sky: NDArray[np.floating] | None = None,
    frames: int = 3,
    sampling: Sampling = SAMPLING,
) -> list[Arrays]:
    """The camera looks along -z at a wall at z = 0."""
    eye = np.array([[0.0, 0, DISTANCE], [3 * eye_slides, 0, DISTANCE]])
    scene = Scene(shapes, Camera(Track(eye, 0, 3), Track(eye - [0, 0, 1], 0, 3), Track.constant(90.0)), sky=sky)
    return [arrays for arrays, _ in render_clip(scene, frames, SIZE, SIZE, sampling, 1)]
