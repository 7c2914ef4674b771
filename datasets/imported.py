"""Datasets made from files of other people: what they have in common."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.clip import SCHEMA, is_clip
from datasets.writer import ClipWriter
from errors import BadInput
from files import read_json, write_json
from scenes.camera import Array, View, project, view_of

Image = NDArray[np.float32]


class ImportedFrame(NamedTuple):
    """A frame in our conventions (docs/format.md); images are (H, W, C)."""

    radiance: Image  # noisy
    reference: Image
    albedo: Image
    normal: Image
    position: Image  # in the world
    surface: NDArray[np.bool_]  # (H, W), where a pixel shows one
    view: View
    moved: Image | float = 0.0  # from where surfaces are in the world to where they were in the frame before


def view_of_clip_space(matrix: Array, to_pixels: Array, file: Path) -> View:
    """The view of a matrix (4, 4) from the world to clip space, for row vectors, as graphics APIs have it.

    `to_pixels` (3, 3) leads from clip space's (x, y, w) to homogeneous pixels. Raises BadInput, naming the
    `file`, where it is singular.
    """
    view = view_of(to_pixels @ matrix.T[[0, 1, 3]])
    if view is None:
        raise BadInput(f"{file} has a singular camera matrix, {matrix.tolist()}: get it again")
    return view


def check_size(shape: Sequence[int], size: Sequence[int], file: Path) -> None:
    """Raise BadInput, naming the `file`, where the shape of an image is not the `size` (H, W) of the first frame."""
    if tuple(shape) != tuple(size):
        raise BadInput(f"{file} has an image that is not {size[1]}x{size[0]}, as the first frame is: get it again")


def channels_of(frame: ImportedFrame, before: View | None) -> dict[str, NDArray[Any]]:
    """The channels of a frame, as ClipWriter takes them. All light counts as direct, all surfaces as one mesh.

    `before` is the view of the frame before. Without one motion is 0, whatever the frame says.
    """
    world_to_camera = np.linalg.inv(frame.view.camera_to_world)
    shown = frame.surface[..., None]
    depth = np.where(shown, frame.position @ world_to_camera[2, :3, None] + world_to_camera[2, 3], 0)
    now = frame.position.astype(np.float64)
    then = project(now + frame.moved if before else now, frame.surface, before or frame.view)
    motion = then - project(now, frame.surface, frame.view)
    dark = np.zeros_like(frame.radiance)
    return {
        "direct": np.where(shown, frame.radiance, 0)[None],
        "indirect": dark[None],
        # Readers add emission, which is the noisy radiance where nothing is shown.
        "direct_reference": np.stack([frame.reference - np.where(shown, 0, frame.radiance)] * 2),
        "indirect_reference": np.stack([dark, dark]),
        "emission": np.where(shown, 0, frame.radiance),
        "albedo": np.where(shown, frame.albedo, 1),
        "normal": np.where(shown, frame.normal, 0),
        "depth": depth,
        "roughness": np.ones_like(depth),
        "mesh_id": shown.astype("<u2"),
        "motion": np.where(shown, motion, 0),
        "dual_motion": np.where(shown, motion, 0),
        **frame.view._asdict(),
    }


def by_name(folders: Sequence[Path], names: Sequence[str]) -> dict[str, Path]:
    """Folders of clips by the names of their scenes. Raises BadInput where two have one name."""
    if twice := next((name for name in names if names.count(name) > 1), None):
        both = " and ".join(str(folder) for folder, name in zip(folders, names, strict=True) if name == twice)
        raise BadInput(f"{both} have the same name: rename one, or import them one by one")
    return dict(zip(names, folders, strict=True))


def write_dataset(root: Path, source: str, clips: Mapping[str, Iterator[ImportedFrame]], spp: int) -> int:
    """Write test clips by their scenes' names to a dataset, or resume. Returns how many were written.

    Both buffers of references are the one image that there is: noise floors are unknown, see Clip.is_imported. Raises
    BadInput where `root` has something else, and as the clips' files are read.
    """
    facts = {
        "schema": SCHEMA,
        "profile": source,
        "seed": 0,
        "generator": 0,  # none of ours
        "options": {},
        "scenes": list(clips),
        "splits": {"train": [], "val": [], "test": [f"{name}/000" for name in clips]},
    }
    root.mkdir(parents=True, exist_ok=True)
    plan = root / "dataset.json"
    if any(root.glob("[!.]*")) and not (plan.exists() and read_json(plan).items() <= facts.items()):
        raise BadInput(f"{root} contains something other than these clips: choose an empty or new folder")
    write_json(plan, facts)
    missing = {root / "test" / name / "000": frames for name, frames in clips.items()}
    missing = {folder: frames for folder, frames in missing.items() if not is_clip(folder)}
    for folder, frames in missing.items():
        with ClipWriter(folder) as writer:
            before = None
            for frame in frames:
                writer.add(channels_of(frame, before), {})
                before = frame.view
            writer.finish({"noisy_spp": spp, "reference_spp": 0, "meshes": ["scene"], "source": source}, {})
    return len(missing)
