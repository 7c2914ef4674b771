"""One frame of a scene, posed and ready to be path-traced as often as one likes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage

Image = NDArray[np.float64]


def finite(image: NDArray[Any]) -> Image:
    """float64, with what is not a number or not finite set to zero."""
    return np.nan_to_num(image.astype(np.float64), nan=0, posinf=0, neginf=0)


class Shot:
    """A frame as `stage` is posed for it: valid until the stage is posed anew."""

    def __init__(self, stage: Stage, frame: int, regularise: bool = False):
        stage.pose(frame)
        self.stage, self.view = stage, stage.view(frame)
        self.emission = render_gbuffer(stage, self.view)["emission"].astype(np.float64)
        self.ray, self.tracer = stage.rays(self.view), PathTracer(stage, regularise=regularise)

    def reflected(self, seed: int, spp: int) -> Image:
        """direct + indirect radiance (H, W, 3); non-finite pixels are 0."""
        return finite(np.add(*self.tracer.radiance(self.ray, seed, spp)))

    def radiance(self, seed: int, spp: int) -> Image:
        """All radiance (H, W, 3): emission, which costs no samples, and what is reflected."""
        return self.reflected(seed, spp) + self.emission
