"""The denoiser as a class, and as a function."""

import operator
import os
import sys
import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .arrays import Array, to_colour, to_ids, to_image, to_matrices, to_poses
from .library import (
    ISAS,
    MAX_MESHES,
    MAX_PARTS,
    MAX_SAMPLES,
    MAX_SIDE,
    MAX_THREADS,
    MIN_SAMPLES,
    FrameInputs,
    Handle,
    strided_image,
)

ROOM_FOR_MESHES = 4096  # of the state that `denoise` makes: few bytes each
CHANNELS_OF = {"indirect": 3, "emission": 3, "albedo": 3, "normal": 3, "depth": 1, "roughness": 1, "motion": 2}


class Denoiser:
    """Denoises the frames of a sequence, one after the other.

    `width` and `height` are those of the largest frame in pixels, at most 16384 each. `max_meshes` is the largest
    number of poses per frame, at most 65536; 0 where nothing but the camera moves. `threads` is at most 512, by default
    as many as there are processors for this process; where the platform has no POSIX threads it is 1. The result has
    the same bits for any number of threads.

    `isa` is the instruction set that it uses: "avx512", "avx2", or "baseline", that of the compiler's flags. `max_isa`
    is the highest one it may use; results differ by rounding errors. `max_parts` is the largest number of parts of the
    light per frame, at most 16.

    Several denoisers can work at the same time. Calls of one wait for each other.

    Raises ValueError for numbers out of range, and unknown instruction sets.
    """

    def __init__(
        self,
        width: int,
        height: int,
        *,
        max_meshes: int = 0,
        threads: int | None = None,
        max_isa: str = "any",
        max_parts: int = 0,
    ):
        self.width = whole_number("width", width, 1, MAX_SIDE)
        self.height = whole_number("height", height, 1, MAX_SIDE)
        self.max_meshes = whole_number("max_meshes", max_meshes, 0, MAX_MESHES)
        wanted = min(processors(), MAX_THREADS) if threads is None else whole_number("threads", threads, 1, MAX_THREADS)
        if max_isa not in ISAS:
            raise ValueError(f"max_isa: expected one of {', '.join(ISAS)}, got {max_isa!r}")
        self.max_parts = whole_number("max_parts", max_parts, 0, MAX_PARTS)
        self._handle = Handle(self.width, self.height, self.max_meshes, wanted, max_isa, self.max_parts)
        self.threads = self._handle.threads
        self.isa = self._handle.isa
        self._lock = threading.Lock()

    def denoise(
        self,
        color: Array,
        albedo: Array | None,
        normal: Array,
        depth: Array,
        motion: Array,
        *,
        K: Array,
        camera_to_world: Array,
        indirect: Array | None = None,
        emission: Array | None = None,
        roughness: Array | None = None,
        mesh_id: Array | None = None,
        object_to_world: Array | None = None,
        samples: float = 1.0,
        reset: bool = False,
        parts: Sequence[NDArray[np.float32]] = (),
        masks: int = 0,
    ) -> NDArray[np.float32]:
        """The denoised radiance (H, W, 3) of the next frame.

        Images have row 0 at the top, and are floats; float32 is read in place, whatever its strides, and other floats
        are converted. A number that is NaN or infinite counts as 0. Lengths are in any unit, always the same.

        - color (H, W, 3): noisy radiance of surfaces, linear RGB, at least 0, in any unit; background shows its
          emission alone. A frame of another size than the one before resets
        - albedo (H, W, 3): reflectance in [0, 1] that the color contains, 1 for background. None: 1, so that textures
          are filtered together with the light
        - normal (H, W, 3): shading normal in world space, of length 1, towards the viewer; 0 for background
        - depth (H, W) or (H, W, 1): distance along the viewing axis; 0 for background
        - motion (H, W, 2): x (to the right) and y (down) from the pixel to where its surface was in the frame before,
          in pixels
        - K (3, 3): intrinsics, in pixels. With p a point in camera space - x to the left, y up, z forward - pixel =
          (K p) / p_z, where the centre of the first one is (0.5, 0.5): so K[0, 0] and K[1, 1] are negative
        - camera_to_world (4, 4): rigid. From OpenCV's camera space, negate the first two columns; from OpenGL's, the
          first and the third
        - indirect (H, W, 3): noisy radiance after more than one bounce, added to the color. None: the color has it
        - emission (H, W, 3): light sources seen directly, which the color lacks; added to the result. None: 0
        - roughness (H, W) or (H, W, 1): GGX alpha in [0, 1]; 1 for diffuse surfaces and background. None: 1
        - mesh_id (H, W) or (H, W, 1): number of the pixel's mesh from 1 on; 0 for background. None: one for all.
          Meshes described as mirrors and glass show them need numbers of their own there
        - object_to_world (M, 4, 4): rigid; poses of meshes 1 to M, of which there are at most max_meshes. Meshes
          without a pose do not move
        - samples: per pixel, in the color, from 1e-3 to 1e9; 1 where unknown
        - reset: whether to forget all frames before, as after a cut
        - parts, float32 arrays (H, W, 3): noisy radiance of parts of the light, such as that of one lamp, of either
          sign. They are replaced by denoised radiance: parts that add up to the color and indirect light do so
          afterwards. Another number of parts than before resets
        - masks: how many parts, the last ones, are no light: the past of light is scaled by changes of the whole

        Raises ValueError for a wrong shape, or a number that is out of range, and TypeError for what is no array of
        such numbers on the CPU. After an error the state is what it was.
        """
        light = to_colour(color)
        size = height, width = light.shape[:2]
        if width > self.width or height > self.height:
            raise ValueError(f"color: (H, W) is {size}, but the denoiser was made for {(self.height, self.width)}")
        if not MIN_SAMPLES <= samples <= MAX_SAMPLES:
            raise ValueError(f"samples: expected {MIN_SAMPLES:g} to {MAX_SAMPLES:g}, got {samples}")
        frame = FrameInputs(width=width, height=height, reset=bool(reset), samples=samples)
        frame.set_image("direct", light)
        white = np.broadcast_to(np.float32(1), light.shape)
        surface = {"albedo": white if albedo is None else albedo, "normal": normal, "depth": depth, "motion": motion}
        optional = {"indirect": indirect, "emission": emission, "roughness": roughness}
        for name, image in (surface | {name: each for name, each in optional.items() if each is not None}).items():
            frame.set_image(name, to_image(name, image, size, CHANNELS_OF[name]))
        if mesh_id is not None:
            frame.set_ids(to_ids("mesh_id", mesh_id, size))
        set_camera(frame, K, camera_to_world)
        if object_to_world is not None:
            frame.set_poses(to_poses("object_to_world", object_to_world, (-1, 4, 4)))
        if frame.meshes > self.max_meshes:
            raise ValueError(f"object_to_world: {frame.meshes} poses, but max_meshes is {self.max_meshes}")
        if len(parts) > self.max_parts:
            raise ValueError(f"parts: {len(parts)}, but max_parts is {self.max_parts}")
        frame.set_parts([in_place(part, size) for part in parts], whole_number("masks", masks, 0, len(parts)))
        radiance = np.empty((*size, 3), np.float32)
        with self._lock:
            self._handle.denoise(frame, strided_image(radiance))
        return radiance


def in_place(part: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """The part. Raises TypeError for what is no writable array of float32, and ValueError for another shape."""
    if not isinstance(part, np.ndarray) or part.dtype != np.float32 or not part.flags.writeable:
        raise TypeError("parts: expected writable numpy arrays of float32, which are denoised in place")
    if part.shape != (*size, 3):
        raise ValueError(f"parts: expected the shape {(*size, 3)}, got {part.shape}")
    if not part.flags.aligned or any(stride % part.itemsize for stride in part.strides):
        raise TypeError("parts: expected floats that lie whole floats apart, not fields of packed records")
    return part


def set_camera(frame: FrameInputs, K: Array, camera_to_world: Array) -> None:
    intrinsics = to_matrices("K", K, (3, 3))
    if intrinsics[0, 0] >= 0 or intrinsics[1, 1] >= 0:
        raise ValueError("K: a focal length is not negative; negate axes of other cameras as camera_to_world says")
    frame.K[:] = intrinsics.flatten().tolist()
    frame.camera_to_world[:] = to_poses("camera_to_world", camera_to_world, (4, 4)).flatten().tolist()


def denoise(
    color: Array,
    albedo: Array | None,
    normal: Array,
    depth: Array,
    motion: Array,
    *,
    K: Array,
    camera_to_world: Array,
    indirect: Array | None = None,
    emission: Array | None = None,
    roughness: Array | None = None,
    mesh_id: Array | None = None,
    object_to_world: Array | None = None,
    samples: float = 1.0,
    threads: int | None = None,
    state: Denoiser | None = None,
) -> tuple[NDArray[np.float32], Denoiser]:
    """The denoised radiance (H, W, 3) of a frame, and the state to hand over with the next one.

    Arguments are those of `Denoiser.denoise`. Without a state, the sequence begins; `threads` counts only then. A state
    serves one frame: the one returned is the same object. For a larger frame than before a new one begins.
    """
    light = to_colour(color)
    height, width = light.shape[:2]
    if state is None or width > state.width or height > state.height:
        room = ROOM_FOR_MESHES if state is None else state.max_meshes
        state = Denoiser(width, height, max_meshes=room, threads=threads if state is None else state.threads)
    radiance = state.denoise(
        *(light, albedo, normal, depth, motion),
        K=K,
        camera_to_world=camera_to_world,
        indirect=indirect,
        emission=emission,
        roughness=roughness,
        mesh_id=mesh_id,
        object_to_world=object_to_world,
        samples=samples,
    )
    return radiance, state


def whole_number(name: str, number: int, least: int, most: int) -> int:
    """The number. Raises ValueError where it is out of range, and TypeError where it is none."""
    number = operator.index(number)
    if not least <= number <= most:
        raise ValueError(f"{name}: expected {least} to {most}, got {number}")
    return number


def processors() -> int:
    """How many of them this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
