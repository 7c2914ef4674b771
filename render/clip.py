"""Renders a clip frame by frame, with all its channels."""

import time
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED, OPTIONAL_STEPS, SAMPLE_BUFFERS, SECOND, SECOND_LAYER
from render.backend import mi
from render.first_bounce import hit_channels
from render.gbuffer import light_of_second_layer, render_gbuffer
from render.glass_motion import chains_through_glass, traced_motion
from render.gradient import GradientSamples
from render.motion import dual_motion_vectors, hits_of_samples, tracked_motion
from render.path import PathTracer, SampleRange
from render.stage import Stage
from scenes.animation import Scene
from scenes.camera import View, motion_vectors, pixel_centres

Arrays = dict[str, NDArray[Any]]  # channels of one frame by name


class Options(NamedTuple):
    """Choices of the papers' renderers: Halton cycles in noisy frames; path regularisation, in references too."""

    halton: bool = False
    regularise: bool = False


NO_OPTIONS = Options()


class Sampling(NamedTuple):
    """Samples of a frame: `realisations` of `noisy_spp` a pixel, and a reference of `reference_spp` in two buffers."""

    realisations: int
    noisy_spp: int
    reference_spp: int
    options: Options = NO_OPTIONS


class StepTimer:
    """Seconds by step since they were last read."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Ignore the time until now."""
        self.last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Count the time since the last lap as `step`."""
        now = time.perf_counter()
        self.seconds[step] = self.seconds.get(step, 0.0) + now - self.last
        self.last = now

    def read(self) -> dict[str, float]:
        """Seconds by step; resets them."""
        seconds, self.seconds = self.seconds, {}
        return seconds


NOISY_STREAM, REFERENCE_STREAM, GRADIENT_STREAM, SECOND_BUFFER_STREAM = range(4)


def stream_seed(seed: int, frame: int, stream: int, index: int) -> int:
    """An independent 32-bit seed for each frame, stream, and realisation or buffer."""
    return int(np.random.SeedSequence([seed, frame, stream, index]).generate_state(1)[0])


@dataclass
class FrameInProgress:
    """A frame for which the stage is posed, with the channels rendered so far."""

    index: int
    view: View
    previous: View  # of the frame before; of the frame itself in the first
    arrays: Arrays


def noise_free_frames(
    stage: Stage, frames: int, regularise: bool, wants_dual: bool, in_layers: bool, timer: StepTimer
) -> Iterator[FrameInProgress]:
    """Yield every frame with its G-buffer and motion vectors.

    Dual motion vectors and those through glass need rays through the scene of the previous frame, so the G-buffer is
    rendered a frame ahead.
    """
    centres = pixel_centres(stage.height, stage.width)
    view = stage.view(0)
    arrays = render_gbuffer(stage, view, regularise, in_layers)
    for name in ("motion", "dual_motion", *(forms["motion"] for forms in layers_of(stage, in_layers))):
        arrays[name] = np.zeros_like(centres)
    frame = FrameInProgress(0, view, view, arrays)
    timer.lap("gbuffer")
    for index in range(1, frames):
        stage.pose(index)
        view = stage.view(index)
        arrays = render_gbuffer(stage, view, regularise, in_layers)
        shows_glass = arrays.get("glass_reflectance", np.zeros(1)).any()
        chains = [chains_through_glass(stage, view, rarer) for rarer in (False, True)] if shows_glass else []
        timer.lap("gbuffer")
        surface = arrays["depth"][..., 0].astype(np.float64), arrays["mesh_id"][..., 0]
        arrays["motion"] = motion_vectors(centres, *surface, view, frame.view)
        for forms in layers_of(stage, in_layers):
            shown = arrays[forms["depth"]][..., 0].astype(np.float64), arrays[forms["mesh_id"]][..., 0]
            arrays[forms["motion"]] = motion_vectors(centres, *shown, view, frame.view)
        timer.lap("motion")
        stage.pose(index - 1)
        timer.lap("gbuffer")
        if wants_dual:
            arrays["dual_motion"] = dual_motion_vectors(stage, *surface, arrays["motion"], view, frame.view)
            timer.lap("dual_motion")
        for forms, chain in zip(layers_of(stage, in_layers), chains, strict=False):
            arrays[forms["motion"]] = traced_motion(stage, chain, arrays[forms["motion"]], view, frame.view)
        timer.lap("motion")
        yield frame
        timer.start()
        frame = FrameInProgress(index, view, frame.view, arrays)
    stage.pose(frames - 1)
    timer.lap("gbuffer")
    yield frame


def layers_of(stage: Stage, in_layers: bool) -> list[dict[str, str]]:
    """The names of the channels of what mirrors and glass show, layer by layer."""
    return [MIRRORED] * stage.looks_through + [SECOND] * (in_layers and stage.glass is not None)


class SampledChannels:
    """Renders the channels of a clip that need random samples; its methods take the frames in order."""

    def __init__(self, stage: Stage, sampling: Sampling, seed: int, in_buffers: bool, in_layers: bool):
        self.stage = stage
        self.in_layers = in_layers
        self.sampling = sampling
        self.seed = seed
        self.in_buffers = in_buffers and sampling.noisy_spp % 2 == 0
        halton, regularise = sampling.options
        self.tracer = PathTracer(stage, regularise=regularise)
        self.noisy_tracer = PathTracer(stage, halton, regularise) if halton else self.tracer
        self.samples: GradientSamples | None = None  # of the previous frame

    def noisy(self, frame: FrameInProgress) -> Arrays:
        self.ray: mi.Ray3f = self.stage.rays(frame.view)
        streams = (NOISY_STREAM, SECOND_BUFFER_STREAM) if self.in_buffers else (NOISY_STREAM,)
        spp = self.sampling.noisy_spp // len(streams)
        # A realisation keeps its Halton shift, and its cycle continues from frame to frame.
        halton = self.sampling.options.halton
        first = frame.index * self.sampling.noisy_spp if halton else 0
        shift = 0 if halton else frame.index
        self.draws = [
            [
                SampleRange(stream_seed(self.seed, shift, stream, i), spp, first + n * spp)
                for n, stream in enumerate(streams)
            ]
            for i in range(self.sampling.realisations)
        ]
        trace = self.noisy_tracer.split_radiance if self.in_layers else self.noisy_tracer.radiance
        drawn = [[trace(self.ray, *draw) for draw in draws] for draws in self.draws]
        direct, indirect, *of_glass = (
            np.array([[images[i] for images in buffers] for buffers in drawn]) for i in range(len(drawn[0][0]))
        )  # (realisations, buffers, H, W, C)
        self.first_sample = direct[0, 0], indirect[0, 0]
        arrays = {"direct": direct.mean(axis=1), "indirect": indirect.mean(axis=1)}
        if of_glass:
            means = (image.mean(axis=1) for image in (direct + indirect, *of_glass))
            arrays |= light_of_second_layer(frame.arrays["glass_reflectance"], *means)
        buffers = {SAMPLE_BUFFERS["direct"]: direct, SAMPLE_BUFFERS["indirect"]: indirect}
        return arrays | buffers if self.in_buffers else arrays

    def hit_distance(self, frame: FrameInProgress) -> Arrays:
        hits = [hit_channels(self.noisy_tracer, frame.view, draws) for draws in self.draws]
        return {name: np.stack([realisation[name] for realisation in hits]) for name in hits[0]}

    def shadow_motion(self, frame: FrameInProgress) -> Arrays:
        draw = self.draws[0][0]
        hits = hits_of_samples(self.noisy_tracer, frame.view, draw.seed, draw.first)
        return tracked_motion(hits, frame.arrays, frame.view, frame.previous)

    def gradient(self, frame: FrameInProgress) -> Arrays:
        stage = self.stage
        still = np.zeros((stage.height, stage.width, 2))
        gradient = self.samples.gradient(self.noisy_tracer, frame.view) if self.samples else still
        choice = stream_seed(self.seed, frame.index, GRADIENT_STREAM, 0)
        self.samples = GradientSamples.of(
            frame.arrays, np.add(*self.first_sample), frame.view, stage.poses, self.draws[0][0], choice
        )
        return {"gradient": gradient}

    def reference(self, frame: FrameInProgress) -> Arrays:
        spp = self.sampling.reference_spp // 2
        seeds = [stream_seed(self.seed, frame.index, REFERENCE_STREAM, buffer) for buffer in range(2)]
        direct, indirect = zip(*(self.tracer.radiance(self.ray, seed, spp) for seed in seeds), strict=True)
        return {"direct_reference": np.stack(direct), "indirect_reference": np.stack(indirect)}


# By step, in their order; optional steps are those of the channel table.
MAKERS: dict[str, Callable[[SampledChannels, FrameInProgress], Arrays]] = {
    "noisy": SampledChannels.noisy,
    "hit_distance": SampledChannels.hit_distance,
    "shadow_motion": SampledChannels.shadow_motion,
    "gradient": SampledChannels.gradient,
    "reference": SampledChannels.reference,
}


def render_clip(
    scene: Scene,
    frames: int,
    height: int,
    width: int,
    sampling: Sampling,
    seed: int,
    channels: Collection[str] | None = None,
    judged: Collection[int] = (),
) -> Iterator[tuple[Arrays, dict[str, float]]]:
    """Yield for each frame its channels, named and shaped as on disk (without the frame axis), and seconds by step.

    `channels` are those to render, with what mirrors and glass show in a scene with these, in two layers if they name
    any of SECOND_LAYER; by default all but sample buffers. Sample buffers need an even number of noisy samples a pixel,
    and change which samples are drawn. References are rendered of the frames in `judged`, or of all if it is empty.

    Deterministic in its arguments for one Mitsuba variant and processor.
    """
    stage = Stage(scene, height, width)
    timer = StepTimer()
    wanted = set(CHANNELS) - set(SAMPLE_BUFFERS.values()) if channels is None else set(channels)
    in_layers = stage.glass is not None and not wanted.isdisjoint(SECOND_LAYER)
    wanted |= {forms[name] for forms in layers_of(stage, in_layers) for name in wanted & forms.keys()}
    skipped = set(OPTIONAL_STEPS) - {CHANNELS[name].step for name in wanted}
    makers = {step: maker for step, maker in MAKERS.items() if step not in skipped}
    sampled = SampledChannels(stage, sampling, seed, SAMPLE_BUFFERS["direct"] in wanted, in_layers)
    wants_dual = "dual_motion" not in skipped
    for frame in noise_free_frames(stage, frames, sampling.options.regularise, wants_dual, in_layers, timer):
        for step, maker in makers.items():
            if step == "reference" and judged and frame.index not in judged:
                continue
            frame.arrays |= maker(sampled, frame)
            timer.lap(step)
        frame.arrays |= frame.view._asdict()  # K, camera_to_world, object_to_world
        yield {name: array for name, array in frame.arrays.items() if name in wanted}, timer.read()
