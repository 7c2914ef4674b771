"""OpenEXR exchange: one multi-layer file per frame, which other tools read, and back without loss."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip
from errors import BadInput
from files import replacing
from scenes.camera import inverse_pose

FACTS_ATTRIBUTE = "onespp"  # of the header: JSON, in which float64 keeps all its digits


@contextmanager
def silenced() -> Iterator[None]:
    """A context in which the OpenEXR library prints nothing: of a damaged file it writes many lines."""
    stderr = os.dup(2)
    with open(os.devnull, "w") as null, redirect_stdout(null):
        os.dup2(null.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)


def layers_of(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """EXR channels (H, W), named LAYER.LETTER, of a clip's channel: (H, W, C), or (2, H, W, C) of two buffers."""
    channel = CHANNELS[name]
    exact = array.astype(np.uint32) if array.dtype == np.uint16 else array  # EXR has no 16-bit integers
    return {
        f"{layer}.{letter}": np.ascontiguousarray(image[..., i])
        for layer, image in zip(layer_names(name), exact if channel.has_buffers else [exact], strict=True)
        for i, letter in enumerate(channel.letters)
    }


def layer_names(name: str) -> list[str]:
    """The layers of a channel: its own, or one for each of its two buffers."""
    return [f"{name}_a", f"{name}_b"] if CHANNELS[name].has_buffers else [name]


def write_planes(path: Path, planes: dict[str, NDArray[Any]], attributes: dict[str, Any]) -> None:
    """Write EXR channels (H, W) by name as `write_file`, ZIP-compressed, with further `attributes` in the header."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    with OpenEXR.File(header, planes) as file:
        write_file(path, file)


def write_file(path: Path, file: OpenEXR.File) -> None:
    """Write atomically. Raises BadInput where the disk is full or the folder cannot be written."""
    try:
        with replacing(path) as temporary:
            file.write(str(temporary))
    except RuntimeError as error:  # what OpenEXR raises for a full or unwritable disk
        raise BadInput(f"{path} cannot be written ({error}): make room or choose another folder") from None


def write_exr(path: Path, clip: Clip, index: int) -> None:
    """Write one frame of a clip atomically.

    Layers are all channels that the clip has of this frame, in their stored precision, and the noisy beauty image as
    plain R, G, B (float32). The header has `worldToCamera` (for row vectors, in the camera frame of docs/format.md)
    and the exact cameras as JSON in `onespp`. Raises BadInput where it cannot be written.
    """
    kinds = {name: CHANNELS[name].kind for name in clip.channels if CHANNELS[name].is_image}
    names = [name for name, kind in kinds.items() if kind != "reference" or index in clip.judged]
    arrays = {name: clip.read(name, index) for name in names}
    planes = {key: plane for name, array in arrays.items() for key, plane in layers_of(name, array).items()}
    beauty = clip.noisy(index)
    planes |= {c: np.ascontiguousarray(beauty[..., i]) for i, c in enumerate("RGB")}
    view = clip.view(index)
    facts = {
        **{key: clip.facts[key] for key in ("exposure", "noisy_spp", "reference_spp", "meshes")},
        "scene": clip.scene,
        "clip": clip.name,
        "frame": index,
        "realisation": 0,
        **{name: matrix.tolist() for name, matrix in view._asdict().items()},
    }
    attributes = {
        "worldToCamera": np.ascontiguousarray(inverse_pose(view.camera_to_world).T, np.float32),
        FACTS_ATTRIBUTE: json.dumps(facts),
    }
    write_planes(path, planes, attributes)


def channels_in(planes: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Those of our channels, as `Clip.read` returns them, that EXR channels (H, W) contain: inverts layers_of."""
    channels: dict[str, NDArray[Any]] = {}
    for name, channel in CHANNELS.items():
        layers = layer_names(name)
        if channel.is_image and all(f"{layer}.{c}" in planes for layer in layers for c in channel.letters):
            images = [np.stack([planes[f"{layer}.{c}"] for c in channel.letters], axis=-1) for layer in layers]
            array = images[0] if len(images) == 1 else np.stack(images)
            channels[name] = array.astype(np.uint16) if channel.dtype == "<u2" else array
    return channels


def export_clip(path: Path, out: Path) -> int:
    """Write the frames of the clip at `path` to `out` as 0000.exr and so on. Returns how many there are.

    Raises BadInput where `out` has other files of this kind, and where it cannot be written.
    """
    clip = Clip(path)
    files = [out / f"{index:04d}.exr" for index in range(clip.frames)]
    if others := sorted(set(out.glob("*.exr")) - set(files)):
        raise BadInput(f"{others[0]} is no frame of {path}: choose an empty or new folder")
    out.mkdir(parents=True, exist_ok=True)
    for index, file in enumerate(tqdm(files, f"{clip.scene}/{clip.name}", unit="frame")):
        write_exr(file, clip, index)
    return clip.frames
