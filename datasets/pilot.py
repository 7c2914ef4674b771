"""How many samples a reference needs: a few frames are rendered with few and their noise is measured."""

import numpy as np

from datasets.display import clip_exposure, display, luminance, noise_of_halves
from datasets.profiles import Quality
from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Scene


def reference_spp(scene: Scene, frames: int, height: int, width: int, quality: Quality, seed: int) -> int:
    """Samples of both halves together, a power of two times quality.reference_spp.

    The noise of independent samples falls as 1 / spp; ours stratify and fall faster, so this errs to the better side,
    but for paths so rare that the pilot has missed them.
    """
    if quality.floor is None:
        return quality.reference_spp
    stage = Stage(scene, height, width)
    tracer, halves, emissions = PathTracer(stage), [], []
    for frame in sorted({0, frames // 2, frames - 1}):
        stage.pose(frame)
        view = stage.view(frame)
        ray = stage.rays(view)
        emissions.append(render_gbuffer(stage, view)["emission"])
        images = [np.add(*tracer.radiance(ray, seed % 2**32 ^ half, quality.reference_spp // 2)) for half in (0, 1)]
        halves.append(np.nan_to_num(images, nan=0, posinf=0, neginf=0).astype(np.float64))
    exposure = clip_exposure(luminance(np.mean(halves, axis=1)))
    shown = [display(pair + emission, exposure) for pair, emission in zip(halves, emissions, strict=True)]
    noise = float(np.mean([noise_of_halves(a, b) for a, b in shown]))
    doublings = int(np.ceil(np.log2(max(noise / 10 ** (-quality.floor / 10), 1))))
    return min(quality.reference_spp << doublings, quality.most_spp)
