"""OpenEXR exchange: one multi-layer file a frame, readable by other tools, and back without loss."""

import json
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
from scenes.camera import View, inverse_pose

# Components of layers that are not colours. The halves of a reference are layers of their own, NAME_a and NAME_b.
COMPONENTS = {"normal": "XYZ", "motion": "XY", "dual_motion": "XY", "depth": "Z", "roughness": "Y", "mesh_id": "I"}
ATTRIBUTE = "onespp"  # header attribute: JSON, float64 to the last digit


def layers_of(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """EXR channels (H, W) of a clip's channel (H, W, C) or (2, H, W, C), named LAYER.COMPONENT."""
    if array.ndim == 4:
        halves = zip(("_a", "_b"), array, strict=True)
        return {key: plane for half, image in halves for key, plane in layers_of(name + half, image).items()}
    exact = array.astype(np.uint32) if array.dtype == np.uint16 else array  # EXR has no 16-bit integers
    components = COMPONENTS.get(name, "RGB")
    return {f"{name}.{c}": np.ascontiguousarray(exact[..., i]) for i, c in enumerate(components)}


def write_exr(path: Path, clip: Clip, index: int, realisation: int = 0) -> None:
    """Write one frame atomically, ZIP-compressed.

    Layers: every channel the clip has, in its stored precision, and the noisy beauty image as plain R, G, B (float32).
    Header: `worldToCamera` (row vectors, camera frame as in docs/format.md), and the exact cameras as JSON in `onespp`.
    """
    arrays = {n: clip.read(n, index, realisation=realisation) for n in clip.channels if CHANNELS[n].is_image}
    planes = {key: plane for name, array in arrays.items() for key, plane in layers_of(name, array).items()}
    beauty = sum(arrays[name].astype(np.float32) for name in ("emission", "direct", "indirect"))
    planes |= {c: np.ascontiguousarray(np.asarray(beauty)[..., i]) for i, c in enumerate("RGB")}
    view = clip.view(index)
    facts = {
        **{key: clip.facts[key] for key in ("exposure", "noisy_spp", "reference_spp", "meshes")},
        **{"scene": clip.scene, "clip": clip.name, "frame": index, "realisation": realisation},
        **{key: matrix.tolist() for key, matrix in view._asdict().items()},
    }
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "worldToCamera": np.ascontiguousarray(inverse_pose(view.camera_to_world).T, np.float32),
        ATTRIBUTE: json.dumps(facts),
    }
    try:
        with replacing(path) as temporary, OpenEXR.File(header, planes) as file:
            file.write(str(temporary))
    except RuntimeError as error:  # OpenEXR's word for a full or unwritable disk
        raise BadInput(f"{path} cannot be written ({error}): make room or choose another folder") from None


def read_exr(path: Path) -> tuple[dict[str, NDArray[Any]], View, dict[str, Any]]:
    """A frame that `write_exr` wrote: channels by name as `Clip.read` returns them, the view, and the header's facts.

    Raises BadInput where the file is missing, damaged or was not written by onespp.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: channel.pixels for name, channel in file.channels().items()}
            facts = json.loads(file.header()[ATTRIBUTE])
    except (RuntimeError, KeyError, ValueError) as error:
        raise BadInput(f"{path} is missing, damaged or not written by onespp ({error})") from None
    channels: dict[str, NDArray[Any]] = {}
    for name, channel in CHANNELS.items():
        components = COMPONENTS.get(name, "RGB")
        layers = [name + half for half in ("_a", "_b")] if 2 in channel.axes[:2] else [name]
        if all(f"{layer}.{c}" in planes for layer in layers for c in components) and channel.is_image:
            images = [np.stack([planes[f"{layer}.{c}"] for c in components], axis=-1) for layer in layers]
            array = images[0] if len(images) == 1 else np.stack(images)
            channels[name] = array.astype(np.uint16) if channel.dtype == "<u2" else array
    return channels, View(*(np.array(facts[key]) for key in View._fields)), facts


def export_clip(path: Path, out: Path) -> int:
    """Write every frame of the clip at `path` to `out`/0000.exr and so on. Returns how many."""
    clip = Clip(path)
    out.mkdir(parents=True, exist_ok=True)
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame"):
        write_exr(out / f"{index:04d}.exr", clip, index)
    return clip.frames
