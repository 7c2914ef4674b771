"""All channels of a clip, frame by frame."""

import time
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import render_gbuffer
from render.motion import dual_motion
from render.path import render_radiance
from render.stage import Stage
from scenes.animation import Scene
from scenes.camera import motion_vectors, pixel_centres


class Sampling(NamedTuple):
    """How many samples: `realisations` of `noisy_spp` each, and a reference of `reference_spp` in two halves."""

    realisations: int
    noisy_spp: int
    reference_spp: int


def stream_seed(seed: int, frame: int, kind: int, index: int) -> int:
    """A 32-bit seed of its own for every frame and realisation (kind 0) or reference half (kind 1)."""
    return int(np.random.SeedSequence([seed, frame, kind, index]).generate_state(1)[0])


def render_clip(
    scene: Scene, frames: int, height: int, width: int, sampling: Sampling, seed: int
) -> Iterator[tuple[dict[str, NDArray[Any]], dict[str, float]]]:
    """Yield for each frame its channels, named and shaped as on disk (without the frame axis), and seconds by step.

    Deterministic in its arguments on one variant and processor.
    """
    stage = Stage(scene, height, width)
    gbuffers, seconds = [], []
    for frame in range(frames):
        start = time.perf_counter()
        stage.pose(frame)
        gbuffers.append(render_gbuffer(stage, stage.view(frame)))
        seconds.append({"gbuffer": time.perf_counter() - start})

    # The dual vectors of frame i look into the scene as it was posed in frame i - 1.
    dual = np.zeros((height, width, 2))
    for frame in range(frames):
        clock = Clock(seconds[frame])
        channels, view = gbuffers[frame], stage.view(frame)
        previous = stage.view(max(frame - 1, 0))
        depth, mesh_id = channels["depth"][..., 0].astype(np.float64), channels["mesh_id"][..., 0]
        channels["motion"] = motion_vectors(pixel_centres(height, width), depth, mesh_id, view, previous)
        channels["dual_motion"] = dual
        channels.update(K=view.K, camera_to_world=view.camera_to_world, object_to_world=view.object_to_world)
        clock.lap("motion")

        stage.pose(frame)
        ray = stage.rays(view)
        for name, kind, count, spp in (
            ("", 0, sampling.realisations, sampling.noisy_spp),
            ("_reference", 1, 2, sampling.reference_spp // 2),
        ):
            images = [render_radiance(stage, ray, stream_seed(seed, frame, kind, i), spp) for i in range(count)]
            channels["direct" + name] = np.stack([direct for direct, _ in images])
            channels["indirect" + name] = np.stack([indirect for _, indirect in images])
            clock.lap("reference" if name else "noisy")

        if frame + 1 < frames:
            following = gbuffers[frame + 1]
            depth, mesh_id = following["depth"][..., 0].astype(np.float64), following["mesh_id"][..., 0]
            now = stage.view(frame + 1)
            vectors = motion_vectors(pixel_centres(height, width), depth, mesh_id, now, view)
            dual = dual_motion(stage, depth, mesh_id, vectors, now, view)
            clock.lap("dual_motion")
        yield channels, seconds[frame]


class Clock:
    """Adds the time between laps to a table of seconds."""

    def __init__(self, seconds: dict[str, float]):
        self.seconds, self.last = seconds, time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now
