"""All channels of a clip, frame by frame."""

import time
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import render_gbuffer
from render.motion import dual_motion
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Scene
from scenes.camera import motion_vectors, pixel_centres


class Options(NamedTuple):
    """What the papers' renderers did: Halton cycles in noisy frames, regularised paths in them and in references."""

    halton: bool = False
    regularise: bool = False


PLAIN = Options()


class Sampling(NamedTuple):
    """How many samples: `realisations` of `noisy_spp` each, and a reference of `reference_spp` in two halves."""

    realisations: int
    noisy_spp: int
    reference_spp: int
    options: Options = PLAIN


def stream_seed(seed: int, frame: int, kind: int, index: int) -> int:
    """A 32-bit seed of its own for every frame and realisation (kind 0) or reference half (kind 1)."""
    return int(np.random.SeedSequence([seed, frame, kind, index]).generate_state(1)[0])


def render_clip(
    scene: Scene,
    frames: int,
    height: int,
    width: int,
    sampling: Sampling,
    seed: int,
    channels: Collection[str] | None = None,
) -> Iterator[tuple[dict[str, NDArray[Any]], dict[str, float]]]:
    """Yield for each frame its channels, named and shaped as on disk (without the frame axis), and seconds by step.

    Of the channels only those in `channels` are yielded, and what the others alone would cost is not spent.

    Deterministic in its arguments on one variant and processor.
    """
    stage = Stage(scene, height, width)
    halton, regularise = sampling.options
    tracer = PathTracer(stage, regularise=regularise)
    noisy_tracer = PathTracer(stage, halton, regularise) if halton else tracer
    centres = pixel_centres(height, width)
    wants_dual = channels is None or "dual_motion" in channels
    ahead, clock = render_gbuffer(stage, stage.view(0)), Clock()
    ahead["motion"] = ahead["dual_motion"] = np.zeros((height, width, 2))
    clock.lap("gbuffer")
    for frame in range(frames):
        clock.start()
        arrays, view, more = ahead, stage.view(frame), frame + 1 < frames
        if more:
            stage.pose(frame + 1)
            now = stage.view(frame + 1)
            ahead = render_gbuffer(stage, now)
            clock.lap("gbuffer")
            depth, mesh_id = ahead["depth"][..., 0].astype(np.float64), ahead["mesh_id"][..., 0]
            ahead["motion"] = motion_vectors(centres, depth, mesh_id, now, view)
            clock.lap("motion")
        stage.pose(frame)
        clock.lap("gbuffer")
        if more and wants_dual:  # they look into the scene as it is posed in this frame
            ahead["dual_motion"] = dual_motion(stage, depth, mesh_id, ahead["motion"], now, view)
            clock.lap("dual_motion")

        ray = stage.rays(view)
        spp = sampling.noisy_spp
        # A Halton cycle goes on from frame to frame with the shift of its realisation.
        stream = 0 if halton else frame
        noisy = [
            noisy_tracer.radiance(ray, stream_seed(seed, stream, 0, i), spp, first=frame * spp if halton else 0)
            for i in range(sampling.realisations)
        ]
        clock.lap("noisy")
        spp = sampling.reference_spp // 2
        halves = [tracer.radiance(ray, stream_seed(seed, frame, 1, i), spp) for i in range(2)]
        clock.lap("reference")
        for name, images in (("", noisy), ("_reference", halves)):
            arrays["direct" + name] = np.stack([direct for direct, _ in images])
            arrays["indirect" + name] = np.stack([indirect for _, indirect in images])
        arrays.update(K=view.K, camera_to_world=view.camera_to_world, object_to_world=view.object_to_world)
        yield {name: a for name, a in arrays.items() if channels is None or name in channels}, clock.read()


class Clock:
    """Seconds by step since it was last read."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Leave out the time until now."""
        self.last = time.perf_counter()

    def lap(self, name: str) -> None:
        """Count the time since the last lap as `name`."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now

    def read(self) -> dict[str, float]:
        """The table, which starts anew."""
        seconds, self.seconds = self.seconds, {}
        return seconds
