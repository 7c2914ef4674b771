"""Milliseconds of path tracing per frame and per sample."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from render.backend import VARIANT, dr
from render.clip import Options
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Scene
from timing import take_turns

RENDERER = VARIANT.partition("_")[0].replace("llvm", "cpu")  # the device that renders: cpu or cuda
TIMED_SPP = (1, 2, 4, 8)
TIMED_FRAMES_EACH = 3  # after a first one, which compiles kernels


class Cost(NamedTuple):
    """Milliseconds of a frame: a constant part (rays, first hits) and a part per sample."""

    frame_ms: float
    sample_ms: float

    def of(self, spp: int) -> float:
        return self.frame_ms + self.sample_ms * spp


@contextmanager
def render_threads(threads: int) -> Iterator[None]:
    """Dr.Jit uses `threads` threads within the context."""
    before = dr.thread_count()
    dr.set_thread_count(threads)
    try:
        yield
    finally:
        dr.set_thread_count(before)


def fit_cost(spp: Sequence[int], ms: Sequence[float]) -> Cost:
    """The line through measured times, by least squares; neither part is below 0."""
    sample_ms, frame_ms = np.polyfit(spp, ms, 1)
    return Cost(max(0.0, float(frame_ms)), max(0.0, float(sample_ms)))


def tracing(tracer: PathTracer, ray: Any, spp: int) -> Callable[[], None]:
    """A function that traces `spp` samples per pixel, with a different seed at every call."""
    seeds = count()

    def trace() -> None:
        tracer.radiance(ray, next(seeds), spp)

    return trace


def sample_cost(scene: Scene, height: int, width: int, threads: int, options: Options) -> Cost:
    """The cost of the scene's first frame, without its G-buffer, whose time does not depend on samples."""
    stage = Stage(scene, height, width)
    stage.pose(0)
    ray = stage.rays(stage.view(0))
    tracer = PathTracer(stage, *options)
    work = {f"{spp} spp": tracing(tracer, ray, spp) for spp in TIMED_SPP}
    with render_threads(threads):
        seconds = take_turns(work, TIMED_FRAMES_EACH, label="samples")
    return fit_cost(TIMED_SPP, [1e3 * median(spent) for spent in seconds.values()])
