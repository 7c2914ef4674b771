"""onespp as a library: denoisers by name, datasets, your own frames. docs/library.md has an example of each.

`python -m onespp` is the command line.
"""

from __future__ import annotations  # so that types in signatures are not imported

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import numpy as np
    import torch
    from numpy.typing import ArrayLike, NDArray

    from datasets.clip import Clip, Dataset
    from datasets.frame import Frame, Signal
    from models.denoiser import Denoiser
    from scenes.camera import View

__all__ = ["camera", "denoise", "frames", "load", "open_dataset", "read_frames"]


def load(
    name: str,
    weights: str | Path | None = None,
    precision: torch.dtype | None = None,
    device: Literal["cpu", "cuda"] = "cpu",
    signal: Signal | None = None,
) -> Denoiser:
    """A denoiser ready to use, by its name: svgf, wskp6+adaptive, oidn+taa, ...

    `weights` is the file of a network's weights, by default the shipped one (`onespp weights` lists them). `precision`
    is by default the fastest on the device. `signal` is the light that it returns, "total" or "indirect": by default
    total, but for NTD. Raises errors.BadInput where the name is unknown, the file missing, damaged or of another
    network, for a network without weights, a precision that it does not compute in, and where there is no such device.
    """
    from errors import BadInput
    from models.registry import parse_name, shipped_weights
    from models.spec import load as load_denoiser

    parsed = parse_name(name)
    if parsed.budget and not weights:
        raise BadInput(f"'{name}' are weights in a folder of runs, such as runs/train: give their file as `weights`")
    file = Path(weights) if weights else shipped_weights(parsed.base)
    return load_denoiser(name, file, precision, signal, device)


def open_dataset(path: str | Path) -> Dataset:
    """The dataset in a folder; `clips("test")` returns the clips of a split. Raises errors.BadInput without one."""
    from datasets.clip import Dataset

    return Dataset(Path(path))


def read_frames(clip: Clip, denoiser: Denoiser, realisation: int = 0) -> Iterator[Frame]:
    """The frames of a clip, tensors (1, C, H, W) read from memory maps, with the channels that the denoiser reads.

    Raises errors.BadInput where the clip lacks a channel or the light that the denoiser needs.
    """
    from datasets.frame import read_frame

    clip.check_signal(denoiser.signal)
    for index in range(clip.frames):
        yield read_frame(clip, index, denoiser.reads, realisation)


def camera(K: ArrayLike, camera_to_world: ArrayLike) -> View:
    """A camera: projection `K` (3, 3) and pose `camera_to_world` (4, 4), by the conventions of docs/format.md.

    Raises errors.BadInput where they are not that.
    """
    from denoise.arrays import camera_of

    return camera_of(K, camera_to_world)


def frames(
    sequence: Iterable[Mapping[str, NDArray[np.floating] | View]], denoiser: Denoiser, spp: float = 1.0
) -> Iterator[Frame]:
    """Frames from your own arrays, a mapping for each frame; the colour has `spp` samples per pixel.

    Its arrays, all (H, W, C) with row 0 at the top; only "colour" is required:

    - "colour": noisy radiance, linear RGB
    - "buffer_b": a second, independent sample buffer of the same size; the frame is the mean of both
    - "emission": radiance of visible lights, part of the colour, which is not denoised
    - "albedo": reflectance in [0, 1]; without it radiance is filtered
    - "normal": in world space, of unit length
    - "depth" along the viewing axis, or "distance" along the ray, or "position" in the world; 0 for background
    - "motion": pixels, x right and y down, to where the surface was in the frame before
    - "roughness": GGX alpha
    - "camera": returned by `camera`

    Without motion it is derived from depth and cameras, as if nothing else moved; without those there is no history.
    Raises errors.BadInput, naming the frame, for arrays that cannot be used; and for a denoiser of indirect light, or
    of channels that only onespp renders.
    """
    from denoise.arrays import frames_of_arrays

    return frames_of_arrays(sequence, denoiser, spp)


def denoise(denoiser: Denoiser, sequence: Iterable[Frame]) -> Iterator[NDArray[np.float32]]:
    """Denoised radiance (H, W, 3), linear RGB, of each frame of a sequence, with history except across cuts."""
    import torch

    from datasets.frame import to_image

    state = None
    for frame in sequence:
        with torch.inference_mode():
            radiance, state = denoiser(frame.to(denoiser.device), state)
        yield to_image(radiance)


if __name__ == "__main__":
    from command_line import main

    main()
