"""One frame of a scene, ready to be path-traced repeatedly."""

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage

FloatImage = NDArray[np.float64]  # (H, W, 3)


def finite_or_zero(image: NDArray[np.floating]) -> FloatImage:
    return np.nan_to_num(image.astype(np.float64), nan=0, posinf=0, neginf=0)


class PosedFrame:
    """One frame of a scene. The constructor poses `stage`; valid until it is posed again."""

    def __init__(self, stage: Stage, frame: int, regularise: bool = False):
        stage.pose(frame)
        self.stage = stage
        self.view = stage.view(frame)
        self.emission = render_gbuffer(stage, self.view)["emission"].astype(np.float64)
        self.ray = stage.rays(self.view)
        self.tracer = PathTracer(stage, regularise=regularise)

    def reflected(self, seed: int, spp: int) -> FloatImage:
        """Direct + indirect radiance (H, W, 3) of `spp` samples a pixel; non-finite values are 0."""
        return finite_or_zero(np.add(*self.tracer.radiance(self.ray, seed, spp)))

    def radiance(self, seed: int, spp: int) -> FloatImage:
        """Emitted + reflected radiance (H, W, 3)."""
        return self.reflected(seed, spp) + self.emission
