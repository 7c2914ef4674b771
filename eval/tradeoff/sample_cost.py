"""What samples cost: milliseconds of path tracing a frame."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from render.backend import VARIANT, dr
from render.clip import Options
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Scene

RENDERER = VARIANT.partition("_")[0].replace("llvm", "cpu")  # the device that renders: cpu or cuda
SPP, REPEATS = (1, 2, 4, 8), 3


class Cost(NamedTuple):
    """Milliseconds of a frame: those that come with any number of samples (rays, first hits), and of each sample."""

    frame_ms: float
    sample_ms: float

    def of(self, spp: int) -> float:
        return self.frame_ms + self.sample_ms * spp


@contextmanager
def render_threads(count: int) -> Iterator[None]:
    before = dr.thread_count()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def line(spp: list[int], ms: list[float]) -> Cost:
    """The line through measured times, by least squares; neither part is below 0."""
    sample_ms, frame_ms = np.polyfit(spp, ms, 1)
    return Cost(max(0.0, float(frame_ms)), max(0.0, float(sample_ms)))


def sample_cost(scene: Scene, height: int, width: int, threads: int, options: Options) -> Cost:
    """Measured on the scene's first frame, without its G-buffer, which costs the same whatever the samples."""
    stage = Stage(scene, height, width)
    stage.pose(0)
    ray, tracer = stage.rays(stage.view(0)), PathTracer(stage, *options)
    spent: dict[int, list[float]] = {spp: [] for spp in SPP}
    with render_threads(threads):
        for repeat in range(-1, REPEATS):  # the first time compiles
            for spp in SPP:  # interleaved, so that drift of the machine hits all alike
                start = time.perf_counter()
                tracer.radiance(ray, 1 + repeat, spp)
                spent[spp] += [1e3 * (time.perf_counter() - start)] if repeat >= 0 else []
    return line([*SPP], [float(np.median(spent[spp])) for spp in SPP])
