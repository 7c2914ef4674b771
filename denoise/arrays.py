"""Frames from one's own arrays."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from datasets.frame import Frame
from denoise.foreign_frame import DEPTHS, ForeignFrame, make_finite, surface_of
from denoise.frames import FrameBuilder, InputConventions, check_reads
from denoise.layers import COLOUR, QUANTITIES
from denoise.motion_convention import MotionConvention
from errors import BadInput
from models.denoiser import Denoiser
from models.wrappers.wrapper import unwrapped
from scenes.camera import STILL, Array, View

CAMERA = "camera"
NUMBERS = "fiu"  # kinds of numpy's types: floats and integers
COMPONENTS = {"depth": 1, "distance": 1, "roughness": 1, "id": 1, "motion": 2}  # of others 3

Quantities = Mapping[str, NDArray[np.floating] | View]  # of one frame


def camera_of(K: ArrayLike, camera_to_world: ArrayLike) -> View:
    """See onespp.camera. Raises BadInput for matrices of another shape or kind: they would lose history silently."""
    K, pose = matrix("K", K, 3), matrix("camera_to_world", camera_to_world, 4)
    if K[0, 0] >= 0 or K[1, 1] >= 0:
        raise BadInput("K of a camera has to have negative focal lengths: turn other cameras as docs/format.md says")
    if not np.allclose(K, [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]):
        raise BadInput("K of a camera has to have no shear, and the last row 0 0 1")
    turn = pose[:3, :3]
    if not np.allclose(turn @ turn.T, np.eye(3), rtol=0, atol=1e-3) or (pose[3] != (0, 0, 0, 1)).any():
        raise BadInput("camera_to_world of a camera has to be rotation and translation, with the last row 0 0 0 1")
    return View(K, pose, STILL)


def matrix(name: str, values: ArrayLike, size: int) -> Array:
    """Finite numbers (size, size). Raises BadInput for any others."""
    numbers = as_numbers(f"{name} of a camera", values).astype(np.float64)
    if numbers.shape != (size, size) or not np.isfinite(numbers).all():
        raise BadInput(f"{name} of a camera has to be {size} x {size} finite numbers")
    return numbers


def as_numbers(name: str, array: Any) -> NDArray[Any]:
    """An array of numpy. Raises BadInput for what has no numbers, or cannot be read, as on a GPU."""
    try:
        numbers = np.asarray(array)
    except Exception as error:  # each library raises its own
        raise BadInput(f"{name} is no array that numpy can read: {error}") from None
    if numbers.dtype.kind not in NUMBERS:
        raise BadInput(f"{name} has no real numbers, but {numbers.dtype}")
    return numbers


def check_usable(denoiser: Denoiser) -> None:
    """Raise BadInput where a denoiser needs what arrays do not have."""
    name = type(unwrapped(denoiser)).__name__
    if denoiser.signal == "indirect":
        remedy = 'load it by onespp.load(..., signal="total")'
        raise BadInput(f"{name} denoises indirect light, and arrays have only the total: {remedy}")
    check_reads(name, denoiser.reads)


def frames_of_arrays(sequence: Iterable[Quantities], denoiser: Denoiser, spp: float) -> Iterator[Frame]:
    """A Frame for the denoiser of each mapping of arrays (H, W, C); see onespp.frames for their content.

    Raises BadInput as `check_usable`, and, naming the frame and the quantity, for what cannot be used.
    """
    check_usable(denoiser)
    names: set[str] = set()
    builder: FrameBuilder | None = None
    for index, quantities in enumerate(sequence):
        source = f"frame {index} of the arrays"
        frame = foreign_frame(quantities, source)
        if builder is None:
            frame.check_depth()
            names = set(quantities)
            builder = FrameBuilder(conventions_of(names), denoiser.reads, "arrays", spp)
        if names != set(quantities):
            raise BadInput(f"{source}: '{min(names ^ set(quantities))}' is in some frames and not in others")
        yield builder.build(frame)


def conventions_of(names: Collection[str]) -> InputConventions:
    motion = MotionConvention() if "motion" in names else None
    # Without depth, a camera does not locate surfaces.
    has_cameras = CAMERA in names and any(name in names for name in (*DEPTHS, "position"))
    return InputConventions(motion, cameras="arrays" if has_cameras else None)


def foreign_frame(quantities: Quantities, source: str) -> ForeignFrame:
    """One frame; the arrays themselves stay as they are."""
    if not isinstance(quantities, Mapping):
        raise BadInput(f"{source} is of type {type(quantities).__name__}: name its arrays by a mapping")
    with np.errstate(over="ignore"):  # too large a number becomes infinite, and counts as 0
        arrays = {
            name: np.array(as_numbers(f"{source}: '{name}'", array), np.float32)
            for name, array in quantities.items()
            if name != CAMERA
        }
    if COLOUR not in arrays:
        raise BadInput(f"{source}: there is no '{COLOUR}'")
    for name, array in arrays.items():
        if name not in QUANTITIES:
            raise BadInput(f"{source}: unknown quantity '{name}'; there are {', '.join(QUANTITIES)} and {CAMERA}")
        expected = (*arrays[COLOUR].shape[:2], COMPONENTS.get(name, 3))
        if array.shape != expected:
            raise BadInput(f"{source}: '{name}' has the shape {array.shape}, not {expected}")
        if array.size == 0:
            raise BadInput(f"{source}: '{name}' has no pixels")
    camera = quantities.get(CAMERA)
    view = camera if isinstance(camera, View) else None
    if CAMERA in quantities and not view:
        raise BadInput(f"{source}: '{CAMERA}' is of type {type(camera).__name__}: make it by onespp.camera")
    nonfinite = make_finite(arrays)
    return ForeignFrame(arrays, surface_of(arrays, None), nonfinite, source, view=view)
