"""Temporal gradients: how light changes between two frames, told from samples that are shaded in both (A-SVGF §4).

Schied et al. 2018, "Gradient Estimation for Real-Time Adaptive Temporal Filtering". A sample is a function of a pixel's
random numbers and of the scene, so the same numbers at the same surface point differ by what has changed, and by little
noise. Their luminance is that of radiance: both are of one point, so its texture cancels out of their ratio.

As in the paper, a pixel of each stratum of the *previous* frame is projected forward: its sample is known, so that only
one of each pair is shaded anew. Primary visibility knows no chance here, so the surface point itself is kept, which
lands between pixel centres; where another ray finds it hidden or off the image, there is no gradient. The samples are
those of the first noise realisation, which evaluation plays; for the others the gradient is as unbiased, and
independent of their noise.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import mi
from render.gbuffer import trace_visible
from render.loading import aligned, columns
from render.motion import same_surface
from render.path import Draw, PathTracer
from scenes.camera import Array, View, move, project, unproject

STRATUM = 3  # px, the side of the squares of which each has one sample
LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])  # of linear red, green and blue (ITU-R BT.709)


def one_of_each_stratum(height: int, width: int, seed: int) -> NDArray[np.int64]:
    """Indices (N,) of one random pixel of each 3 x 3 of an image; those at its right and bottom may have fewer."""
    rng = np.random.default_rng(seed)
    top, left = np.mgrid[0:height:STRATUM, 0:width:STRATUM]
    row = top + rng.integers(0, np.minimum(STRATUM, height - top))
    column = left + rng.integers(0, np.minimum(STRATUM, width - left))
    return (row * width + column).ravel()


def luminance(radiance: NDArray[np.floating]) -> Array:
    """Luminance (N,) of `radiance` (N, 3): a function of the numbers alone, not of their order in memory."""
    red, green, blue = (LUMINANCE_WEIGHTS * radiance).T
    return red + green + blue


class Samples(NamedTuple):
    """Some samples of a frame, which can be shaded again in the next one."""

    pixel: NDArray[np.int64]  # (N,), counted row by row
    luminance: Array  # (N,), of direct + indirect light
    point: Array  # (N, 3), in the world; a direction where nothing was hit
    mesh_id: NDArray[np.integer]  # (N,)
    view: View
    poses: int  # of the stage: whether anything has changed since
    draw: Draw  # what the tracer drew them by

    @staticmethod
    def of(
        frame: dict[str, NDArray[Any]],
        direct: NDArray[np.float32],
        indirect: NDArray[np.float32],
        view: View,
        poses: int,
        draw: Draw,
        seed: int,
    ) -> "Samples":
        """One of each stratum of a `frame`, of which `direct` and `indirect` (H, W, 3) is what the tracer made."""
        height, width = direct.shape[:2]
        pixel = one_of_each_stratum(height, width, seed)
        centre = np.stack([pixel % width, pixel // width], axis=-1) + 0.5
        point = unproject(centre, frame["depth"].ravel()[pixel].astype(np.float64), view)
        light = luminance(direct.reshape(-1, 3)[pixel] + indirect.reshape(-1, 3)[pixel])
        return Samples(pixel, light, point, frame["mesh_id"].ravel()[pixel], view, poses, draw)

    def gradient(self, tracer: PathTracer, now: View) -> Array:
        """The channel `gradient` (H, W, 2) of the next frame, for which the tracer's stage must be posed.

        Luminance shaded anew minus what it was, and the larger of both, at the pixels where the samples' surface points
        are now; 0 elsewhere.
        """
        stage = tracer.stage
        gradient = np.zeros((stage.height, stage.width, 2))
        if self.poses == stage.poses and all(map(np.array_equal, self.view, now)):
            return gradient  # nothing has changed
        point = move(self.point, self.mesh_id, self.view, now)
        place = project(point, self.mesh_id > 0, now)
        visible = same_surface(point, self.mesh_id, place, trace_visible(stage, now, place), now)
        inside = ((place >= 0) & (place < (stage.width, stage.height))).all(axis=-1)
        pixel = mi.UInt32(aligned(self.pixel.astype(np.uint32)))
        direct, indirect = tracer.samples(stage.rays(now, place), pixel, *self.draw)
        shaded = luminance(columns(direct) + columns(indirect))
        pairs = np.stack([shaded - self.luminance, np.maximum(shaded, self.luminance)], axis=-1)
        column, row = place[visible & inside].astype(int).T
        gradient[row, column] = pairs[visible & inside]
        return gradient
