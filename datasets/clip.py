"""Clips and data sets on disk, read through memory maps."""

import hashlib
import re
import resource
from collections.abc import Callable, Container, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED, NOISY_CHANNELS, SECOND, SECOND_LAYER
from errors import BadInput
from files import crc32_of, read_json
from scenes.camera import View, motion_vectors, pixel_centres

SCHEMA = 1
NEEDED_FOR_LAYERS = ("indirect", "emission", "albedo", "mesh_id")  # to denoise glass in two layers
SPLITS = ("train", "val", "test")
FACTS_OF_A_DATASET = ("schema", "profile", "seed", "generator", "scenes", "splits")
FACTS_OF_A_CLIP = ("frames", "height", "width", "exposure", "channels", "floor_mse", "nonfinite", "clamped", "complete")

ImageWindow = tuple[slice, slice]  # rows, columns
WHOLE_IMAGE: ImageWindow = (slice(None), slice(None))


def is_clip(path: Path) -> bool:
    """Whether there is a clip at `path`. A folder with clip.json is complete, because clips appear by renaming."""
    return (path / "clip.json").exists()


class ClipKind(NamedTuple):
    """What a clip's name describes: 000 is a number, in `still` nothing moves, 000-4spp has noisy input of 4 spp."""

    number: int
    still: bool
    noisy_spp: int  # samples a pixel of the noisy channels

    @staticmethod
    def of(name: str) -> "ClipKind":
        """The kind of the clip of that name. Raises BadInput where no clip is called so."""
        match = re.fullmatch(r"(\d+|still)(?:-(\d+)spp)?", name)
        if not match:
            raise BadInput(f"'{name}' does not name a clip: clips are called 000, still or 000-4spp")
        still = match[1] == "still"
        return ClipKind(0 if still else int(match[1]), still, int(match[2] or 1))


def visible_channel(
    name: str, stored: Container[str], read: Callable[[str], NDArray[Any]], meshes: int
) -> NDArray[Any]:
    """A channel (..., H, W, C), in mirrors of the surfaces that these show, if the `stored` channels describe them.

    All motion in a mirror is that of what the mirror shows, as if it stood behind the mirror. The renderer's gradient
    is of the mirror itself: there it counts as 0. Ids of the meshes that a mirror shows are higher by `meshes`, their
    number: the light of a surface that is seen directly is no history of the same surface in a mirror or behind glass.
    """

    def in_mirror() -> NDArray[np.bool_]:
        return read(MIRRORED["depth"]) != read("depth")

    if MIRRORED.get(name) in stored:
        shown = read(MIRRORED[name])
        return shown + np.int32(meshes) * (in_mirror() & (shown > 0)) if name == "mesh_id" else shown
    own = read(name)
    if not CHANNELS[name].is_temporal or MIRRORED["motion"] not in stored:
        return own
    return np.where(in_mirror(), 0 if CHANNELS[name].kind == "gradient" else read(MIRRORED["motion"]), own)


def visible_view(view: View, stored: Container[str]) -> View:
    """A view with poses for the mesh ids of `visible_channel`."""
    if MIRRORED["mesh_id"] not in stored:
        return view
    return view._replace(object_to_world=np.concatenate([view.object_to_world] * 2))


def second_layer_of(names: Iterable[str], stored: Container[str]) -> list[str]:
    """The channels that come with the named ones where a second layer of glass is `stored`: its own, and a few more."""
    if "indirect" not in names or "glass_reflectance" not in stored:
        return []
    needed = {*names, *NEEDED_FOR_LAYERS}
    return [
        name
        for name, channel in CHANNELS.items()
        if name in needed or (name in SECOND_LAYER and (channel.of is None or channel.of in needed))
    ]


class Clip:
    """One clip on disk, read on demand. Raises BadInput, naming the file, where it is missing or damaged."""

    def __init__(self, path: Path, first_hits: bool = False):
        """first_hits: whether mirrors and glass are described as surfaces of their own, not by what they show."""
        self.path = path
        self.first_hits = first_hits
        self.facts = read_json(path / "clip.json", FACTS_OF_A_CLIP)
        self.frames: int = self.facts["frames"]
        self.height: int = self.facts["height"]
        self.width: int = self.facts["width"]
        # The frames that have a reference, by default all.
        self.judged: list[int] = self.facts.get("judged") or list(range(self.frames))
        self.exposure: float = self.facts["exposure"]  # multiplies radiance in pictures and metrics: clip_exposure
        # Whether others rendered it: all light counts as direct, and both buffers of the reference are one image.
        self.is_imported = "source" in self.facts
        self.scene = path.parent.name  # such as "room-3"
        self.name = path.name  # within its scene, such as "000" or "still"; see ClipKind
        self.channels: dict[str, dict[str, Any]] = self.facts["channels"]
        self._maps: dict[str, NDArray[Any]] = {}

    @property
    def fingerprint(self) -> str:
        """The checksum (crc32, 8 hex digits) of clip.json, which contains those of all channels."""
        checksum = crc32_of(self.path / "clip.json")
        return f"{checksum}-first-hits" if self.first_hits else checksum

    def check_signal(self, signal: Literal["total", "indirect"]) -> None:
        """Raise BadInput for indirect light where that is a part of the direct."""
        if signal == "indirect" and self.is_imported:
            raise BadInput(f"{self.path} was imported and has no indirect light: denoise the total")

    @property
    def seconds(self) -> dict[str, float]:
        """What rendering took, by step."""
        return read_json(self.path / "timing.json")

    @property
    def layers(self) -> Container[str]:
        """The channels that say what mirrors and glass show."""
        return {} if self.first_hits else self.channels

    @property
    def realisations(self) -> int:
        """Number of independent noise realisations of the noisy channels."""
        entries = [self.entry(channel) for channel in NOISY_CHANNELS]
        return max(entry["shape"][1] if "shape" in entry else 1 for entry in entries)  # a black one has no shape

    def entry(self, channel: str) -> dict[str, Any]:
        """How a channel is stored, from clip.json. Raises BadInput where the channel was not rendered."""
        if channel not in self.channels:
            raise BadInput(f"{self.path} has no '{channel}': it was not rendered; render the data set with it")
        return self.channels[channel]

    def map(self, channel: str) -> NDArray[Any]:
        """The memory-mapped array of a channel that has a file, checked against the shape in clip.json."""
        if channel not in self._maps:
            entry = self.entry(channel)
            path = self.path / entry["file"]
            try:
                array = np.load(path, mmap_mode=None if 0 in entry["shape"] else "r")  # an empty file cannot be mapped
            except FileNotFoundError:
                raise BadInput(f"{path} is missing: delete {self.path} and rerun `onespp dataset`") from None
            except (ValueError, EOFError, SyntaxError, TokenError) as error:  # np.load reads the header as Python
                raise BadInput(f"{path} is damaged ({error}): delete {self.path} and rerun `onespp dataset`") from None
            if list(array.shape) != entry["shape"] or array.dtype != np.dtype(entry["dtype"]):
                raise BadInput(f"{path} does not match clip.json: delete {self.path} and rerun `onespp dataset`")
            self._maps[channel] = array
        return self._maps[channel]

    def read(self, channel: str, frame: int, window: ImageWindow = WHOLE_IMAGE, realisation: int = 0) -> NDArray[Any]:
        """One frame of a channel, cut to `window`: (h, w, C), or (2, h, w, C) of two sample buffers.

        The array is the same whether the channel is stored in full, stored as one value or derived from others.
        Raises BadInput where the channel was not rendered or its file is missing or damaged, for the reference of a
        frame that is not judged, and for a realisation that there is not.
        """
        rows, columns = window
        entry = self.entry(channel)
        spec = CHANNELS[channel]
        if spec.kind == "reference":
            if frame not in self.judged:
                raise BadInput(f"{self.path} has no reference of frame {frame}: `judged` leaves it out")
            frame = self.judged.index(frame)
        if "value" in entry:
            area = np.empty((self.height, self.width), bool)[rows, columns].shape
            buffers = (2,) if spec.has_buffers else ()
            value = np.array(entry["value"], "<f4" if spec.widens else spec.dtype)
            return np.broadcast_to(value, (*buffers, *area, len(spec.letters)))
        if "derived" in entry:
            return self.motion_to(frame, max(frame - 1, 0), window, self.read)
        array = self.map(channel)
        if "S" not in spec.axes:
            return array[frame][..., rows, columns, :]
        if not 0 <= realisation < array.shape[1]:
            raise BadInput(f"{self.path} has {array.shape[1]} realisations, numbered from 0: there is no {realisation}")
        return array[frame, realisation][..., rows, columns, :]

    def read_visible(
        self, channel: str, frame: int, window: ImageWindow = WHOLE_IMAGE, realisation: int = 0
    ) -> NDArray[Any]:
        """As `read`, but in mirrors of what these show: the input of denoisers. See `visible_channel`."""
        meshes = self.map("object_to_world").shape[1] if channel == "mesh_id" else 0
        return visible_channel(channel, self.layers, lambda name: self.read(name, frame, window, realisation), meshes)

    def read_blended(self, channel: str, frame: int) -> NDArray[Any]:
        """As `read_visible`, but of smooth glass the mean of both layers by probability, which OIDN asks for."""
        image = self.read_visible(channel, frame)
        if "glass_reflectance" not in self.layers:
            return image
        reflectance = self.read("glass_reflectance", frame).astype(np.float32)
        second = self.read(SECOND[channel], frame).astype(np.float32)
        return image + np.minimum(reflectance, 1 - reflectance) * (second - image)

    def view(self, frame: int) -> View:
        """The camera and the poses of all meshes in one frame."""
        return View._make(np.array(self.map(name)[frame]) for name in View._fields)

    def visible_view(self, frame: int) -> View:
        """The same with poses for the mesh ids of `read_visible`."""
        return visible_view(self.view(frame), self.layers)

    def motion_to(
        self, frame: int, other: int, window: ImageWindow = WHOLE_IMAGE, read: Callable[..., NDArray[Any]] | None = None
    ) -> NDArray[np.float32]:
        """Motion vectors (h, w, 2), in pixels, from `frame` to any `other` frame, of the surfaces that `read` returns.

        By default they are those of visible surfaces. They follow from depth, cameras and the poses of the meshes.
        """
        read = read or self.read_visible
        pixels = pixel_centres(self.height, self.width)[window]
        depth = read("depth", frame, window)[..., 0].astype(np.float64)
        mesh_id = read("mesh_id", frame, window)[..., 0]
        views = self.visible_view(frame), self.visible_view(other)
        return motion_vectors(pixels, depth, mesh_id, *views).astype(np.float32)

    def noisy(self, frame: int, realisation: int = 0) -> NDArray[np.float32]:
        """Noisy radiance (H, W, 3): emission + direct + indirect."""
        emission, direct, indirect = (
            self.read(name, frame, realisation=realisation).astype(np.float32) for name in ("emission", *NOISY_CHANNELS)
        )
        return emission + direct + indirect

    def reference(self, frame: int, signal: Literal["total", "indirect"] = "total") -> NDArray[np.float32]:
        """Both buffers (2, H, W, 3) of the reference radiance: emission + direct + indirect, or indirect alone.

        Raises BadInput as `read`, and for indirect light of an imported clip.
        """
        self.check_signal(signal)
        indirect = self.read("indirect_reference", frame).astype(np.float32)
        if signal == "indirect":
            return indirect
        direct, emission = (self.read(name, frame).astype(np.float32) for name in ("direct_reference", "emission"))
        return direct + indirect + emission


class Dataset:
    """A data set on disk: dataset.json and the clips it plans. Raises BadInput where none of this schema is there."""

    def __init__(self, path: Path):
        self.path = path
        if not path.is_dir():
            raise BadInput(f"there is no data set at {path}: make one with `onespp dataset --data {path}`")
        self.facts = read_json(path / "dataset.json", FACTS_OF_A_DATASET)
        if self.facts["schema"] != SCHEMA:
            raise BadInput(
                f"{path} has schema version {self.facts['schema']}, not {SCHEMA}: render it again with "
                "`onespp dataset` into a new folder"
            )

    def planned(self, splits: Sequence[str] = SPLITS) -> list[Path]:
        """The folders of all clips of `splits`, rendered or not, in a fixed order."""
        return [self.path / split / clip for split in splits for clip in self.facts["splits"][split]]

    def clips(self, split: str, first_hits: bool = False) -> list[Clip]:
        """All clips of a split. Raises BadInput where one has not been rendered yet, or none is planned."""
        if split not in self.facts["splits"]:
            raise BadInput(f"{self.path} has no split '{split}': use one of {', '.join(self.facts['splits'])}")
        paths = self.planned([split])
        if missing := [path for path in paths if not is_clip(path)]:
            raise BadInput(
                f"{self.path}: {len(missing)} of {len(paths)} clips of '{split}' are missing, first {missing[0]}; "
                "finish them with `onespp dataset`"
            )
        if not paths:
            raise BadInput(f"{self.path} has no clips in its split '{split}': use another data set")
        allow_open_files(len(paths) * len(CHANNELS))
        return [Clip(path, first_hits) for path in paths]


def digest_of(clips: Iterable[Clip]) -> str:
    """SHA-256 of the fingerprints of clips, as hexadecimal digits."""
    return hashlib.sha256(" ".join(clip.fingerprint for clip in clips).encode()).hexdigest()


def constant_channels(clips: Sequence[Clip]) -> dict[str, list[float]]:
    """The channels that have one value in all of the clips, and that value, a number per component."""
    values = [{name: entry.get("value") for name, entry in clip.channels.items()} for clip in clips]
    return {
        name: value
        for name, value in values[0].items()
        if value is not None and all(others.get(name) == value for others in values)
    }


def allow_open_files(count: int) -> None:
    """Raise this process's limit of open files by `count`, as far as allowed: every memory map needs one."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY:
        wanted = soft + count if hard == resource.RLIM_INFINITY else min(soft + count, hard)
        with suppress(ValueError, OSError):  # macOS has a lower limit than the hard one it states
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
