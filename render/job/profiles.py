"""Data profiles: which clips a dataset has, and how well they are sampled."""

import re
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from msgspec.structs import asdict

from datasets.clip import SPLITS
from errors import BadInput
from files import crc32_of
from render.scene_file.description import read_description
from render.scene_file.load import own_scene
from scenes.glass import SETTINGS
from scenes.objects.library import open_libraries


class SamplingQuality(NamedTuple):
    realisations: int  # independent ones of the noisy channels
    reference_spp: int  # samples a pixel of references, at least
    floor: float | None = None  # PSNR in dB: references get more samples until their noise is down to this,
    most_spp: int = 4096  # but no more than these
    skips_noisy_rooms: bool = False  # that would need more; the next ones take their places
    rarest: float = 1.0  # in noisy frames of half of the clips lights are sampled up to so many times more rarely


@dataclass(frozen=True)
class DataProfile:
    """The clips of a dataset, and their sampling, by split."""

    size: tuple[int, int, int]  # frames, height, width
    quality: dict[str, SamplingQuality]
    boxes: dict[str, int] = field(default_factory=dict)  # clips of each Cornell box
    rooms: dict[str, int] = field(default_factory=dict)  # rooms, of one clip each
    closeups: dict[str, int] = field(default_factory=dict)  # of further rooms, one clip each
    special: dict[str, list[str]] = field(default_factory=dict)  # further clips, SCENE/CLIP
    judged: tuple[int, ...] = ()  # the frames of test clips that get a reference; empty for all
    own: Path | None = None  # the TOML of a user's own scene, the only one
    needs_models: bool = False  # whether it is refused without `models`
    models: Path | None = None  # the furniture libraries that training and validation rooms are furnished from


FIRST_ROOM = {"train": 0, "val": 1000, "test": 2000}  # the number of a split's first room, for seed 0
# The frames after a cut, and pairs of later ones: what changes in time needs two.
JUDGED = (0, 4, 15, 16, 31, 32, 47, 48)
BENCHMARK_SCENES = ("room-3000", "room-3001", "room-3002", "glass-table", "glass-vitrine")
TEST_OF_SMALL_ROOMS = SamplingQuality(1, reference_spp=64, floor=40, most_spp=256, skips_noisy_rooms=True)

RELEASE_QUALITY = {
    "train": SamplingQuality(realisations=8, reference_spp=32),
    "val": SamplingQuality(realisations=8, reference_spp=64),
    "test": SamplingQuality(realisations=1, reference_spp=256, floor=40, most_spp=16384),
}

# To continue trainings with rooms of other people's furniture: `--models DIR`.
FURNISHED = DataProfile(
    size=(12, 128, 128),
    needs_models=True,
    rooms={"train": 80, "val": 4},
    closeups={"train": 80, "val": 4},
    quality={
        "train": SamplingQuality(realisations=4, reference_spp=96),
        "val": SamplingQuality(realisations=4, reference_spp=256),
        "test": TEST_OF_SMALL_ROOMS,
    },
)

DATA_PROFILES = {
    "tiny": DataProfile(
        size=(8, 64, 64),
        boxes=dict.fromkeys(SPLITS, 1),
        quality={
            "train": SamplingQuality(realisations=2, reference_spp=64),
            **dict.fromkeys(("val", "test"), SamplingQuality(realisations=1, reference_spp=128)),
        },
    ),
    "quick": DataProfile(
        size=(16, 128, 128),
        boxes={"train": 1, "test": 1},
        rooms={"train": 12, "val": 2},
        quality={
            "train": SamplingQuality(realisations=4, reference_spp=16),
            "val": SamplingQuality(realisations=1, reference_spp=64),
            "test": TEST_OF_SMALL_ROOMS,
        },
        special={"test": ["room-2004/000", "room-2007/000"]},
    ),
    # Whole rooms, and parts of others with the resolution of large images.
    "release": DataProfile(
        size=(12, 128, 128),
        boxes={"test": 1},
        rooms={"train": 128, "val": 8, "test": 6},
        closeups={"train": 128, "val": 4},
        quality=RELEASE_QUALITY,
        special={"test": [f"cornell_box_moving/{clip}" for clip in ("still", "000-4spp", "000-64spp", "000-256spp")]},
    ),
    # The same at the size that other people's trainers want: the default loss of OIDN's needs more than 160 px.
    "release-256": DataProfile(
        size=(12, 256, 256),
        rooms={"train": 128, "val": 8, "test": 6},
        closeups={"train": 128, "val": 4},
        quality=RELEASE_QUALITY,
    ),
    "furnished": FURNISHED,
    # Larger, and in half of the clips light is as hard to find as in many scenes by others.
    "furnished-192": replace(
        FURNISHED,
        size=(12, 192, 192),
        rooms={"train": 104, "val": 4},
        closeups={"train": 96, "val": 4},
        quality=FURNISHED.quality
        | {
            "train": SamplingQuality(realisations=4, reference_spp=128, rarest=64.0),
            "val": SamplingQuality(realisations=4, reference_spp=256, rarest=64.0),
        },
    ),
    # Scenes that no training uses, at a size at which people look, until the history is steady.
    "benchmark": DataProfile(
        size=(49, 360, 640),
        quality=dict.fromkeys(SPLITS, SamplingQuality(realisations=1, reference_spp=256, floor=35, most_spp=2048)),
        special={"test": [f"{name}/000" for name in BENCHMARK_SCENES]},
        judged=JUDGED,
    ),
    # Six scenes of glass: at rest, with a camera that moves, and with things that move.
    "glass": DataProfile(
        size=(12, 144, 256),
        quality=dict.fromkeys(SPLITS, SamplingQuality(realisations=1, reference_spp=256, floor=35, most_spp=2048)),
        special={
            "test": [clip for name in SETTINGS for clip in (f"{name}/still", f"{name}/000", f"{name}-moving/000")]
        },
    ),
}


def own_profile(path: Path) -> DataProfile:
    """The profile in the TOML of a user's own scene. Raises BadInput, naming the file, if it cannot be used."""
    described = read_description(path)
    name = re.sub(r"[^\w-]", "_", path.stem)
    clips: dict[str, list[str]] = {}
    quality: dict[str, SamplingQuality] = {}
    for split, wanted in asdict(described.splits).items():
        clips[split] = [f"{name}/{number:03d}" for number in range(wanted.clips)]
        quality[split] = SamplingQuality(wanted.realisations, wanted.reference_spp, wanted.floor, wanted.most_spp)
    if not any(clips.values()):
        raise BadInput(f"{path}: no split has any clips")
    width, height = described.resolution
    judged = described.splits.test.judged
    return DataProfile((described.frames, height, width), quality, special=clips, judged=judged, own=path)


def source_of(profile: DataProfile) -> dict[str, str]:
    """The TOML of a user's own scene and its scene file, as that names it, with crc32 of all that is read; else none.

    Raises BadInput where one cannot be read.
    """
    if profile.own is None:
        return {}
    scene = own_scene(profile.own)
    try:
        crcs = [crc32_of(file) for file in sorted(set(scene.files))]
        content = f"{zlib.crc32(''.join(crcs).encode()):08x}"
        return {profile.own.name: crc32_of(profile.own), scene.described.file: content}
    except OSError as error:
        raise BadInput(f"{error.filename} cannot be read: {error.strerror}") from None


def furniture_of(profile: DataProfile) -> dict[str, Any]:
    """The furniture libraries of a profile: their files with crc32, and credits; else nothing.

    Raises BadInput where the folder has none.
    """
    if profile.models is None:
        return {}
    libraries = open_libraries(profile.models)
    files = {library.file.name: crc32_of(library.file) for library in libraries}
    return {"files": files, "credits": [library.credit() for library in libraries]}


def profile_of(name: str, models: str = "") -> DataProfile:
    """The data profile of that name: one of DATA_PROFILES, `rooms-NxS` for N rooms of S spp, or the path of a TOML.

    `models` is a folder of furniture libraries, or empty. Raises BadInput for other names.
    """
    described = named_profile(name)
    return replace(described, models=Path(models)) if models else described


def named_profile(name: str) -> DataProfile:
    if name.endswith(".toml"):
        return own_profile(Path(name))
    if match := re.fullmatch(r"rooms-(\d+)x(\d+)", name):
        rooms, spp = int(match[1]), int(match[2])
        if rooms < 1 or spp < 2:
            raise BadInput(f"profile '{name}': at least 1 room, and 2 spp or more for the two buffers of a reference")
        if rooms > FIRST_ROOM["val"]:
            raise BadInput(f"profile '{name}': at most {FIRST_ROOM['val']} rooms; the next ones are not to train on")
        # Small rooms to train on, and a few to validate and test.
        qualities = [SamplingQuality(8, spp), SamplingQuality(8, reference_spp=64), TEST_OF_SMALL_ROOMS]
        counts = {"train": rooms, "val": 3, "test": 4}
        return DataProfile((12, 96, 96), dict(zip(SPLITS, qualities, strict=True)), rooms=counts)
    if name not in DATA_PROFILES:
        names = ", ".join([*DATA_PROFILES, "rooms-NxS"])
        raise BadInput(f"unknown profile '{name}'; the profiles are {names}; a scene of your own is a .toml")
    return DATA_PROFILES[name]
