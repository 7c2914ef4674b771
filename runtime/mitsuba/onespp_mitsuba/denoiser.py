"""The denoiser, called as `mi.OptixDenoiser` is."""

from typing import Any

import mitsuba as mi
import numpy as np
import onespp_runtime

from .camera import Array, host
from .images import ROOT, Image, named_channels, to_image, to_images
from .motion import Snapshot, flow_between, pose_step

# Where there is no depth: all is far away, in the camera space of each frame, and normals alone tell surfaces apart.
FAR_AWAY = {"K": np.diag([-1e9, -1e9, 1.0]), "camera_to_world": np.eye(4)}
TOWARDS_VIEWER = (0.0, 0.0, -1.0)
MOST_SHAPES = 1 << 16  # where none moves


def visible_shapes(images: dict[str, Image], poses: Array) -> tuple[Image | None, Array]:
    """Numbers of the shapes that pixels show, and their poses (M, 4, 4).

    Shapes in mirrors and behind glass, of which there is no primitive, have numbers of their own: the light of a shape
    that is seen directly is no history of the same shape in a mirror.
    """
    shapes = images.get("shape")
    if shapes is None or "primitive" not in images:
        return shapes, poses
    is_shown = (images["primitive"] == 0) & (shapes > 0)
    return shapes + (len(poses) or MOST_SHAPES) * is_shown, np.concatenate([poses, poses])


class Denoiser:
    """Denoises a sequence of frames with the network `one`, and remembers what it needs of those before.

    `input_size` is (width, height) in pixels, at most 16384 each. `albedo`, `normals` and `temporal` say what each call
    brings, as for `mi.OptixDenoiser`; without `temporal`, each frame is denoised by itself. By default, `threads` are
    as many as there are processors.

    Raises ValueError for sizes or threads out of range.
    """

    def __init__(
        self,
        input_size: Any,
        albedo: bool = False,
        normals: bool = False,
        temporal: bool = False,
        *,
        threads: int | None = None,
    ):
        self.width, self.height = (int(side) for side in input_size)
        self.brings = {"albedo": albedo, "normals": normals}
        self.temporal, self.threads = temporal, threads
        self.runtime = self.with_room(shapes=0)
        self.reset()

    def with_room(self, shapes: int) -> onespp_runtime.Denoiser:
        """A denoiser without history, with room for the poses of as many shapes."""
        return onespp_runtime.Denoiser(self.width, self.height, max_meshes=shapes, threads=self.threads)

    def reset(self) -> None:
        """Forget all frames before, as after a cut."""
        self.is_first = True
        self.before: Snapshot | None = None
        self.poses = np.zeros((0, 4, 4))  # of shapes, rigid, from where they were in the first frame

    def __call__(self, noisy: Any, *arguments: Any, **keywords: Any) -> Any:
        """`denoise_bitmap` for a Bitmap, otherwise `denoise`."""
        denoise = self.denoise_bitmap if isinstance(noisy, mi.Bitmap) else self.denoise
        return denoise(noisy, *arguments, **keywords)

    def denoise(
        self,
        noisy: Any,
        albedo: Any = None,
        normals: Any = None,
        to_sensor: Any = None,
        flow: Any = None,
        previous_denoised: Any = None,
        *,
        sensor: Any = None,
        scene: Any = None,
        samples: float = 1.0,
        **guides: Any,
    ) -> Any:
        """The denoised TensorXf (H, W, C) of the next frame, with as many channels as `noisy`.

        Images are tensors of any variant, or arrays, with row 0 at the top; those of one channel may be (H, W). The
        first six arguments are those of `mi.OptixDenoiser`.

        - noisy (H, W, 1, 3 or 4): linear radiance. Alpha is returned as it is
        - albedo (H, W, 3): in [0, 1]; 1 for background
        - normals (H, W, 3): shading normals, of length 1; 0 for background. In world space with `to_sensor` or
          `depth`, otherwise in the sensor's
        - to_sensor: Transform4f from the space of normals to the sensor's. Not read with `depth`
        - flow (H, W, 2): x and y, in pixels, by which surfaces have moved in the image since the frame before. By
          default it follows from `depth`, `sensor` and, where shapes move, `scene`, `shape` and `primitive`
        - previous_denoised: not read: the denoiser remembers more than this image
        - sensor, scene: as they are in this frame; `scene` only where shapes move
        - samples: per pixel of `noisy`, from 1e-3 to 1e9

        Guides, by keyword:

        - depth (H, W, 1): distance along the viewing axis; 0 for background. It needs `sensor` and normals. Without
          it, surfaces that come into view may keep the history of those that hid them
        - roughness (H, W, 1): GGX alpha; 1 by default
        - shape, primitive (H, W, 1): index + 1 of shape and triangle; 0 for none
        - emission (H, W, 3): the part of `noisy` that is free of noise, such as lamps seen directly

        Raises ValueError for wrong shapes and for what is missing or not expected, and TypeError for images that do not
        hold floats. After an error the state is what it was.
        """
        size = self.height, self.width
        self.check(guides, albedo=albedo, normals=normals)
        light = to_image("noisy", noisy, size)
        images = to_images({"albedo": albedo, "normals": normals, "flow": flow, **guides}, size)
        now = self.snapshot(images, sensor, scene)
        motion, poses = self.motion(images, now), self.moved_poses(now)
        shapes, visible_poses = visible_shapes(images, poses)
        count = len(visible_poses)
        runtime = self.runtime if count <= self.runtime.max_meshes else self.with_room(count)
        rgb = np.broadcast_to(light[..., :3], (*size, 3))
        normals, depth = self.surface(images, now, to_sensor)
        emission = np.minimum(images["emission"], rgb) if "emission" in images else np.float32(0)
        colour = runtime.denoise(
            rgb - emission,
            images.get("albedo"),
            normals,
            depth,
            motion,
            emission=np.where(depth.reshape(*size, 1) > 0, emission, rgb),  # background stays as it is
            roughness=images.get("roughness"),
            mesh_id=shapes,
            object_to_world=visible_poses if count else None,
            samples=samples,
            reset=self.is_first or not self.temporal,
            **({"K": now.camera.K, "camera_to_world": now.camera.camera_to_world} if now else FAR_AWAY),
        )
        self.runtime, self.is_first, self.before, self.poses = runtime, False, now, poses
        return mi.TensorXf(np.concatenate([colour[..., : light.shape[2]], light[..., 3:]], axis=2))

    def check(self, guides: dict[str, Any], **promised: Any) -> None:
        """Raise ValueError for images that were promised to the constructor and are missing, or the other way round."""
        for name, image in promised.items():
            if self.brings[name] != (image is not None):
                missing = "is missing" if image is None else "is not expected"
                raise ValueError(f"{name} {missing}: the denoiser was made with {name}={self.brings[name]}")
        unknown = guides.keys() - {"depth", "roughness", "shape", "primitive", "emission"}
        if unknown:
            raise ValueError(f"no such guides: {', '.join(sorted(unknown))}")

    def snapshot(self, images: dict[str, Image], sensor: Any, scene: Any) -> Snapshot | None:
        """None without depth."""
        if "depth" not in images:
            return None
        if sensor is None or "normals" not in images:
            raise ValueError("depth: it needs `sensor`, and normals")
        if scene is not None and not {"shape", "primitive"} <= images.keys():
            raise ValueError("scene: it needs the guides `shape` and `primitive`")
        now = Snapshot(sensor, scene)
        if now.camera.size != (self.height, self.width):
            raise ValueError(f"sensor: its film is {now.camera.size}, the images are {(self.height, self.width)}")
        return now

    def motion(self, images: dict[str, Image], now: Snapshot | None) -> Image | Array:
        """In pixels to where surfaces were: the runtime counts the other way than `flow`."""
        if "flow" in images:
            return -images["flow"]
        if not self.temporal or self.is_first:
            return np.zeros((self.height, self.width, 2))
        if now is None or self.before is None:
            raise ValueError("flow: it is missing, and follows from `depth` and `sensor` only if each frame has them")
        guides = (images[name][..., 0] if name in images else None for name in ("depth", "shape", "primitive"))
        return -flow_between(now, self.before, *guides)

    def moved_poses(self, now: Snapshot | None) -> Array:
        """Of all shapes, rigid; of those that deform as nearly as can be."""
        if now is None or not now.places:
            return np.zeros((0, 4, 4))
        if self.before is None:
            return np.tile(np.eye(4), (len(now.places), 1, 1))
        poses = self.poses.copy()
        for index, places in now.moved_since(self.before).items():
            poses[index] = pose_step(*places) @ poses[index]
        return poses

    def surface(self, images: dict[str, Image], now: Snapshot | None, to_sensor: Any) -> tuple[Any, Any]:
        """(normals, depth) as the runtime needs them."""
        if now is not None:
            return images["normals"], images["depth"]
        if "normals" not in images:
            return np.full((self.height, self.width, 3), TOWARDS_VIEWER), np.ones((self.height, self.width))
        normals: Any = images["normals"]
        if to_sensor is not None:
            normals = normals @ host(to_sensor.matrix)[:3, :3].T
        return normals, normals.any(axis=2).astype(np.float32)  # background has none

    def denoise_bitmap(
        self,
        noisy: Any,
        albedo_ch: str = "",
        normals_ch: str = "",
        to_sensor: Any = None,
        flow_ch: str = "",
        previous_denoised_ch: str = "",
        noisy_ch: str = ROOT,
        *,
        sensor: Any = None,
        scene: Any = None,
        samples: float = 1.0,
        **guide_ch: str,
    ) -> Any:
        """The same, as a Bitmap, for a Bitmap of all images: arguments ending with `_ch` are the names of channels.

        Those of guides are `depth_ch` and so on. Raises ValueError also for a name that the bitmap lacks, and for a
        `scene` with a bitmap of float16, in which triangles have no exact numbers.
        """
        if scene is not None and noisy.component_format() == mi.Struct.Type.Float16:
            raise ValueError("scene: the bitmap holds float16; set component_format of the film to float32")
        names = {"noisy_ch": noisy_ch, "albedo_ch": albedo_ch, "normals_ch": normals_ch, "flow_ch": flow_ch, **guide_ch}
        given = {name.removesuffix("_ch"): image for name, image in named_channels(noisy, names).items()}
        return mi.Bitmap(self.denoise(**given, to_sensor=to_sensor, sensor=sensor, scene=scene, samples=samples))
