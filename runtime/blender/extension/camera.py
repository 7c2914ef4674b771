"""The camera of a frame, from Blender's conventions to those of the runtime."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .exr import BadFrame

if TYPE_CHECKING:
    import bpy

Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    name: str
    K: Matrix  # (3, 3) for an image of width and height 1: pixels are this times the image's size
    camera_to_world: Matrix  # (4, 4)

    @staticmethod
    def of(scene: "bpy.types.Scene", depsgraph: "bpy.types.Depsgraph") -> "Camera":
        """Of the frame that the dependency graph was evaluated for. Raises BadFrame unless it is a perspective one."""
        if scene.camera is None:
            raise BadFrame(f"frame {scene.frame_current} has no camera: bind another by its marker")
        if scene.camera.data.type != "PERSP":
            raise BadFrame(f"the camera {scene.camera.name} is not a perspective one: nothing else can be denoised yet")
        evaluated = scene.camera.evaluated_get(depsgraph)
        render = scene.render
        if render.use_border and render.use_crop_to_border:
            raise BadFrame("the render region is cropped: turn off Crop to Render Region")
        projection = evaluated.calc_matrix_camera(
            depsgraph,
            x=render.resolution_x,
            y=render.resolution_y,
            scale_x=render.pixel_aspect_x,
            scale_y=render.pixel_aspect_y,
        )
        return Camera(scene.camera.name, intrinsics(np.array(projection)), pose(np.array(evaluated.matrix_world)))

    def pixels(self, height: int, width: int) -> Matrix:
        """K (3, 3) in pixels."""
        return np.diag([width, height, 1.0]) @ self.K


def intrinsics(projection: Matrix) -> Matrix:
    """K (3, 3) from OpenGL's projection (4, 4), whose x and y go from -1 to 1, with y up and z backward."""
    return np.array(
        [
            [-projection[0, 0] / 2, 0, (1 - projection[0, 2]) / 2],
            [0, -projection[1, 1] / 2, (1 + projection[1, 2]) / 2],
            [0, 0, 1],
        ]
    )


def pose(matrix: Matrix) -> Matrix:
    """A rigid camera_to_world (4, 4), x left and z forward, of Blender's, which may be scaled, or sheared by parents.

    Raises BadFrame where it is flat.
    """
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    if not stretch[2] > 0:
        raise BadFrame("the camera is scaled by 0")
    rigid = np.eye(4)
    rigid[:3, :3] = left @ right * [-1, 1, -1]  # the nearest rotation
    rigid[:3, 3] = matrix[:3, 3]
    return rigid
