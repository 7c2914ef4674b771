"""Which rooms a data set has, where its profile passes over those whose references would need too many samples."""

from tqdm import tqdm

from datasets.adaptive_spp import samples_needed
from datasets.clip_kind import ClipKind
from datasets.profiles import DataProfile, NeededSpp, clip_seed, rooms_of
from render.clip import Options
from scenes.registry import build_scene


def needed_for(profile: DataProfile, split: str, room: str, seed: int, options: Options) -> int:
    """Samples a pixel that the references of a room, given as SCENE/CLIP, need."""
    scene, clip = room.split("/")
    seed_of_clip = clip_seed(seed, scene, split, ClipKind.of(clip).number)
    size = (profile.frames, profile.height, profile.width)
    built = build_scene(scene, seed_of_clip, profile.frames)
    return samples_needed(built, *size, profile.quality[split], seed_of_clip, options)


def choose_rooms(profile: DataProfile, seed: int, options: Options, known: NeededSpp) -> dict[str, int]:
    """`known`, and what further rooms need, until as many as the profile wants are known to be within its bounds."""
    needed = dict(known)
    for split, quality in profile.quality.items():
        while quality.passes_over:
            rooms = rooms_of(profile, split, seed, needed)
            unknown = [room for room in rooms if f"{split}/{room}" not in needed]
            if not unknown:
                break
            for room in tqdm(unknown, f"pilots for {split}", unit="room", leave=False):
                needed[f"{split}/{room}"] = needed_for(profile, split, room, seed, options)
    return needed
