"""`onespp denoise`: frames of any renderer through a denoiser, one after another, and the results on disk."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from datasets.frame import Frame, to_image
from datasets.tonemap import clip_exposure, display, luminance, to_8_bits
from denoise.analysis import Analysis, analyse
from denoise.exr_image import NOTE_ATTRIBUTE, ExrImage
from denoise.foreign_frame import open_passes, read_foreign_frame
from denoise.frame_errors import ERRORS_FILE, METRICS_FILE, ErrorTable, FrameError, compare, radiance
from denoise.frames import FrameBuilder, OwnFrameBuilder
from denoise.job import Job
from denoise.layers import COLOUR, parse_layers
from denoise.motion_convention import MotionConvention
from denoise.parts import Parts
from denoise.sequence import FrameFiles, files_of, gaps, like, numbered, sequence_of, split_at_cuts, stamps_of
from denoise.sources import Sources, find_sources, has_two_buffers
from denoise.supersampling import AlbedoMean
from errors import BadInput, requires_extra
from eval.bench.memory import status_mb
from files import read_json, replacing, write_json
from models.denoiser import Denoiser, State
from models.filters.oidn import OIDN, OIDNQuality
from models.registry import parse_name
from models.spec import DenoiserSpec, fastest_precision
from models.wrappers.error_estimate import denoise_with_error
from models.wrappers.shrinkage import JamesStein
from models.wrappers.wrapper import unwrapped
from provenance import DENOISING, file_digest, versions

SETTINGS_FILE = "denoise.json"
DTYPES: dict[str | None, type | None] = {None: None, "half": np.float16, "float": np.float32}


@torch.inference_mode()
def denoise(job: Job) -> None:
    """Denoise a sequence, or resume; prints the analysis of the files, and a summary. Raises BadInput."""
    if job.png:
        with requires_extra("report"):
            import PIL.Image  # noqa: F401 - so that a missing package is named before the work
    frames = sequence_of(job.patterns, job.frame_range)
    references = reference_files(job, frames)
    check_names(job, frames)
    shots = split_at_cuts(frames, job.reset_at)
    first = open_passes(frames[0], header_only=True)
    sources = find_sources(first, parse_layers(job.layers))
    if sources.is_ours:
        check_ours(job)
    name = parse_name(job.denoiser)
    spec = DenoiserSpec(name, "total", fastest_precision(name, job.device), job.weights, device=job.device)
    denoiser = build(spec, job.quality)
    estimates = job.error or job.until is not None
    estimator = error_estimator(job, denoiser, sources, first[COLOUR]) if estimates else None
    parts = Parts.named(job.aov, first[COLOUR], denoiser)
    sequence = SequenceDenoiser(job, spec, denoiser, estimator, parts, shots, sources, first[COLOUR])
    print(sequence.introduction())
    sequence.builder()  # so that what it refuses is refused before anything is written
    check_settings(job.out, sequence.settings())
    nonfinite = list(sequence.play())
    print(f"{job.out}: {len(frames)} frames, {len(nonfinite)} of them new", end="; ")
    print(f"{sum(nonfinite)} pixels were not finite and count as 0", end="")
    peak = status_mb("VmHWM")
    print(f"; peak memory {peak / 1000:.2f} GB" if peak else "")
    if job.until is not None:
        print(sequence.errors.summary(frame.number for frame in frames))
    if references:
        print(compare(frames, references, job.out, sources.target, sequence.exposure))


def build(spec: DenoiserSpec, quality: OIDNQuality | None) -> Denoiser:
    """The denoiser, ready to use. Raises BadInput for a quality that it does not have."""
    denoiser = spec.build()
    if quality:
        inner = unwrapped(denoiser)
        if not isinstance(inner, OIDN):
            raise BadInput(f"--quality is an option of OIDN, not of '{spec.name}'")
        inner.quality = quality
    return denoiser


def check_ours(job: Job) -> None:
    """Raise BadInput for options that say what the files of `onespp exr` say themselves."""
    for option, is_given in (("motion", job.motion), ("albedo", job.albedo), ("spp", job.spp != 1.0)):
        if is_given:
            raise BadInput(f"--{option} is for other renderers' files: those of `onespp exr` contain it; leave it out")


def error_estimator(job: Job, denoiser: Denoiser, sources: Sources, first: ExrImage) -> JamesStein:
    """The denoiser, if it and the frames allow an error estimate. Raises BadInput where not, or for --until <= 0."""
    if not isinstance(denoiser, JamesStein):
        raise BadInput(f"{job.denoiser} does not estimate its error: use {job.denoiser}+js")
    if not (has_two_buffers(first) if sources.is_ours else sources.has("buffer_b")):
        raise BadInput("--error and --until need two sample buffers: name buffer B by --buffer-b")
    if job.until is not None and not 0 < job.until < math.inf:
        raise BadInput(f"--until {job.until:g} is no relative error such as 0.02")
    return denoiser


def reference_files(job: Job, frames: Sequence[FrameFiles]) -> list[Path]:
    """The reference of each frame, or none at all. Raises BadInput where one is missing."""
    if not job.ref:
        return []
    files = like([frame.number for frame in frames], numbered(files_of(job.ref)))
    for frame in frames:
        if frame.number not in files:
            raise BadInput(f"'{' '.join(job.ref)}' has no reference of frame {frame.number}")
    return [files[frame.number] for frame in frames]


def check_names(job: Job, frames: Sequence[FrameFiles]) -> None:
    """Raise BadInput where an output would overwrite an input, another output, or a file of something else."""
    out = job.out
    if any(path.parent.resolve() == out.resolve() for frame in frames for path in frame.passes.values()):
        raise BadInput(f"--out {out} contains the frames to denoise: choose another folder")
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        raise BadInput("frames of different folders have the same name: denoise one folder at a time")
    outputs = [*names, *(Path(name).with_suffix(".png").name for name in names if job.png)]
    outputs += [METRICS_FILE] * bool(job.ref) + [ERRORS_FILE] * bool(job.error or job.until)
    if not (out / SETTINGS_FILE).exists() and (taken := [name for name in outputs if (out / name).exists()]):
        raise BadInput(f"--out {out} has a {taken[0]} that was not made here: choose another folder")


def check_settings(out: Path, settings: Mapping[str, Any]) -> None:
    """Make the folder and write the settings into it. Raises BadInput where it has frames with other settings."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / SETTINGS_FILE
    if not path.exists() or not any(file.suffix.lower() == ".exr" for file in out.iterdir()):
        write_json(path, dict(settings))
        return
    present = read_json(path)
    if changed := [key for key in sorted(settings.keys() | present.keys()) if settings.get(key) != present.get(key)]:
        raise BadInput(f"{out} has frames denoised with other settings ({', '.join(changed)}): choose another --out")


def check_window(image: ExrImage, first: ExrImage) -> None:
    """Raise BadInput where a frame's data window is not that of the first: motion is counted in its pixels."""
    if (image.height, image.width) != (first.height, first.width):
        raise BadInput(f"{image.path} is {image.width}x{image.height}, unlike the first frame: name one sequence")
    if image.window != first.window:
        windows = f"{image.path} begins at {image.window[:2]} and {first.path} at {first.window[:2]}"
        raise BadInput(f"{windows}: render all frames with the same data window")


@dataclass
class SequenceDenoiser:
    job: Job
    spec: DenoiserSpec
    denoiser: Denoiser
    estimator: JamesStein | None  # the denoiser, where it is to estimate its error
    parts: Parts | None  # layers that are denoised beside the colour
    shots: list[list[FrameFiles]]
    sources: Sources
    first: ExrImage  # the header of the first frame's colour

    def __post_init__(self) -> None:
        """Take the stamps before any frame is read: a file that is rendered again meanwhile gets another one."""
        self.stamps = {
            files.number: stamp for shot in self.shots for files, stamp in zip(shot, stamps_of(shot), strict=True)
        }

    @cached_property
    def analysis(self) -> Analysis:
        given = MotionConvention.parse(self.job.motion) if self.job.motion else None
        return analyse(self.shots, self.sources, self.denoiser.reads, given, self.job.albedo)

    @cached_property
    def exposure(self) -> float:
        """Of previews and metrics: that of the first frame, or of its reference if there is one."""
        first = self.shots[0][0]
        if self.job.ref:
            image = radiance(reference_files(self.job, [first])[0], self.sources.target)
        elif self.sources.is_ours:
            image = radiance(first.passes[COLOUR], self.sources.target)
        else:
            image = read_foreign_frame(first, self.sources)[0].arrays[COLOUR]
        return clip_exposure(luminance(image.clip(0, None)))

    def introduction(self) -> str:
        frames = [frame for shot in self.shots for frame in shot]
        head = f"{len(frames)} frames, {frames[0].passes[COLOUR]} to {frames[-1].passes[COLOUR].name}"
        if missing := gaps(frames):
            head += f"; frames are missing before {', '.join(map(str, missing))}: history begins anew there"
        ours = [("everything", "onespp's own channels and cameras")]
        report = ours if self.sources.is_ours else self.analysis.report
        return "\n".join([head, *(f"  {quantity:<13} {origin}" for quantity, origin in report)])

    def settings(self) -> dict[str, Any]:
        """All that the bytes of a frame depend on, except the files themselves."""
        job = self.job
        first = self.shots[0][0]
        return {
            "denoiser": job.denoiser,
            "weights": file_digest(job.weights) if job.weights else None,
            "precision": self.spec.precision,
            "quality": job.quality,
            "passes": {name: str(path.resolve()) for name, path in first.passes.items()},
            "first frame": first.number,
            "reset-at": sorted(job.reset_at),
            "layers": sorted(job.layers),
            "aov": sorted(job.aov) or None,
            "albedo": job.albedo,
            "motion": str(None if self.sources.is_ours else self.analysis.conventions.motion),
            "as": job.stored_as,
            "spp": job.spp,
            "error": job.error or None,
            "versions": versions(DENOISING),
        } | ({} if job.device == "cpu" else {"device": job.device})

    def play(self) -> Iterator[int]:
        """Denoise the missing frames; yields how many pixels of each new frame were not finite.

        Within a shot every frame depends on those before it: finished ones are computed again, but not written, where
        a later one is missing.
        """
        with tqdm(total=sum(map(len, self.shots)), desc=self.job.denoiser, unit="frame") as progress:
            for shot in self.shots:
                start = next((i for i, files in enumerate(shot) if not self.is_finished(files)), len(shot))
                yield from self.play_shot(shot, start, progress)

    def is_finished(self, files: FrameFiles) -> bool:
        """Whether a frame's outputs, and its error if requested, are there and made of the files as they are now."""
        if self.estimator and not self.errors.has(files.number, self.job.until):
            return False
        output, preview = self.job.out / files.name, self.preview(files)
        try:
            note = ExrImage(output, header_only=True).header.get(NOTE_ATTRIBUTE)
        except BadInput:  # it is missing or damaged
            return False
        has_preview = preview.exists() and preview.stat().st_mtime_ns >= output.stat().st_mtime_ns
        return note == self.note(files) and (has_preview or not self.job.png)

    def note(self, files: FrameFiles) -> str:
        """By what a frame's output is made, and of which files."""
        return f"onespp {self.job.denoiser} of {self.stamps[files.number]}"

    def preview(self, files: FrameFiles) -> Path:
        return (self.job.out / files.name).with_suffix(".png")

    def play_shot(self, shot: Sequence[FrameFiles], start: int, progress: Any) -> Iterator[int]:
        """The frames of a shot, of which those before `start` are finished."""
        state: State | None = None
        builder = self.builder()
        is_sampled = not self.sources.is_ours and self.analysis.conventions.albedo_is_sampled
        albedo = AlbedoMean() if is_sampled else None
        has_history = self.sources.is_ours or self.analysis.conventions.has_history
        for index, files in enumerate(shot):
            needs_state = has_history and (index == 0 or type(state) is not State)
            if start < len(shot) and (needs_state or index >= start):
                image, frame, nonfinite = self.read(files, builder)
                check_window(image, self.first)
                frame = frame.to(self.denoiser.device)
                if self.parts:
                    frame = self.parts.added(frame, image)
                if albedo:
                    frame = albedo.add(frame)
                output, state = self.step(files, image, frame, state, index >= start)
                if index >= start:
                    self.write(files, image, to_image(output))
                    yield nonfinite
            progress.update()

    def step(
        self, files: FrameFiles, image: ExrImage, frame: Frame, state: State | None, is_new: bool
    ) -> tuple[Tensor, State]:
        """The denoised frame and the next state; the error of a new frame goes into the table and its image."""
        if not (self.estimator and is_new):
            output, state = self.denoiser(frame, state)
            if self.parts and is_new:
                self.parts.write(image, frame, state, DTYPES[self.job.stored_as])
            return output, state
        output, state, estimate = denoise_with_error(self.estimator, frame, state)
        self.errors.add(FrameError.of(files.number, estimate, self.job.until))
        if self.job.error:
            image.add("error", to_image(estimate.radiance_error()), self.sources.target[0])
        return output, state

    @cached_property
    def errors(self) -> ErrorTable:
        return ErrorTable(self.job.out)

    def builder(self) -> FrameBuilder | OwnFrameBuilder:
        if self.sources.is_ours:
            return OwnFrameBuilder(self.denoiser.reads)
        return FrameBuilder(self.analysis.conventions, self.denoiser.reads, str(self.first.path), self.job.spp)

    def read(self, files: FrameFiles, builder: FrameBuilder | OwnFrameBuilder) -> tuple[ExrImage, Frame, int]:
        """The image to write, the next Frame of a shot, and how many pixels were not finite."""
        if isinstance(builder, OwnFrameBuilder):
            image = ExrImage(files.passes[COLOUR])
            return image, *builder.build(image)
        foreign, image = read_foreign_frame(files, self.sources)
        return image, builder.build(foreign), foreign.nonfinite

    def write(self, files: FrameFiles, image: ExrImage, radiance: NDArray[np.float32]) -> None:
        image.replace(self.sources.target, radiance, DTYPES[self.job.stored_as])
        image.write(self.job.out / files.name, self.note(files))
        if self.job.png:  # after the image: a preview that is older is of an image before
            from PIL import Image

            shown = display(np.nan_to_num(radiance).clip(0, None), self.exposure)
            with replacing(self.preview(files)) as temporary:
                Image.fromarray(to_8_bits(shown)).save(temporary, "PNG")
