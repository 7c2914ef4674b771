"""Pilots: small renderings that predict how many samples references need, and which rooms to skip."""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean
from errors import BadInput
from render.clip import NO_OPTIONS, Options
from render.job.plan import rooms_of, scene_of_clip
from render.job.profiles import DataProfile, SamplingQuality
from render.path import PosedFrame
from render.stage import Stage
from scenes.animation import Scene

PILOT_STRIDE = 8  # of frames, which have half the height and width: a 32nd of a clip's pixels
MAX_PILOTS = 32  # for each room of a profile


def noise_of_reference(stage: Stage, frames: int, spp: int, seed: int, options: Options) -> float:
    """Mean squared error, as displayed, of references of `spp` samples for every PILOT_STRIDE-th frame."""
    buffers = []
    emissions = []
    for index in range(min(PILOT_STRIDE, frames) // 2, frames, PILOT_STRIDE):
        frame = PosedFrame(stage, index, options.regularise)
        buffers.append([frame.reflected(seed % 2**32 ^ buffer, spp // 2) for buffer in (0, 1)])
        emissions.append(frame.emission)
    exposure = clip_exposure(luminance(np.mean(buffers, axis=1)))
    shown = [display(pair + emission, exposure) for pair, emission in zip(np.array(buffers), emissions, strict=True)]
    return float(np.mean([noise_of_mean(a, b) for a, b in shown]))


def samples_needed(
    scene: Scene, size: tuple[int, int, int], quality: SamplingQuality, seed: int, options: Options = NO_OPTIONS
) -> int:
    """Samples a pixel, of both buffers together, with which references reach the noise floor of `quality`.

    They are a power of two times quality.reference_spp. Above quality.most_spp they are extrapolated, not tried.

    The noise of independent samples falls as 1 / spp, so one measurement predicts how many suffice. But few samples
    miss rare bright paths, so the noise is measured again with the predicted number until it reaches the floor.
    """
    spp = quality.reference_spp
    if quality.floor is None:
        return spp
    frames, height, width = size
    stage = Stage(scene, -(-height // 2), -(-width // 2))
    wanted_noise = 10 ** (-quality.floor / 10)
    while spp <= quality.most_spp:
        excess = noise_of_reference(stage, frames, spp, seed, options) / wanted_noise
        if excess <= 1:
            break
        spp <<= int(np.ceil(np.log2(excess)))
    return spp


def choose_rooms(profile: DataProfile, seed: int, options: Options) -> dict[str, int]:
    """The samples a pixel that rooms, SPLIT/SCENE/CLIP, need, until enough are within the bounds of the profile.

    Raises BadInput if hardly any room is.
    """
    needed: dict[str, int] = {}
    for split, quality in profile.quality.items():
        wanted = profile.rooms.get(split, 0)
        while quality.skips_noisy_rooms:
            unknown = {f"{split}/{room}" for room in rooms_of(profile, split, seed, needed)} - set(needed)
            if not unknown:
                break
            if sum(room.startswith(f"{split}/") for room in needed) > MAX_PILOTS * wanted:
                bound = f"{quality.floor:g} dB within {quality.most_spp} spp"
                raise BadInput(f"fewer than {wanted} in {MAX_PILOTS * wanted} rooms reach {bound}: allow more samples")
            for room in tqdm(sorted(unknown), f"pilots for {split}", unit="room", leave=False):
                scene, clip_seed = scene_of_clip(Path(room), profile, seed)
                needed[room] = samples_needed(scene, profile.size, quality, clip_seed, options)
    return needed
