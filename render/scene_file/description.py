"""The TOML description of a user's own scene: its file, camera flight, motion and what to render."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta, field
from msgspec.structs import asdict
from numpy.typing import ArrayLike

from errors import BadInput
from scenes.animation import Camera, FreeMotion, KeyframedTrack
from scenes.camera import Array

LARGEST = 1e18  # of all numbers: its square is a finite float32; and none is NaN
Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
Vector = tuple[Number, Number, Number]
MOST = 2**20  # of whole numbers, but for samples
MOST_SPP = 2**28  # Mitsuba counts samples by 32 bits
Count = Annotated[int, Meta(ge=0, le=MOST)]
Positive = Annotated[int, Meta(ge=1, le=MOST)]
Fraction = Annotated[float, Meta(ge=0, le=1)]  # of a clip: 0 is its first frame, 1 its last
Even = Annotated[int, Meta(ge=2, le=MOST_SPP, multiple_of=2)]
Decibels = Annotated[float, Meta(gt=0, le=200)]


class Table(msgspec.Struct, forbid_unknown_fields=True):
    """A table of the TOML."""


class CameraKey(Table):
    """The camera at a time; `fov` is horizontal, in degrees."""

    time: Fraction
    position: Vector
    target: Vector
    up: Vector | None = None  # by default the file's, as `fov`
    fov: Annotated[float, Meta(gt=0, lt=180)] | None = None


class PoseKey(Table):
    """The pose of a shape at a time, relative to the file; rotations in degrees about x, then y, then z."""

    time: Fraction
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)


class GainKey(Table):
    """The brightness of a light at a time, relative to the file."""

    time: Fraction
    gain: Annotated[float, Meta(ge=0, le=LARGEST)]


class Motion(Table):
    shape: str
    keyframes: Annotated[list[PoseKey], Meta(min_length=1)]


class LightChange(Table):
    light: str
    keyframes: Annotated[list[GainKey], Meta(min_length=1)]


class Split(Table):
    """The clips of a split, and how they are sampled."""

    clips: Count = 1
    camera: Literal["auto", "keyframes"] | None = None  # by default by keyframes, where there are any
    realisations: Positive = 1
    reference_spp: Even = 256
    floor: Decibels | None = None
    most_spp: Even = 4096


class TrainSplit(Split):
    clips: Count = 4
    realisations: Positive = 4
    reference_spp: Even = 128


class TestSplit(Split):
    floor: Decibels | None = 35.0
    most_spp: Even = 2048
    judged: tuple[Count, ...] = ()  # the frames that get a reference; by default all


class Splits(Table):
    train: TrainSplit = field(default_factory=TrainSplit)
    val: Split = field(default_factory=Split)
    test: TestSplit = field(default_factory=TestSplit)


class Description(Table):
    file: str  # a Mitsuba XML, glTF, OBJ or PLY; relative to the TOML
    resolution: tuple[Positive, Positive] = (256, 144)  # width, height
    frames: Positive = 16
    bounces: Positive | None = None  # of light, 1 is direct light alone; by default the file's
    camera: list[CameraKey] = []
    motion: list[Motion] = []
    light: list[LightChange] = []
    splits: Splits = field(default_factory=Splits)


def read_description(path: Path) -> Description:
    """Raises BadInput, naming the file and the position in it, if it is missing or invalid."""
    try:
        described = msgspec.toml.decode(path.read_bytes(), type=Description)
    except OSError as error:
        raise BadInput(f"{path} cannot be read: {error.strerror}") from None
    except (msgspec.DecodeError, ValueError) as error:
        raise BadInput(f"{path}: {error}; docs/scenes.md lists its keys") from None
    judged = described.splits.test.judged
    if judged != tuple(sorted({*judged} & {*range(described.frames)})):
        raise BadInput(f"{path}: judged = {[*judged]}: list frames from 0 to {described.frames - 1} in rising order")
    all_keys: list[Sequence[CameraKey | PoseKey | GainKey]] = [described.camera]
    all_keys += [motion.keyframes for motion in described.motion]
    all_keys += [change.keyframes for change in described.light]
    for times in ([key.time for key in keys] for keys in all_keys):
        if times != sorted(set(times)):
            raise BadInput(f"{path}: the times {times} of keyframes do not increase: put them in order, each time once")
    for names in ([motion.shape for motion in described.motion], [change.light for change in described.light]):
        if len(set(names)) < len(names):
            raise BadInput(f"{path}: '{max(names, key=names.count)}' has keyframes twice: merge them into one table")
    if any(split.camera == "keyframes" for split in asdict(described.splits).values()) and not described.camera:
        raise BadInput(f"{path}: a split's camera uses keyframes, but there are none: add [[camera]] tables")
    return described


def spline(values: ArrayLike, times: list[float], frames: int) -> KeyframedTrack:
    """The track through `values` at `times`, fractions of a clip of so many frames."""
    return KeyframedTrack(np.array(values, np.float64), times=np.array(times) * (frames - 1))


def camera_of(keys: list[CameraKey], file: Camera, frames: int) -> Camera:
    """The camera with keyframes `keys`; what they omit is as in the `file`."""
    times = [key.time for key in keys]
    x, y, z = file.up.at(0).tolist()
    fov = float(file.x_fov.at(0))
    return Camera(
        eye=spline([key.position for key in keys], times, frames),
        target=spline([key.target for key in keys], times, frames),
        x_fov=spline([fov if key.fov is None else key.fov for key in keys], times, frames),
        up=spline([key.up or (x, y, z) for key in keys], times, frames),
    )


def motion_of(keys: list[PoseKey], pivot: Array, frames: int) -> FreeMotion:
    """The motion of a shape that rotates about `pivot` (3,), its centre in the file."""
    times = [key.time for key in keys]
    turns = spline(np.radians([key.rotation for key in keys]), times, frames)
    return FreeMotion(pivot, spline([key.position for key in keys], times, frames), turns)


def gain_of(keys: list[GainKey], frames: int) -> KeyframedTrack:
    """A factor on a light, interpolated linearly because a spline could become negative."""
    return replace(spline([key.gain for key in keys], [key.time for key in keys], frames), straight=True)
