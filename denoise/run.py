"""`onespp denoise`: anybody's frames through a denoiser, one after another, and what came of them on disk."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.frame import Frame
from datasets.tonemap import clip_exposure, display, luminance
from denoise.comparison import compare, radiance
from denoise.error_table import ErrorTable, FrameError
from denoise.exr_image import ExrImage
from denoise.frames import OwnShot, Shot
from denoise.layers import stated_layers
from denoise.motion_meaning import Meaning
from denoise.pixels import open_passes, read_pixels
from denoise.sequence import COLOUR, FrameFiles, files_of, gaps, numbered, sequence_of, shots
from denoise.settings import claim
from denoise.sources import Sources, find_sources, has_halves
from denoise.understanding import Understanding, report, understand
from errors import BadInput
from eval.bench.memory import status_mb
from extras import requires_extra
from files import replacing
from models.denoiser import Denoiser, State
from models.filters.oidn import OIDN, OIDNQuality
from models.registry import parse_name
from models.spec import DenoiserSpec, fastest_precision
from models.wrappers.error_estimate import ErrorEstimate, with_error
from models.wrappers.shrinkage import Shrunk
from models.wrappers.wrapper import unwrapped
from provenance import DENOISING, file_digest, versions

Precision = Literal["half", "float"]
ERROR_LAYER = "error"
DTYPES: dict[str | None, type | None] = {None: None, "half": np.float16, "float": np.float32}


@dataclass(frozen=True)
class Job:
    """What is asked for.

    Attributes:
        patterns: of the files of each pass; of "colour" at least one.
        layers: which layers hold what, such as "albedo=MyAOV.albedo", before all names that are known.
        motion: the meaning of motion vectors, such as "XY,+x,+y,pixels"; by default found out.
        references: patterns of the frames to measure against.
        frames: numbers "A-B" of the frames to denoise.
        reset_at: numbers of frames at which history begins anew.
        stored_as: precision of denoised channels, by default that of the input.
        previews: whether to write a PNG beside each frame.
        spp: samples a pixel of the colour; what our own files say is known.
        error: whether to add the layer `error` to each frame: how far each pixel is from the truth, as halves tell.
        until: the relative error at which a frame is done; the samples that the others need go into error.csv.
    """

    patterns: Mapping[str, Sequence[str]]
    denoiser: str
    out: Path
    weights: Path | None
    layers: Sequence[str] = ()
    motion: str | None = None
    references: Sequence[str] = ()
    frames: str | None = None
    reset_at: Sequence[int] = ()
    quality: OIDNQuality | None = None
    stored_as: Precision | None = None
    previews: bool = False
    spp: float = 1.0
    error: bool = False
    until: float | None = None

    @property
    def tells_error(self) -> bool:
        return self.error or self.until is not None


@torch.inference_mode()
def denoise(job: Job) -> None:
    """Do what is asked for, or go on with it; prints what was found in the files, and a summary.

    Raises BadInput for what the user can mend.
    """
    if job.previews:
        with requires_extra("report"):
            import PIL.Image  # noqa: F401 - so that a missing package is named before the work
    frames = sequence_of(job.patterns, job.frames)
    references = reference_files(job, frames)
    check_names(job.out, frames)
    sequence = shots(frames, job.reset_at)
    sources = find_sources(open_passes(frames[0], header_only=True), stated_layers(job.layers))
    name = parse_name(job.denoiser)
    spec = DenoiserSpec(name, "total", fastest_precision(name), job.weights)
    denoiser = build(spec, job.quality)
    if job.tells_error:
        check_error_can_be_told(job, denoiser, sources, frames[0])
    work = Work(job, spec, denoiser, sequence, sources)
    print(work.introduction())
    claim(job.out, work.settings())
    nonfinite = list(work.play())
    print(f"{job.out}: {len(frames)} frames, {len(nonfinite)} of them new", end="; ")
    print(f"{sum(nonfinite)} pixels were not finite and count as 0", end="")
    peak = status_mb("VmHWM")
    print(f"; peak memory {peak / 1000:.2f} GB" if peak else "")
    if job.until is not None:
        print(work.errors.summary(frame.number for frame in frames))
    if references:
        print(compare(frames, references, job.out, sources.target, work.exposure))


def build(spec: DenoiserSpec, quality: OIDNQuality | None) -> Denoiser:
    """The denoiser, ready to use. Raises BadInput for a quality that it does not have."""
    denoiser = spec.build()
    if quality:
        inner = unwrapped(denoiser)
        if not isinstance(inner, OIDN):
            raise BadInput(f"--quality is OIDN's, '{spec.name}' has none")
        inner.quality = quality
    return denoiser


def check_error_can_be_told(job: Job, denoiser: Denoiser, sources: Sources, first: FrameFiles) -> None:
    """Raise BadInput for a denoiser that tells no error, frames that have no halves, and an error that none has."""
    if not isinstance(denoiser, Shrunk):
        raise BadInput(f"{job.denoiser} does not tell its error: name {job.denoiser}+js")
    if not (has_halves(ExrImage(first.passes[COLOUR], header_only=True)) if sources.is_ours else sources.has("half")):
        raise BadInput("--error and --until need two halves of the samples: name the other by --half")
    if job.until is not None and not 0 < job.until < math.inf:
        raise BadInput(f"--until {job.until:g} is no relative error such as 0.02")


def reference_files(job: Job, frames: Sequence[FrameFiles]) -> list[Path]:
    """The reference of each frame, or none at all. Raises BadInput where one is missing."""
    if not job.references:
        return []
    files = numbered(files_of(job.references))
    for frame in frames:
        if frame.number not in files:
            raise BadInput(f"'{' '.join(job.references)}' has no reference of frame {frame.number}")
    return [files[frame.number] for frame in frames]


def check_names(out: Path, frames: Sequence[FrameFiles]) -> None:
    """Raise BadInput where an output would overwrite an input, or another output."""
    if any(path.parent.resolve() == out.resolve() for frame in frames for path in frame.passes.values()):
        raise BadInput(f"--out {out} holds the frames to denoise: choose another folder")
    names = [frame.name for frame in frames]
    if len(set(names)) < len(names):
        raise BadInput("frames of different folders have the same name: denoise one folder at a time")


@dataclass
class Work:
    """A job whose files and denoiser are known."""

    job: Job
    spec: DenoiserSpec
    denoiser: Denoiser
    shots: list[list[FrameFiles]]
    sources: Sources

    @cached_property
    def understanding(self) -> Understanding:
        stated = Meaning.parse(self.job.motion) if self.job.motion else None
        return understand(self.shots, self.sources, self.denoiser.reads, stated)

    @cached_property
    def exposure(self) -> float:
        """Of previews and metrics: what the first frame needs, its reference if there is one."""
        first = self.shots[0][0]
        if self.job.references:
            image = radiance(reference_files(self.job, [first])[0], self.sources.target)
        elif self.sources.is_ours:
            image = radiance(first.passes[COLOUR], self.sources.target)
        else:
            image = read_pixels(first, self.sources)[0].arrays[COLOUR]
        return clip_exposure(luminance(image.clip(0, None)))

    def introduction(self) -> str:
        """What was found, what is derived, what is done without."""
        frames = [frame for shot in self.shots for frame in shot]
        head = f"{len(frames)} frames, {frames[0].passes[COLOUR]} to {frames[-1].passes[COLOUR].name}"
        if missing := gaps(frames):
            head += f"; frames are missing before {', '.join(map(str, missing))}: history begins anew there"
        ours = [("everything", "onespp's own channels and cameras")]
        return f"{head}\n{report(ours if self.sources.is_ours else self.understanding.words)}"

    def settings(self) -> dict[str, Any]:
        """All that the bytes of a frame follow from, but for the files themselves."""
        job = self.job
        first = self.shots[0][0]
        return {
            "denoiser": job.denoiser,
            "weights": file_digest(job.weights) if job.weights else None,
            "precision": self.spec.precision,
            "quality": job.quality,
            "passes": {name: str(path.parent.resolve()) for name, path in first.passes.items()},
            "first frame": first.number,
            "reset-at": sorted(job.reset_at),
            "layers": sorted(job.layers),
            "motion": str(job.motion if self.sources.is_ours else self.understanding.reading.meaning),
            "as": job.stored_as,
            "spp": job.spp,
            "error": job.error or None,
            "versions": versions(DENOISING),
        }

    def play(self) -> Iterator[int]:
        """Denoise what is not there yet; yields how many pixels of each new frame were not finite.

        Within a shot every frame follows from those before it: finished ones are computed again, but not written, where
        a later one is missing.
        """
        with tqdm(total=sum(map(len, self.shots)), desc=self.job.denoiser, unit="frame") as progress:
            for shot in self.shots:
                start = next((i for i, files in enumerate(shot) if not self.is_finished(files)), len(shot))
                yield from self.play_shot(shot, start, progress)

    def is_finished(self, files: FrameFiles) -> bool:
        """Whether a frame's output is there, and its error if asked for, and no older than what it was made of."""
        outputs = [self.job.out / files.name, *([self.preview(files)] if self.job.previews else [])]
        if not all(path.exists() for path in outputs):
            return False
        if self.teller and not self.errors.has(files.number, self.job.until):
            return False
        newest = max(path.stat().st_mtime for path in files.passes.values())
        return all(path.stat().st_mtime >= newest for path in outputs)

    def preview(self, files: FrameFiles) -> Path:
        return (self.job.out / files.name).with_suffix(".png")

    def play_shot(self, shot: Sequence[FrameFiles], start: int, progress: Any) -> Iterator[int]:
        """The frames of a shot, of which those before `start` are finished."""
        state: State | None = None
        player = self.player()
        for index, files in enumerate(shot):
            carries = self.has_history and (index == 0 or type(state) is not State)
            if start < len(shot) and (carries or index >= start):
                image, frame, nonfinite = player(files)
                if frame.size != self.size:
                    raise BadInput(
                        f"{image.path} is {image.width}x{image.height}, unlike the first frame: name one sequence"
                    )
                if self.teller and index >= start:
                    output, state, estimate = with_error(self.teller, frame, state)
                    self.keep_error(estimate, files.number, image)
                else:
                    output, state = self.denoiser(frame, state)
                if index >= start:
                    self.write(files, image, output[0].permute(1, 2, 0).numpy())
                    yield nonfinite
            progress.update()

    @cached_property
    def teller(self) -> Shrunk | None:
        """The denoiser, where it is asked how far it is from the truth."""
        return self.denoiser if self.job.tells_error and isinstance(self.denoiser, Shrunk) else None

    def keep_error(self, estimate: ErrorEstimate, number: int, image: ExrImage) -> None:
        """What is asked for of a frame's error: its row, its layer."""
        self.errors.add(FrameError.of(number, estimate, self.job.until))
        if self.job.error:
            image.add(ERROR_LAYER, estimate.radiance()[0].permute(1, 2, 0).numpy(), self.sources.target[0])

    @cached_property
    def errors(self) -> ErrorTable:
        return ErrorTable(self.job.out)

    @cached_property
    def size(self) -> tuple[int, int]:
        """(H, W) of the first frame."""
        first = ExrImage(self.shots[0][0].passes[COLOUR], header_only=True)
        return first.height, first.width

    @property
    def has_history(self) -> bool:
        return self.sources.is_ours or self.understanding.reading.has_history

    def player(self) -> Callable[[FrameFiles], tuple[ExrImage, Frame, int]]:
        """What makes a frame of files: the image to write to, the Frame, and how many pixels were not finite."""
        if self.sources.is_ours:
            own = OwnShot(self.denoiser.reads)

            def ours(files: FrameFiles) -> tuple[ExrImage, Frame, int]:
                file = ExrImage(files.passes[COLOUR])
                frame = own.frame(file)
                images = [tensor.flatten(1, -3) for tensor in frame.channels.values()]  # halves are images, too
                bad = [~torch.isfinite(image).all(dim=1) for image in images]
                return file, frame, int(torch.stack(bad).any(dim=0).sum())

            return ours
        shot = Shot(self.understanding.reading, self.denoiser.reads, str(self.shots[0][0].passes[COLOUR]), self.job.spp)

        def foreign(files: FrameFiles) -> tuple[ExrImage, Frame, int]:
            pixels, image = read_pixels(files, self.sources)
            return image, shot.frame(pixels), pixels.nonfinite

        return foreign

    def write(self, files: FrameFiles, image: ExrImage, radiance: NDArray[np.float32]) -> None:
        """The frame's file with denoised radiance in it, and its preview."""
        image.replace(self.sources.target, radiance, DTYPES[self.job.stored_as])
        if self.job.previews:
            from PIL import Image

            shown = display(np.nan_to_num(radiance).clip(0, None), self.exposure)
            with replacing(self.preview(files)) as temporary:
                Image.fromarray((255 * shown + 0.5).astype(np.uint8)).save(temporary, "PNG")
        image.write(self.job.out / files.name, f"onespp {self.job.denoiser}")
