"""Data profiles: which clips a data set has, and how well each is sampled."""

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from datasets.channels import CHANNELS, SAMPLE_BUFFERS, USUAL_CHANNELS
from datasets.clip import SCHEMA, SPLITS
from errors import BadInput
from provenance import RENDERING, versions
from render.clip import NO_OPTIONS, Options
from render.scene_file.load import own_scene
from scenes.description import Split, read_description

GENERATOR = 8  # raise it when the same seed renders different bytes

# Without these a clip has no picture, no reference or no geometry that other channels could be derived from.
ESSENTIAL_CHANNELS = {name for name, channel in CHANNELS.items() if channel.essential}


class SamplingQuality(NamedTuple):
    """How well the clips of a split are sampled."""

    realisations: int  # independent ones of the noisy channels
    reference_spp: int  # samples a pixel of references, at least
    floor: float | None = None  # PSNR in dB: references get more samples until their noise is down to this,
    most_spp: int = 4096  # but no more than these
    passes_over: bool = False  # rooms that would need more; the next ones take their places


@dataclass(frozen=True)
class DataProfile:
    """What a data set holds, by split where it depends on it."""

    height: int
    width: int
    frames: int
    boxes: dict[str, int]  # clips of each Cornell box
    rooms: dict[str, int]  # rooms, of one clip each
    quality: dict[str, SamplingQuality]
    closeups: dict[str, int] = field(default_factory=dict)  # of further rooms, one clip each
    special: dict[str, list[str]] = field(default_factory=dict)  # further clips, SCENE/CLIP
    own: Path | None = None  # the TOML of a user's own scene, whose clips all are


NeededSpp = Mapping[str, int]  # SPLIT/SCENE/CLIP: samples a pixel that its references need, where a pilot found out
NO_PILOTS: NeededSpp = {}
BOXES = ("cornell_box", "cornell_box_moving")
FIRST_ROOM = {"train": 0, "val": 1000, "test": 2000}  # the number of a split's first room, for seed 0
ROOMS_OF_A_SEED = 10_000

TEST_OF_SMALL_ROOMS = SamplingQuality(realisations=1, reference_spp=64, floor=40, most_spp=256, passes_over=True)

DATA_PROFILES = {
    "tiny": DataProfile(
        height=64,
        width=64,
        frames=8,
        boxes={"train": 1, "val": 1, "test": 1},
        rooms={"train": 0, "val": 0, "test": 0},
        quality={
            "train": SamplingQuality(realisations=2, reference_spp=64),
            "val": SamplingQuality(realisations=1, reference_spp=128),
            "test": SamplingQuality(realisations=1, reference_spp=128),
        },
    ),
    "quick": DataProfile(
        height=128,
        width=128,
        frames=16,
        boxes={"train": 1, "val": 0, "test": 1},
        rooms={"train": 24, "val": 2, "test": 2},
        quality={
            "train": SamplingQuality(realisations=4, reference_spp=32),
            "val": SamplingQuality(realisations=1, reference_spp=64),
            "test": TEST_OF_SMALL_ROOMS,
        },
    ),
    # Rooms as those of release in minutes, small and short, to see how hard they are.
    "sketch": DataProfile(
        height=64,
        width=64,
        frames=4,
        boxes={"train": 0, "val": 0, "test": 0},
        rooms={"train": 64, "val": 8, "test": 0},
        quality=dict.fromkeys(SPLITS, SamplingQuality(realisations=1, reference_spp=64)),
    ),
    # Whole rooms, and parts of others as fine as large pictures show them.
    "release": DataProfile(
        height=128,
        width=128,
        frames=12,
        boxes={"train": 0, "val": 0, "test": 1},
        rooms={"train": 128, "val": 8, "test": 6},
        closeups={"train": 128, "val": 4},
        quality={
            "train": SamplingQuality(realisations=8, reference_spp=32),
            "val": SamplingQuality(realisations=8, reference_spp=64),
            "test": SamplingQuality(realisations=1, reference_spp=256, floor=40, most_spp=16384),
        },
        special={
            "test": [
                "cornell_box_moving/still",
                "cornell_box_moving/000-4spp",
                "cornell_box_moving/000-64spp",
                "cornell_box_moving/000-256spp",
            ]
        },
    ),
}


def rooms_profile(rooms: int, spp: int) -> DataProfile:
    """So many small rooms to train on, with references of so many samples a pixel, and a few to validate and judge."""
    return DataProfile(
        height=96,
        width=96,
        frames=12,
        boxes=dict.fromkeys(SPLITS, 0),
        rooms={"train": rooms, "val": 3, "test": 4},
        quality={
            "train": SamplingQuality(realisations=8, reference_spp=spp),
            "val": SamplingQuality(realisations=8, reference_spp=64),
            "test": TEST_OF_SMALL_ROOMS,
        },
    )


# Of a user's own scene, where its TOML does not say.
OWN_CLIPS = {"train": 4, "val": 1, "test": 1}
OWN_QUALITY = {
    "train": SamplingQuality(realisations=4, reference_spp=128),
    "val": SamplingQuality(realisations=1, reference_spp=256),
    "test": SamplingQuality(realisations=1, reference_spp=256, floor=35, most_spp=2048),
}


def own_profile(path: Path) -> DataProfile:
    """What the TOML of a user's own scene asks for. Raises BadInput, naming the file, where it cannot be used."""
    described = read_description(path)
    width, height = described.resolution
    name = re.sub(r"[^\w-]", "_", path.stem)
    clips: dict[str, list[str]] = {}
    quality: dict[str, SamplingQuality] = {}
    for split in SPLITS:
        wanted = described.splits.get(split, Split())
        count = OWN_CLIPS[split] if wanted.clips is None else wanted.clips
        clips[split] = [f"{name}/{number:03d}" for number in range(count)]
        said = {key: getattr(wanted, key) for key in ("realisations", "reference_spp", "floor", "most_spp")}
        quality[split] = OWN_QUALITY[split]._replace(**{key: value for key, value in said.items() if value is not None})
    if not any(clips.values()):
        raise BadInput(f"{path}: no split has any clips")
    none = dict.fromkeys(SPLITS, 0)
    return DataProfile(height, width, described.frames, none, none, quality, special=clips, own=path)


def source_of(profile: DataProfile) -> dict[str, str]:
    """The files that a user's own scene comes from, with the crc32 of each; none of built-in scenes.

    Raises BadInput, naming the file, where one cannot be read.
    """
    if profile.own is None:
        return {}
    files = [profile.own, profile.own.parent / read_description(profile.own).file]
    try:
        return {str(file): f"{zlib.crc32(file.read_bytes()):08x}" for file in files}
    except OSError as error:
        raise BadInput(f"{error.filename} cannot be read: {error.strerror}") from None


def notes_of(profile: DataProfile) -> list[str]:
    """What of a user's own scene is not honoured, and what stands in for it, in words."""
    return [] if profile.own is None else own_scene(profile.own).notes


def profile_of(name: str) -> DataProfile:
    """The data profile of that name; for `rooms-NxS` N rooms of S spp, for a path of a TOML a user's own scene.

    Raises BadInput for an unknown one.
    """
    if name.endswith(".toml"):
        return own_profile(Path(name))
    rooms = re.fullmatch(r"rooms-(\d+)x(\d+)", name)
    if rooms and (int(rooms[1]) < 1 or int(rooms[2]) < 2):
        raise BadInput(f"profile '{name}': name 1 room or more, and 2 spp or more for the two halves of a reference")
    if rooms:
        return rooms_profile(int(rooms[1]), int(rooms[2]))
    if name not in DATA_PROFILES:
        raise BadInput(
            f"unknown profile '{name}'; the profiles are {', '.join(DATA_PROFILES)}; a scene of your own is a .toml"
        )
    return DATA_PROFILES[name]


def rooms_of(profile: DataProfile, split: str, seed: int, needed_spp: NeededSpp) -> list[str]:
    """The rooms of a split, each as SCENE/CLIP: the first ones but those that are passed over."""
    quality = profile.quality[split]
    first = ROOMS_OF_A_SEED * seed + FIRST_ROOM[split]
    names = (f"room-{number}/000" for number in count(first))
    suitable = (
        name for name in names if not quality.passes_over or needed_spp.get(f"{split}/{name}", 0) <= quality.most_spp
    )
    return list(islice(suitable, profile.rooms[split]))


def closeups_of(profile: DataProfile, split: str, seed: int) -> list[str]:
    """The close-ups of a split, each as SCENE/CLIP, none of a room that is there as a whole."""
    first = ROOMS_OF_A_SEED * seed + FIRST_ROOM[split] + profile.rooms[split]
    return [f"closeup-{number}/000" for number in range(first, first + profile.closeups.get(split, 0))]


def clips_of(profile: DataProfile, split: str, seed: int, needed_spp: NeededSpp = NO_PILOTS) -> list[str]:
    """All clips of a split, each as SCENE/CLIP, of the data set with that seed, by what pilots have found."""
    boxes = [f"{box}/{index:03d}" for box in BOXES for index in range(profile.boxes[split])]
    rooms = rooms_of(profile, split, seed, needed_spp) + closeups_of(profile, split, seed)
    return boxes + rooms + profile.special.get(split, [])


def rendered_channels(reads: Iterable[str]) -> list[str]:
    """The channels to render for denoisers that read `reads`, in the order of the channel table."""
    wanted = ESSENTIAL_CHANNELS | set(reads)
    return [name for name in CHANNELS if name in wanted]


def check_seed(seed: int) -> None:
    """Raise BadInput for a negative seed of a data set."""
    if seed < 0:
        raise BadInput(f"the seed {seed} is negative: use 0 or more")


def plan(
    profile: str,
    seed: int,
    reads: Sequence[str] = USUAL_CHANNELS,
    options: Options = NO_OPTIONS,
    needed_spp: NeededSpp = NO_PILOTS,
) -> dict[str, Any]:
    """The content of dataset.json.

    Clips for training and validation get the channels that can be derived from nothing else and those in `reads`;
    test clips get all, because metrics read them, but halves of noisy frames only where `reads` names them.
    Raises BadInput for an unknown profile or a negative seed.
    """
    check_seed(seed)
    described = profile_of(profile)
    splits = {split: clips_of(described, split, seed, needed_spp) for split in SPLITS}
    if not set(SAMPLE_BUFFERS.values()).isdisjoint(reads):  # direct and indirect light are drawn together
        reads = (*reads, *SAMPLE_BUFFERS.values())
    train = rendered_channels(reads)
    test = [name for name in CHANNELS if name in USUAL_CHANNELS or name in reads]
    return {
        "schema": SCHEMA,
        "profile": profile,
        "generator": GENERATOR,
        "versions": versions(RENDERING),
        "seed": seed,
        "scenes": list(dict.fromkeys(clip.split("/")[0] for clips in splits.values() for clip in clips)),
        "options": options._asdict(),
        "channels": {"train": train, "val": train, "test": test},
        "splits": splits,
        "needed_spp": dict(needed_spp),
        "source": source_of(described),
        "notes": notes_of(described),
    }


def clip_seed(seed: int, scene: str, split: str, number: int) -> int:
    """The seed of a clip, 64 bits, whatever other clips there are. `seed` is that of the data set."""
    words = [seed, zlib.crc32(scene.encode()), zlib.crc32(split.encode()), number]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
