"""Sequences of OpenEXR files as other renderers write them, made of Frames.

`python -m tests.helpers.foreign CLIP|WxH FOLDER` writes one under Blender's names.
"""

import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datasets.clip import Clip
from datasets.frame import Frame, read_frame
from eval.bench.denoisers import parse_size
from eval.bench.synthetic_frames import synthetic_frame
from scenes.camera import View, inverse_pose, pixel_centres, unproject

Image = NDArray[np.floating]
Layers = dict[str, Image]  # (H, W, C) by layer name with the components' letters: "Albedo.RGB"

HEADER = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}


def image(frame: Frame, channel: str) -> Image:
    """A channel (H, W, C)."""
    return frame.channels[channel][0].permute(1, 2, 0).double().numpy()


def beauty(frame: Frame) -> Image:
    return frame.radiance("total")[0].permute(1, 2, 0).double().numpy()


def view(frame: Frame) -> View:
    return View(*(getattr(frame.now, name)[0].numpy() for name in View._fields))


def world_to_ndc(view: View, height: int, width: int, from_zero: bool = False) -> NDArray[np.float32]:
    """`worldToNDC` for row vectors, of a view: in [-1, 1] as OpenEXR means it, or else in [0, 1]; y up."""
    to_unit = np.array([[1 / width, 0, 0], [0, -1 / height, 1], [0, 0, 1]])
    x, y, w = to_unit @ view.K @ inverse_pose(view.camera_to_world)[:3]
    rows = [x, y, w, w] if from_zero else [2 * x - w, 2 * y - w, w, w]
    return np.ascontiguousarray(np.array(rows).T, np.float32)


def positions(frame: Frame) -> Image:
    """Points in the world, 0 for background."""
    depth = image(frame, "depth")
    return np.where(depth > 0, unproject(pixel_centres(*frame.size), depth[..., 0], view(frame)), 0)


def planes(layers: Layers, dtype: type = np.float32) -> dict[str, NDArray[Any]]:
    """The channels of a file."""
    channels = {}
    for name, array in layers.items():
        layer, dot, letters = name.rpartition(".")
        for index, letter in enumerate(letters):
            with np.errstate(over="ignore"):  # distances to the sky are infinite in half precision
                channels[f"{layer}{dot}{letter}"] = np.ascontiguousarray(array[..., index], dtype)
    return channels


def write(path: Path, layers: Layers, header: Mapping[str, Any] | None = None, dtype: type = np.float32) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with OpenEXR.File({**HEADER, **(header or {})}, planes(layers, dtype)) as file:
        file.write(str(path))
    return path


def blender(frame: Frame) -> Layers:
    """Multi-layer files of Cycles; `Vector` is as its users describe it: positive where it came from."""
    depth, motion = image(frame, "depth"), image(frame, "motion")
    alpha = np.ones_like(depth)
    return {
        "ViewLayer.Combined.RGBA": np.concatenate([0.5 * beauty(frame), alpha], axis=-1),  # some other image
        "ViewLayer.Noisy Image.RGBA": np.concatenate([beauty(frame), alpha], axis=-1),
        "ViewLayer.Denoising Albedo.RGB": image(frame, "albedo"),
        "ViewLayer.Normal.XYZ": image(frame, "normal"),
        "ViewLayer.Depth.Z": np.where(depth > 0, depth, 1e10),
        "ViewLayer.Vector.XYZW": np.concatenate([motion * [1, -1], motion * [-1, 1]], axis=-1),
        "ViewLayer.Emit.RGB": image(frame, "emission") * (depth > 0),
        "ViewLayer.Mist.Z": np.linspace(0, 1, depth.size).reshape(depth.shape),
    }


def pbrt(frame: Frame) -> Layers:
    """What a GBufferFilm holds, in world space."""
    return {
        "RGB": beauty(frame),
        "Albedo.RGB": image(frame, "albedo"),
        "P.XYZ": positions(frame),
        "N.XYZ": image(frame, "normal"),
        "Ns.XYZ": image(frame, "normal"),
        "Variance.RGB": np.ones_like(image(frame, "albedo")),
    }


def write_sequence(
    folder: Path, frames: Iterable[Frame], layers: Callable[[Frame], Layers], first: int = 1, **options: Any
) -> list[Path]:
    """Files folder/0001.exr and so on."""
    return [write(folder / f"{first + i:04d}.exr", layers(frame), **options) for i, frame in enumerate(frames)]


def read(path: Path) -> dict[str, NDArray[Any]]:
    """All channels of a file of one part."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return {name: channel.pixels for name, channel in file.channels().items()}


def header(path: Path) -> dict[str, Any]:
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return dict(file.header())


def main(source: str, out: Path) -> None:
    """Write what Blender would of a clip's folder, references beside it, or of three synthetic frames of a size "WxH".

    Of these, frames/ has buffer A and buffer-b/ the other samples.
    """
    if Path(source).is_dir():
        clip = Clip(Path(source))
        reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "motion")
        write_sequence(out / "frames", (read_frame(clip, index, reads) for index in range(clip.frames)), blender)
        for index in range(clip.frames):
            write(out / "reference" / f"{index + 1:04d}.exr", {"RGB": clip.reference(index).mean(axis=0)})
    else:
        for which, folder in enumerate(("frames", "buffer-b")):
            buffer = (synthetic_frame(index, *parse_size(source)).buffer(which) for index in range(3))
            write_sequence(out / folder, buffer, blender)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("python -m tests.helpers.foreign CLIP|WxH OUT: a test clip's folder, or the size of made-up frames")
    main(sys.argv[1], Path(sys.argv[2]))
