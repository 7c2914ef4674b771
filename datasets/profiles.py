"""Data profiles: which clips a data set has, and how well each is sampled."""

import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

from datasets.channels import CAMERA_CHANNELS, CHANNELS, REFERENCES
from datasets.clip import SCHEMA, SPLITS
from errors import BadInput
from render.clip import NO_OPTIONS, Options

GENERATOR = 5  # raise it when the same seed renders different bytes

# Without these a clip has no picture, no reference or no geometry that the rest could be derived from.
ALWAYS = {"direct", "indirect", *REFERENCES, "emission", "albedo", "depth", "mesh_id", *CAMERA_CHANNELS}


class Quality(NamedTuple):
    """How well the clips of a split are sampled."""

    realisations: int  # of the noisy channels
    reference_spp: int  # at least
    floor: float | None = None  # dB: references get more samples until their noise is down to this,
    most_spp: int = 4096  # but no more than this


@dataclass(frozen=True)
class DataProfile:
    """What a data set holds. `boxes` and `rooms` count clips of each Cornell box, and rooms, by split."""

    height: int
    width: int
    frames: int
    boxes: dict[str, int]
    rooms: dict[str, int]
    quality: dict[str, Quality]
    special: dict[str, list[str]] = field(default_factory=dict)  # further clips by split, SCENE/CLIP


BOXES = ("cornell_box", "cornell_box_moving")
FIRST_ROOM = {"train": 0, "val": 1000, "test": 2000}  # of the numbers of seed 0
ROOMS_OF_A_SEED = 10_000

DATA_PROFILES = {
    "tiny": DataProfile(
        *(64, 64, 8),
        boxes={"train": 1, "val": 1, "test": 1},
        rooms={"train": 0, "val": 0, "test": 0},
        quality={"train": Quality(2, 64), "val": Quality(1, 128), "test": Quality(1, 128)},
    ),
    "quick": DataProfile(
        *(128, 128, 24),
        boxes={"train": 3, "val": 1, "test": 1},
        rooms={"train": 3, "val": 0, "test": 1},
        quality={"train": Quality(7, 128, 30, 512), "val": Quality(1, 256), "test": Quality(1, 256, 40, 1024)},
    ),
    # What release is like, in minutes: as many rooms, small and short, to see how hard they are.
    "sketch": DataProfile(
        *(64, 64, 4),
        boxes={"train": 0, "val": 0, "test": 0},
        rooms={"train": 64, "val": 8, "test": 0},
        quality={"train": Quality(1, 64, 30), "val": Quality(1, 64, 30), "test": Quality(1, 64, 30)},
    ),
    "release": DataProfile(
        *(256, 256, 32),
        boxes={"train": 0, "val": 0, "test": 1},
        rooms={"train": 64, "val": 8, "test": 6},
        quality={"train": Quality(4, 64, 30), "val": Quality(1, 64, 30), "test": Quality(1, 256, 40, 16384)},
        special={
            "test": [
                *(f"cornell_box_moving/{clip}" for clip in ("still", "000-4spp", "000-64spp", "000-256spp")),
            ]
        },
    ),
}


def versions() -> dict[str, str]:
    """Versions of the packages that decide what is rendered."""
    return {package: version(package) for package in ("onespp", "mitsuba", "drjit", "numpy")}


def profile_of(name: str) -> DataProfile:
    """Raises BadInput for an unknown profile."""
    if name not in DATA_PROFILES:
        raise BadInput(f"unknown profile '{name}'; the profiles are {', '.join(DATA_PROFILES)}")
    return DATA_PROFILES[name]


def clips_of(profile: DataProfile, split: str, seed: int) -> list[str]:
    """All clips of a split, SCENE/CLIP."""
    boxes = [f"{box}/{index:03d}" for box in BOXES for index in range(profile.boxes[split])]
    first = ROOMS_OF_A_SEED * seed + FIRST_ROOM[split]
    rooms = [f"room-{first + index}/000" for index in range(profile.rooms[split])]
    return boxes + rooms + profile.special.get(split, [])


def rendered_channels(reads: Iterable[str]) -> list[str]:
    """The channels to render for denoisers that read `reads`, in the order of the table."""
    wanted = ALWAYS | set(reads)
    return [name for name in CHANNELS if name in wanted]


def plan(
    profile: str, seed: int, reads: Sequence[str] = tuple(CHANNELS), options: Options = NO_OPTIONS
) -> dict[str, Any]:
    """The content of dataset.json: `reads` are the channels that training is going to read, `options` the renderer's.

    Test clips have every channel, for the metrics read them. Raises BadInput for an unknown profile or a bad seed.
    """
    if seed < 0:
        raise BadInput(f"the seed {seed} is negative: use 0 or more")
    splits = {split: clips_of(profile_of(profile), split, seed) for split in SPLITS}
    train = rendered_channels(reads)
    return {
        "schema": SCHEMA,
        "profile": profile,
        "generator": GENERATOR,
        "versions": versions(),
        "seed": seed,
        "scenes": list(dict.fromkeys(clip.split("/")[0] for clips in splits.values() for clip in clips)),
        "options": options._asdict(),
        "channels": {"train": train, "val": train, "test": list(CHANNELS)},
        "splits": splits,
    }


def clip_seed(seed: int, scene: str, split: str, number: int) -> int:
    """A seed of its own for every clip: independent of which other clips there are and of the order of rendering."""
    words = [seed, zlib.crc32(scene.encode()), zlib.crc32(split.encode()), number]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
