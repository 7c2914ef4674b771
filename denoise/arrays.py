"""Frames from one's own arrays."""

from collections.abc import Iterable, Iterator, Mapping
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from datasets.frame import Frame
from denoise.frames import Reading, Shot
from denoise.layers import KNOWN
from denoise.motion_meaning import Meaning
from denoise.pixels import Pixels, mend, surface_of
from denoise.sequence import COLOUR
from errors import BadInput
from scenes.camera import View

CAMERA = "camera"
COMPONENTS = {"depth": 1, "distance": 1, "roughness": 1, "motion": 2}  # of others 3


def frames_of_arrays(
    sequence: Iterable[Mapping[str, NDArray[np.floating] | View]], reads: tuple[str, ...], spp: float
) -> Iterator[Frame]:
    """A Frame with the channels in `reads` for each mapping of arrays (H, W, C); onespp.frames says what they hold.

    Raises BadInput, naming the frame and the quantity, for what cannot be used.
    """
    remaining = iter(sequence)
    first = next(remaining, None)
    if first is None:
        return
    reading = Reading(Meaning() if "motion" in first else None, cameras="arrays" if CAMERA in first else None)
    shot = Shot(reading, reads, "arrays", spp)
    for index, quantities in enumerate(chain([first], remaining)):
        if quantities.keys() != first.keys():
            other = min(quantities.keys() ^ first.keys())
            raise BadInput(f"frame {index} of the arrays: '{other}' is in some frames and not in others")
        yield shot.frame(pixels_of(quantities, f"frame {index} of the arrays"))


def pixels_of(quantities: Mapping[str, NDArray[np.floating] | View], source: str) -> Pixels:
    """The pixels of one frame; the arrays themselves are left as they are."""
    view = quantities.get(CAMERA)
    arrays = {name: np.array(array, np.float32) for name, array in quantities.items() if name != CAMERA}
    if COLOUR not in arrays:
        raise BadInput(f"{source}: there is no '{COLOUR}'")
    for name, array in arrays.items():
        if name not in KNOWN:
            raise BadInput(f"{source}: '{name}' is not known; what is are {', '.join(KNOWN)} and {CAMERA}")
        expected = (*arrays[COLOUR].shape[:2], COMPONENTS.get(name, 3))
        if array.shape != expected:
            raise BadInput(f"{source}: '{name}' has the shape {array.shape}, not {expected}")
    nonfinite = mend(arrays)
    return Pixels(arrays, surface_of(arrays, None), nonfinite, source, view=view if isinstance(view, View) else None)
