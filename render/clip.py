"""Renders a clip frame by frame, with all its channels."""

import time
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import render_gbuffer
from render.gradient import Samples
from render.hit_distance import HIT_CHANNELS, hit_channels
from render.motion import dual_motion_vectors
from render.path import Draw, PathTracer
from render.stage import Stage
from render.tracking import causes, tracked_motion
from scenes.animation import Scene
from scenes.camera import View, motion_vectors, pixel_centres

Arrays = dict[str, NDArray[Any]]  # channels of one frame by name


class Options(NamedTuple):
    """What the papers' renderers did: Halton cycles in noisy frames, regularised paths in these and in references."""

    halton: bool = False
    regularise: bool = False


NO_OPTIONS = Options()


class Sampling(NamedTuple):
    """Samples of a frame: `realisations` of `noisy_spp` a pixel, and a reference of `reference_spp` in two halves."""

    realisations: int
    noisy_spp: int
    reference_spp: int
    options: Options = NO_OPTIONS


class StepTimer:
    """Seconds by step since it was last read."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Leave out the time until now."""
        self.last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Count the time since the last lap as `step`."""
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self.last
        self.last = now

    def read(self) -> dict[str, float]:
        """Seconds by step; the count begins anew."""
        seconds = self.seconds
        self.seconds = {}
        return seconds


NOISY_STREAM = 0
REFERENCE_STREAM = 1
GRADIENT_STREAM = 2
OTHER_HALF_STREAM = 3


def stream_seed(seed: int, frame: int, stream: int, index: int) -> int:
    """A 32-bit seed of its own for every frame and realisation (NOISY_STREAM), reference half, choice of samples."""
    return int(np.random.SeedSequence([seed, frame, stream, index]).generate_state(1)[0])


def noise_free_frames(stage: Stage, frames: int, wants_dual: bool, timer: StepTimer) -> Iterator[tuple[View, Arrays]]:
    """Yield for each frame its view, G-buffer and motion vectors, with the stage posed for it.

    Dual motion vectors need rays through the scene as it stood a frame before, so the G-buffer is a frame ahead.
    """
    centres = pixel_centres(stage.height, stage.width)
    view = stage.view(0)
    arrays = render_gbuffer(stage, view)
    arrays["motion"] = arrays["dual_motion"] = np.zeros_like(centres)
    if stage.has_mirrors:
        arrays["mirrored_motion"] = arrays["motion"]
    timer.lap("gbuffer")
    for following in range(1, frames):
        stage.pose(following)
        following_view = stage.view(following)
        ahead = render_gbuffer(stage, following_view)
        timer.lap("gbuffer")
        depth = ahead["depth"][..., 0].astype(np.float64)
        mesh_id = ahead["mesh_id"][..., 0]
        motion = motion_vectors(centres, depth, mesh_id, following_view, view)
        ahead["motion"] = motion
        if stage.has_mirrors:
            shown = ahead["mirrored_depth"][..., 0].astype(np.float64), ahead["mirrored_mesh_id"][..., 0]
            ahead["mirrored_motion"] = motion_vectors(centres, *shown, following_view, view)
        timer.lap("motion")
        stage.pose(following - 1)
        timer.lap("gbuffer")
        if wants_dual:
            ahead["dual_motion"] = dual_motion_vectors(stage, depth, mesh_id, motion, following_view, view)
            timer.lap("dual_motion")
        yield view, arrays
        timer.start()
        view = following_view
        arrays = ahead
    stage.pose(frames - 1)
    timer.lap("gbuffer")
    yield view, arrays


def render_clip(
    scene: Scene,
    frames: int,
    height: int,
    width: int,
    sampling: Sampling,
    seed: int,
    channels: Collection[str] | None = None,
) -> Iterator[tuple[Arrays, dict[str, float]]]:
    """Yield for each frame its channels, named and shaped as on disk (without the frame axis), and seconds by step.

    With `channels` only those are yielded, in a scene with mirrors also `mirrored_`NAME of what they show, and the time
    that the others alone would take is saved. Noisy frames of an even number of samples a pixel are drawn in two halves
    where these are named, which makes them other samples.

    Deterministic in its arguments on one variant and processor.
    """
    stage = Stage(scene, height, width)
    halton, regularise = sampling.options
    tracer = PathTracer(stage, regularise=regularise)
    noisy_tracer = PathTracer(stage, halton, regularise) if halton else tracer
    wants_dual = channels is None or "dual_motion" in channels
    wants_tracked = channels is None or "shadow_motion" in channels or "reflection_motion" in channels
    wants_gradient = channels is None or "gradient" in channels
    wants_hits = channels is None or any(name in channels for name in HIT_CHANNELS)
    wants_halves = channels is not None and "direct_halves" in channels and sampling.noisy_spp % 2 == 0
    streams = (NOISY_STREAM, OTHER_HALF_STREAM) if wants_halves else (NOISY_STREAM,)
    spp = sampling.noisy_spp // len(streams)
    samples: Samples | None = None  # of the frame before
    before: View | None = None
    timer = StepTimer()
    for frame, (view, arrays) in enumerate(noise_free_frames(stage, frames, wants_dual, timer)):
        ray = stage.rays(view)
        # A Halton cycle goes on from frame to frame with the shift of its realisation.
        first = frame * sampling.noisy_spp if halton else 0
        shift = 0 if halton else frame
        draws = [
            [Draw(stream_seed(seed, shift, stream, i), spp, first + part * spp) for part, stream in enumerate(streams)]
            for i in range(sampling.realisations)
        ]
        drawn = np.array([[noisy_tracer.radiance(ray, *draw) for draw in each] for each in draws])
        direct, indirect = np.moveaxis(drawn, 2, 0)  # (realisations, halves, H, W, 3)
        arrays |= {"direct": direct.mean(axis=1), "indirect": indirect.mean(axis=1)}
        arrays |= {"direct_halves": direct, "indirect_halves": indirect} if wants_halves else {}
        timer.lap("noisy")
        if wants_hits:
            hits = [hit_channels(noisy_tracer, view, each) for each in draws]
            arrays |= {name: np.stack([each[name] for each in hits]) for name in HIT_CHANNELS}
            timer.lap("hit_distance")
        if wants_tracked:
            met = causes(noisy_tracer, view, draws[0][0].seed, first)
            arrays |= tracked_motion(met, arrays, view, before or view)
            before = view
            timer.lap("shadow_motion")
        if wants_gradient:
            still = np.zeros((height, width, 2))
            arrays["gradient"] = samples.gradient(noisy_tracer, view) if samples else still
            choice = stream_seed(seed, frame, GRADIENT_STREAM, 0)
            samples = Samples.of(arrays, direct[0, 0], indirect[0, 0], view, stage.poses, draws[0][0], choice)
            timer.lap("gradient")
        half = sampling.reference_spp // 2
        halves = [tracer.radiance(ray, stream_seed(seed, frame, REFERENCE_STREAM, i), half) for i in range(2)]
        timer.lap("reference")
        arrays["direct_reference"] = np.stack([direct for direct, _ in halves])
        arrays["indirect_reference"] = np.stack([indirect for _, indirect in halves])
        arrays |= view._asdict()  # K, camera_to_world, object_to_world
        wanted = {
            name: array
            for name, array in arrays.items()
            if channels is None or name.removeprefix("mirrored_") in channels
        }
        yield wanted, timer.read()
