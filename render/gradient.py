"""Temporal gradients: the change of light between two frames, from samples that are shaded in both (A-SVGF §4).

Schied et al. 2018, "Gradient Estimation for Real-Time Adaptive Temporal Filtering". The same random numbers at the same
surface point give samples that differ only by what has changed, with little noise. Their luminance is that of radiance,
not of irradiance: the texture at the point cancels out of their ratio.

As in the paper, one pixel of each stratum of the *previous* frame is projected forward, so that only one of each pair
of samples is shaded anew. Primary visibility is free of noise, so the surface point itself is kept, and lands between
pixel centres; where it is hidden or outside the image, the gradient is 0. The samples are those of the first noise
realisation, which evaluation plays; for the others the gradient is unbiased too, and independent of their noise.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.channels import LUMINANCE_WEIGHTS, STRATUM
from render.backend import mi
from render.gbuffer import Arrays, trace_visible
from render.loading import columns, uploaded
from render.motion import is_same_surface
from render.path import PathTracer, SampleRange
from scenes.camera import Array, View, move, project, unproject


def pixel_of_each_stratum(height: int, width: int, seed: int) -> NDArray[np.int64]:
    """Indices (N,) of one random pixel of each stratum; those at the right and bottom may be smaller."""
    rng = np.random.default_rng(seed)
    top, left = np.mgrid[0:height:STRATUM, 0:width:STRATUM]
    row = top + rng.integers(0, np.minimum(STRATUM, height - top))
    column = left + rng.integers(0, np.minimum(STRATUM, width - left))
    return (row * width + column).ravel()


def sample_luminance(radiance: NDArray[np.floating]) -> Array:
    """Luminance (N,) of `radiance` (N, 3), bit by bit independent of its memory layout, unlike a matrix product."""
    red, green, blue = (np.array(LUMINANCE_WEIGHTS) * radiance).T
    return red + green + blue


class GradientSamples(NamedTuple):
    """Some samples of a frame, to be shaded again in the next one."""

    pixel: NDArray[np.int64]  # (N,), row-major index
    luminance: Array  # (N,), of direct + indirect light
    point: Array  # (N, 3), in the world; a direction where nothing was hit
    mesh_id: NDArray[np.integer]  # (N,)
    view: View
    poses: int  # of the stage, to detect changes
    draw: SampleRange  # which samples of the tracer they are

    @staticmethod
    def of(
        frame: Arrays, light: NDArray[np.float32], view: View, poses: int, draw: SampleRange, seed: int
    ) -> "GradientSamples":
        """One of each stratum of a `frame`, whose samples have that `light` (H, W, 3)."""
        height, width = light.shape[:2]
        pixel = pixel_of_each_stratum(height, width, seed)
        centre = np.stack([pixel % width, pixel // width], axis=-1) + 0.5
        point = unproject(centre, frame["depth"].ravel()[pixel].astype(np.float64), view)
        luminance = sample_luminance(light.reshape(-1, 3)[pixel])
        return GradientSamples(pixel, luminance, point, frame["mesh_id"].ravel()[pixel], view, poses, draw)

    def gradient(self, tracer: PathTracer, now: View) -> Array:
        """The channel `gradient` (H, W, 2) of the next frame, for which the tracer's stage must be posed.

        The change of luminance and the larger of both values, at the pixels where the samples' points are now; 0
        elsewhere.
        """
        stage = tracer.stage
        gradient = np.zeros((stage.height, stage.width, 2))
        if self.poses == stage.poses and all(map(np.array_equal, self.view, now)):
            return gradient  # nothing has changed
        point = move(self.point, self.mesh_id, self.view, now)
        place = project(point, self.mesh_id > 0, now)
        visible = is_same_surface(point, self.mesh_id, place, trace_visible(stage, now, place), now)
        inside = ((place >= 0) & (place < (stage.width, stage.height))).all(axis=-1)
        pixel = uploaded(self.pixel.astype(np.uint32), mi.UInt32)
        direct, indirect, *_ = tracer.samples(stage.rays(now, place), pixel, *self.draw)
        shaded = sample_luminance(columns(direct) + columns(indirect))
        pairs = np.stack([shaded - self.luminance, np.maximum(shaded, self.luminance)], axis=-1)
        column, row = place[visible & inside].astype(int).T
        gradient[row, column] = pairs[visible & inside]
        return gradient
