"""Frames from one's own arrays."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from datasets.frame import Frame
from denoise.foreign_frame import ForeignFrame, make_finite, surface_of
from denoise.frames import FrameBuilder, InputConventions, check_reads
from denoise.layers import COLOUR, QUANTITIES
from denoise.motion_convention import MotionConvention
from errors import BadInput
from models.denoiser import Denoiser
from models.wrappers.wrapper import unwrapped
from scenes.camera import View

CAMERA = "camera"
COMPONENTS = {"depth": 1, "distance": 1, "roughness": 1, "id": 1, "motion": 2}  # of others 3

Quantities = Mapping[str, NDArray[np.floating] | View]  # of one frame


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
    remaining = iter(sequence)
    first = next(remaining, None)
    if first is None:
        return
    motion = MotionConvention() if "motion" in first else None
    conventions = InputConventions(motion, cameras="arrays" if CAMERA in first else None)
    builder = FrameBuilder(conventions, denoiser.reads, "arrays", spp)
    for index, quantities in enumerate(chain([first], remaining)):
        if quantities.keys() != first.keys():
            other = min(quantities.keys() ^ first.keys())
            raise BadInput(f"frame {index} of the arrays: '{other}' is in some frames and not in others")
        yield builder.build(foreign_frame(quantities, f"frame {index} of the arrays"))


def foreign_frame(quantities: Quantities, source: str) -> ForeignFrame:
    """One frame; the arrays themselves stay as they are."""
    view = quantities.get(CAMERA)
    arrays = {name: np.array(array, np.float32) for name, array in quantities.items() if name != CAMERA}
    if COLOUR not in arrays:
        raise BadInput(f"{source}: there is no '{COLOUR}'")
    for name, array in arrays.items():
        if name not in QUANTITIES:
            raise BadInput(f"{source}: unknown quantity '{name}'; there are {', '.join(QUANTITIES)} and {CAMERA}")
        expected = (*arrays[COLOUR].shape[:2], COMPONENTS.get(name, 3))
        if array.shape != expected:
            raise BadInput(f"{source}: '{name}' has the shape {array.shape}, not {expected}")
    if view is not None and not isinstance(view, View):
        raise BadInput(f"{source}: '{CAMERA}' is of type {type(view).__name__}: make it by onespp.camera")
    nonfinite = make_finite(arrays)
    return ForeignFrame(arrays, surface_of(arrays, None), nonfinite, source, view=view)
