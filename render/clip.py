"""Renders a clip frame by frame, with all its channels, and writes it."""

import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.channels import CHANNELS, MIRRORED, OPTIONAL_STEPS, SAMPLE_BUFFERS, SECOND, SECOND_LAYER
from datasets.writer import ClipWriter
from render.backend import mi
from render.first_bounce import hit_channels
from render.gbuffer import Arrays, light_of_second_layer, render_gbuffer
from render.glass_motion import chains_at, traced_motion
from render.gradient import GradientSamples
from render.kept import kept, kept_references
from render.motion import dual_motion_vectors, tracked_motion
from render.path import PathTracer, SampleRange
from render.stage import Stage
from scenes.animation import Scene
from scenes.camera import View, motion_vectors, pixel_centres

Seconds = dict[str, float]  # by step


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
    judged: tuple[int, ...] = ()  # the frames that get a reference; empty for all
    rarity: float = 1.0  # in noisy frames lights are sampled so many times more rarely


@contextmanager
def timed(seconds: Seconds, step: str) -> Iterator[None]:
    """Add the time within the context to that of a step."""
    start = time.perf_counter()
    yield
    seconds[step] = seconds.get(step, 0.0) + time.perf_counter() - start


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
    stage: Stage, frames: int, regularise: bool, wants_dual: bool, layers: list[dict[str, str]], seconds: Seconds
) -> Iterator[FrameInProgress]:
    """Yield every frame with its G-buffer and motion vectors, also of `layers`: MIRRORED, SECOND.

    Dual motion vectors and those through glass need rays through the scene of the previous frame, so the G-buffer is
    rendered a frame ahead. The time that this takes is added to `seconds`.
    """
    centres = pixel_centres(stage.height, stage.width)
    with timed(seconds, "gbuffer"):
        view = stage.view(0)
        arrays = render_gbuffer(stage, view, regularise, SECOND in layers)
    motions = ("motion", "dual_motion", *(forms["motion"] for forms in layers))
    frame = FrameInProgress(0, view, view, arrays | dict.fromkeys(motions, np.zeros_like(centres)))
    for index in range(1, frames):
        with timed(seconds, "gbuffer"):
            stage.pose(index)
            view = stage.view(index)
            arrays = render_gbuffer(stage, view, regularise, SECOND in layers)
            shows_glass = arrays.get("glass_reflectance", np.zeros(1)).any()
            branches = (False, True) if shows_glass else ()
            chains = [chains_at(stage, view, centres.reshape(-1, 2), rarer) for rarer in branches]
        with timed(seconds, "motion"):
            surface = arrays["depth"][..., 0].astype(np.float64), arrays["mesh_id"][..., 0]
            arrays["motion"] = motion_vectors(centres, *surface, view, frame.view)
            for forms in layers:
                shown = arrays[forms["depth"]][..., 0].astype(np.float64), arrays[forms["mesh_id"]][..., 0]
                arrays[forms["motion"]] = motion_vectors(centres, *shown, view, frame.view)
        with timed(seconds, "gbuffer"):
            stage.pose(index - 1)
        if wants_dual:
            with timed(seconds, "dual_motion"):
                arrays["dual_motion"] = dual_motion_vectors(stage, *surface, arrays["motion"], view, frame.view)
        with timed(seconds, "motion"):
            for forms, chain in zip(layers, chains, strict=False):
                arrays[forms["motion"]] = traced_motion(stage, chain, arrays[forms["motion"]], view, frame.view)
        yield frame
        frame = FrameInProgress(index, view, frame.view, arrays)
    with timed(seconds, "gbuffer"):
        stage.pose(frames - 1)
    yield frame


class SampledChannels:
    """Renders the channels of a clip that need random samples; its methods take the frames in order."""

    def __init__(
        self, stage: Stage, sampling: Sampling, seed: int, in_buffers: bool, in_layers: bool, references: Path | None
    ):
        self.stage = stage
        self.references = references
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
        self.stage.lights.sample_rarely(self.sampling.rarity)
        streams = (NOISY_STREAM, SECOND_BUFFER_STREAM) if self.in_buffers else (NOISY_STREAM,)
        spp = self.sampling.noisy_spp // len(streams)
        # A realisation keeps its Halton shift, and its cycle continues from frame to frame.
        halton = self.sampling.options.halton
        first = frame.index * self.sampling.noisy_spp if halton else 0
        shift = 0 if halton else frame.index
        realisations = range(self.sampling.realisations)
        seeds = [[stream_seed(self.seed, shift, stream, i) for stream in streams] for i in realisations]
        self.draws = [[SampleRange(seed, spp, first + n * spp) for n, seed in enumerate(each)] for each in seeds]
        tracer, splits = self.noisy_tracer, self.in_layers
        drawn = [[tracer.radiance(self.ray, *draw, splits) for draw in draws] for draws in self.draws]
        direct, indirect, *of_glass = (
            np.array([[images[i] for images in buffers] for buffers in drawn]) for i in range(len(drawn[0][0]))
        )  # (realisations, buffers, H, W, C)
        self.first_sample = direct[0, 0] + indirect[0, 0]
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
        return tracked_motion(self.noisy_tracer, self.draws[0][0], frame.arrays, frame.view, frame.previous)

    def gradient(self, frame: FrameInProgress) -> Arrays:
        still = np.zeros((self.stage.height, self.stage.width, 2))
        gradient = self.samples.gradient(self.noisy_tracer, frame.view) if self.samples else still
        choice = stream_seed(self.seed, frame.index, GRADIENT_STREAM, 0)
        shaded = frame.arrays, self.first_sample, frame.view
        self.samples = GradientSamples.of(*shaded, self.stage.poses, self.draws[0][0], choice)
        return {"gradient": gradient}

    def reference(self, frame: FrameInProgress) -> Arrays:
        self.stage.lights.sample_rarely(1)
        spp = self.sampling.reference_spp // 2
        seeds = [stream_seed(self.seed, frame.index, REFERENCE_STREAM, buffer) for buffer in range(2)]

        def light() -> NDArray[np.float32]:  # (direct and indirect, buffers, H, W, 3)
            return np.stack([self.tracer.radiance(self.ray, seed, spp) for seed in seeds], axis=1)

        direct, indirect = kept(self.references / f"{frame.index}.npy", light) if self.references else light()
        return {"direct_reference": direct, "indirect_reference": indirect}


def render_clip(
    scene: Scene,
    frames: int,
    height: int,
    width: int,
    sampling: Sampling,
    seed: int,
    channels: Collection[str] | None = None,
    references: Path | None = None,
) -> Iterator[tuple[Arrays, Seconds]]:
    """Yield for each frame its channels, named and shaped as on disk (without the frame axis), and seconds by step.

    `channels` are those to render, with what mirrors and glass show in a scene with these, in two layers if they name
    any of SECOND_LAYER; by default all but sample buffers. Sample buffers need an even number of noisy samples a pixel,
    and change which samples are drawn.

    References that an earlier call with these arguments left in the folder `references` are not rendered again.

    Deterministic in its arguments for one Mitsuba variant and processor.
    """
    stage = Stage(scene, height, width)
    seconds: Seconds = {}  # since the last frame
    wanted = set(CHANNELS) - set(SAMPLE_BUFFERS.values()) if channels is None else set(channels)
    in_layers = stage.glass is not None and not wanted.isdisjoint(SECOND_LAYER)
    layers = [MIRRORED] * stage.looks_through + [SECOND] * in_layers
    wanted |= {forms[name] for forms in layers for name in wanted & forms.keys()}
    skipped = set(OPTIONAL_STEPS) - {CHANNELS[name].step for name in wanted}
    sampled = SampledChannels(stage, sampling, seed, SAMPLE_BUFFERS["direct"] in wanted, in_layers, references)
    steps = (sampled.noisy, sampled.hit_distance, sampled.shadow_motion, sampled.gradient, sampled.reference)
    steps_by_name = {step.__name__: step for step in steps}  # optional ones are called so in the channel table
    wants_dual = "dual_motion" not in skipped
    for frame in noise_free_frames(stage, frames, sampling.options.regularise, wants_dual, layers, seconds):
        for name, step in steps_by_name.items():
            if name not in skipped and (name != "reference" or frame.index in (sampling.judged or [frame.index])):
                with timed(seconds, name):
                    frame.arrays |= step(frame)
        frame.arrays |= frame.view._asdict()  # K, camera_to_world, object_to_world
        yield {name: array for name, array in frame.arrays.items() if name in wanted}, dict(seconds)
        seconds.clear()


def write_clip(
    folder: Path,
    scene: Scene,
    size: tuple[int, int, int],
    sampling: Sampling,
    seed: int,
    channels: Collection[str],
    seconds_before: Seconds | None = None,
) -> None:
    """Render channels of a scene into a clip of `size` (frames, height, width), completely or not at all.

    `seconds_before` rendering, by step, are recorded with those of rendering. After an interruption the references that
    were finished are kept, and their time is not counted.
    """
    split, scene_name, clip_name = folder.parts[-3:]
    derived = {name: "camera" for name in channels if CHANNELS[name].is_camera_motion and not scene.moves()}
    with kept_references(folder) as references, ClipWriter(folder) as writer:
        frames = render_clip(scene, *size, sampling, seed, channels, references)
        writer.timing = dict(seconds_before or {})
        for arrays, seconds in tqdm(frames, f"{split}/{scene_name}/{clip_name}", size[0], leave=False, unit="frame"):
            writer.add(arrays, seconds)
        facts = {
            "noisy_spp": sampling.noisy_spp,
            "reference_spp": sampling.reference_spp // 2 * 2,
            "meshes": [shape.name for shape in scene.meshes],
        }
        writer.finish(facts, derived)
