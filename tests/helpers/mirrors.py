"""A room with a mirror."""

import numpy as np
import trimesh

from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.colours import Bsdf

SIZE = (48, 64)
FRAMES = 3


def mirror(*reflectance: float) -> Bsdf:
    """On both sides. All of these are of the same kernels."""
    inside = {"type": "conductor", "material": "none", "specular_reflectance": {"type": "rgb", "value": [*reflectance]}}
    return {"type": "twosided", "bsdf": inside}


SILVER = mirror(1.0, 1.0, 1.0)


def painted(red: float) -> Bsdf:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [red, 0.4, 0.6]}}


def panel(width: float, height: float) -> trimesh.Trimesh:
    """A rectangle in z = 0 that faces +z."""
    x, y = width / 2, height / 2
    corners = [[-x, -y, 0], [x, -y, 0], [x, y, 0], [-x, y, 0]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


def placed(mesh: trimesh.Trimesh, at: list[float]) -> trimesh.Trimesh:
    copy = mesh.copy()
    copy.apply_translation(at)
    return copy


HAND_MIRROR = Shape("hand mirror", placed(panel(0.1, 0.1), [0, 0, 50]), SILVER)  # out of sight
BOX = placed(trimesh.creation.box([0.5, 0.8, 0.4]), [-0.3, 0.2, 1.2])
GLIDE = Track(np.array([[0.0, 0, 0], [0.5, 0.2, 0]]), last=FRAMES - 1.0)  # along the mirror
EYE = Track(np.array([[1.2, 0.3, 3.0], [1.5, 0.2, 2.8]]), last=FRAMES - 1.0)
CAMERA = Camera(EYE, Track.constant([0.0, 0, 0]), Track.constant(60.0))


def room(surface: Bsdf) -> Scene:
    """A picture on the wall of which is `surface`, a box that glides along it and a slanted wall behind the camera.

    The picture, if it is a mirror, shows that wall everywhere.
    """
    slanted = placed(panel(50, 50), [0, 0, 6])
    slanted.apply_transform(trimesh.transformations.rotation_matrix(np.pi + 0.2, [0, 1, 0], [0, 0, 6]))
    shapes = (
        Shape("picture", panel(5, 5), surface),
        Shape("box", BOX, painted(0.2), motion=RigidMotion(GLIDE, Track.constant(0.0))),
        Shape("wall", slanted, painted(0.7), radiance=Track.constant([1.0, 1.0, 1.0])),
    )
    return Scene(shapes, CAMERA)
