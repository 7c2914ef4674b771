"""How many samples a reference needs: a pilot renders a few small frames and measures their noise."""

import numpy as np

from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean
from render.clip import NO_OPTIONS, Options
from render.job.profiles import SamplingQuality
from render.shot import Shot
from render.stage import Stage
from scenes.animation import Scene

PILOT_STRIDE = 8  # every so many frames, one of half the height and width: a 32nd of a clip's pixels


def noise_of_reference(stage: Stage, frames: int, spp: int, seed: int, options: Options) -> float:
    """Mean squared error, as displayed, of references of `spp` samples for every PILOT_STRIDE-th frame."""
    halves = []
    emissions = []
    for frame in range(min(PILOT_STRIDE, frames) // 2, frames, PILOT_STRIDE):
        shot = Shot(stage, frame, options.regularise)
        halves.append([shot.reflected(seed % 2**32 ^ half, spp // 2) for half in (0, 1)])
        emissions.append(shot.emission)
    exposure = clip_exposure(luminance(np.mean(halves, axis=1)))
    shown = [display(pair + emission, exposure) for pair, emission in zip(np.array(halves), emissions, strict=True)]
    return float(np.mean([noise_of_mean(a, b) for a, b in shown]))


def samples_needed(
    scene: Scene,
    frames: int,
    height: int,
    width: int,
    quality: SamplingQuality,
    seed: int,
    options: Options = NO_OPTIONS,
) -> int:
    """Samples a pixel of both halves together that bring a clip's references down to the noise floor of `quality`.

    They are a power of two times quality.reference_spp. More than quality.most_spp is a guess: so many are not tried.

    The noise of independent samples falls as 1 / spp, so one measurement predicts how many samples suffice. But few
    samples miss paths that are rare and bright, so the noise is measured again with the predicted number until it is
    down to the floor.
    """
    spp = quality.reference_spp
    if quality.floor is None:
        return spp
    stage = Stage(scene, -(-height // 2), -(-width // 2))
    wanted_noise = 10 ** (-quality.floor / 10)
    while spp <= quality.most_spp:
        excess = noise_of_reference(stage, frames, spp, seed, options) / wanted_noise
        if excess <= 1:
            break
        spp <<= int(np.ceil(np.log2(excess)))
    return spp
