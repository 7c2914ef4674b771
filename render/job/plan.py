"""The plan of a dataset: its clips, their seeds, scenes and channels."""

import zlib
from collections.abc import Mapping, Sequence
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np

from datasets.channels import CHANNELS, SAMPLE_BUFFERS, USUAL_CHANNELS
from datasets.clip import SCHEMA, SPLITS, ClipKind
from errors import BadInput
from provenance import RENDERING, versions
from render.clip import NO_OPTIONS, Options
from render.job.profiles import FIRST_ROOM, DataProfile, furniture_of, profile_of, source_of
from render.scene_file.load import own_scene
from scenes.animation import Scene, frozen
from scenes.registry import build_scene

GENERATOR = 15  # to be increased when the same seed renders different bytes
NeededSpp = Mapping[str, int]  # SPLIT/SCENE/CLIP: samples a pixel that references need, where a pilot has measured it
NO_PILOTS: NeededSpp = {}
BOXES = ("cornell_box", "cornell_box_moving")
ROOMS_OF_A_SEED = 10_000


def furnishing(profile: DataProfile, split: str) -> str:
    """What the names of a split's rooms begin with. Those to test on are the same with any furniture."""
    return "furnished-" if profile.models and split != "test" else ""


def rooms_of(profile: DataProfile, split: str, seed: int, needed_spp: NeededSpp) -> list[str]:
    """The rooms of a split, each as SCENE/CLIP: the first ones that are not skipped."""
    quality = profile.quality[split]
    furnished = furnishing(profile, split)
    names = (f"{furnished}room-{number}/000" for number in count(ROOMS_OF_A_SEED * seed + FIRST_ROOM[split]))
    if quality.skips_noisy_rooms:
        names = (name for name in names if needed_spp.get(f"{split}/{name}", 0) <= quality.most_spp)
    return list(islice(names, profile.rooms.get(split, 0)))


def clips_of(profile: DataProfile, split: str, seed: int, needed_spp: NeededSpp = NO_PILOTS) -> list[str]:
    """All clips of a split, each as SCENE/CLIP, for the dataset with that seed. Close-ups are of other rooms."""
    boxes = [f"{box}/{index:03d}" for box in BOXES for index in range(profile.boxes.get(split, 0))]
    first = ROOMS_OF_A_SEED * seed + FIRST_ROOM[split] + profile.rooms.get(split, 0)
    furnished = furnishing(profile, split)
    closeups = [f"{furnished}closeup-{number}/000" for number in range(first, first + profile.closeups.get(split, 0))]
    return boxes + rooms_of(profile, split, seed, needed_spp) + closeups + profile.special.get(split, [])


def plan(
    profile: str,
    seed: int,
    reads: Sequence[str] = USUAL_CHANNELS,
    options: Options = NO_OPTIONS,
    needed_spp: NeededSpp = NO_PILOTS,
    models: str = "",
) -> dict[str, Any]:
    """The content of dataset.json.

    Clips for training and validation get the essential channels and those in `reads`; test clips get all for metrics,
    but sample buffers only if `reads` names them. Raises BadInput for an unknown profile, and for one without its
    furniture.
    """
    described = profile_of(profile, models)
    if described.needs_models and not models:
        raise BadInput(f"the profile {profile} needs furniture: --models DIR (docs/data.md says where to get it)")
    splits = {split: clips_of(described, split, seed, needed_spp) for split in SPLITS}
    if not set(SAMPLE_BUFFERS.values()).isdisjoint(reads):  # direct and indirect light are sampled together
        reads = (*reads, *SAMPLE_BUFFERS.values())
    train = [name for name, channel in CHANNELS.items() if channel.essential or name in reads]
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
        "models": furniture_of(described),
        "source": source_of(described),
        "notes": [] if described.own is None else own_scene(described.own).notes,
    }


def rarity_of_clip(seed: int, rarest: float) -> float:
    """How many times more rarely lights are sampled in noisy frames of a clip: 1 in half of them, up to `rarest`."""
    chance, exponent = np.random.default_rng([seed, zlib.crc32(b"rarity")]).random(2)
    return float(rarest**exponent) if chance < 0.5 else 1.0


def scene_of_clip(folder: Path, profile: DataProfile, dataset_seed: int) -> tuple[Scene, int]:
    """The scene and the 64-bit seed, independent of other clips, of the clip whose path ends in SPLIT/SCENE/CLIP.

    Raises BadInput for an unknown scene or clip name, and for a user's own scene that cannot be used.
    """
    split, scene_name, clip_name = folder.parts[-3:]
    kind = ClipKind.of(clip_name)
    words = [dataset_seed, zlib.crc32(scene_name.encode()), zlib.crc32(split.encode()), kind.number]
    seed = int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])
    if profile.own is None:
        scene = build_scene(scene_name, seed, profile.size[0], profile.models)
    else:
        scene = own_scene(profile.own).clip(split, kind.number, profile.size[0], seed)
    return (frozen(scene) if kind.still else scene), seed
