"""Which rooms a data set has, where its profile passes over those whose references would need too many samples."""

from pathlib import Path

from tqdm import tqdm

from errors import BadInput
from render.clip import Options
from render.job.adaptive_spp import samples_needed
from render.job.clip_scene import scene_of_clip
from render.job.profiles import DataProfile, NeededSpp, rooms_of

MOST_TRIED = 32  # rooms for each that is wanted


def needed_for(profile: DataProfile, room: str, seed: int, options: Options) -> int:
    """Samples a pixel that the references of a room, given as SPLIT/SCENE/CLIP, need."""
    scene, seed_of_clip = scene_of_clip(Path(room), profile, seed)
    quality = profile.quality[room.split("/")[0]]
    return samples_needed(scene, profile.frames, profile.height, profile.width, quality, seed_of_clip, options)


def choose_rooms(profile: DataProfile, seed: int, options: Options, known: NeededSpp) -> dict[str, int]:
    """`known`, and what further rooms need, until as many as the profile wants are known to be within its bounds.

    Raises BadInput where next to no room is.
    """
    needed = dict(known)
    for split, quality in profile.quality.items():
        wanted = profile.rooms[split]
        while quality.passes_over:
            unknown = {f"{split}/{room}" for room in rooms_of(profile, split, seed, needed)} - set(needed)
            if not unknown:
                break
            if sum(room.startswith(f"{split}/") for room in needed) > MOST_TRIED * wanted:
                bound = f"{quality.floor:g} dB within {quality.most_spp} spp"
                raise BadInput(f"fewer than {wanted} in {MOST_TRIED * wanted} rooms reach {bound}: allow more samples")
            for room in tqdm(sorted(unknown), f"pilots for {split}", unit="room", leave=False):
                needed[room] = needed_for(profile, room, seed, options)
    return needed
