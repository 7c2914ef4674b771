"""The way of denoisers, and of the reference that they are held to, through one clip."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from datasets.clip import Clip
from datasets.frame import Frame, Signal, disoccluded, read_frame, to_tensor
from datasets.tonemap import display
from eval.comparison import Comparison, Luminances
from eval.disocclusion_crops import densest_crop
from eval.means import mean_floor, means
from eval.metrics import Values, measure, noise_floors, temporal_error_floor
from eval.results import REFERENCE, Result, result_key, save_error, save_picture
from models.denoiser import Denoiser, State
from models.operators import finite
from models.wrappers.error_estimate import with_error
from models.wrappers.shrinkage import Shrunk
from provenance import file_digest

METRICS_CHANNELS = ("motion", "dual_motion")


@dataclass
class Entrant:
    """A denoiser to be evaluated, on however many clips.

    Attributes:
        name: what results call it.
        precision: of its network: "float32", "bfloat16" or "float16".
        weights: the file of its weights, None where it has none.
        modules: of onespp, in which it is defined.
        build: makes it, ready to use; called once, and only if results are missing.
        tells_error: whether to keep maps of the error that it tells, where it is a NAME+js and frames have halves.
        device: where it computes: "cpu" or "cuda".
    """

    name: str
    signal: Signal
    precision: str
    weights: Path | None
    modules: tuple[str, ...]
    build: Callable[[], Denoiser]
    tells_error: bool = False
    device: str = "cpu"

    @cached_property
    def denoiser(self) -> Denoiser:
        return self.build()

    @cached_property
    def weights_digest(self) -> str | None:
        return file_digest(self.weights) if self.weights else None

    def key(self, clip: Clip) -> str:
        """A digest of all that its result on a clip follows from."""
        facts = {
            "name": self.name,
            "signal": self.signal,
            "precision": self.precision,
            "weights": self.weights_digest,
            "device": self.device,
        }
        return result_key(clip, [__name__, *self.modules], facts)


@dataclass
class ClipRun:
    """One denoiser's way through one clip."""

    entrant: Entrant
    state: State | None = None
    before: Luminances | None = None
    frames: list[Values] = field(default_factory=list)
    nonfinite: int = 0
    error: Tensor | None = None  # that the last frame's samples tell, (1, H, W), in exposed radiance

    @property
    def name(self) -> str:
        return self.entrant.name

    @property
    def signal(self) -> Signal:
        return self.entrant.signal

    @property
    def reads(self) -> tuple[str, ...]:
        return self.entrant.denoiser.reads

    def key(self, clip: Clip) -> str:
        return self.entrant.key(clip)

    def step(self, frame: Frame, halves: Tensor, exposure: float, still: bool) -> Tensor:
        """Denoise one frame and measure it. Returns the radiance (1, 3, H, W)."""
        denoiser = self.entrant.denoiser
        moved = frame.to(denoiser.device)
        if self.entrant.tells_error and isinstance(denoiser, Shrunk) and frame.has_buffers:
            output, self.state, estimate = with_error(denoiser, moved, self.state)
            self.error = exposure * estimate.radiance().cpu().square().mean(dim=1).sqrt()
        else:
            output, self.state = denoiser(moved, self.state)
        output = output.cpu()
        self.nonfinite += int((~torch.isfinite(output)).any(dim=1).sum())
        comparison = Comparison(output, halves, exposure, hidden(frame), self.before, still)
        self.frames.append(measure(comparison) | {"temporal_error_floor": temporal_error_floor(comparison)})
        self.before = comparison.luminances
        return output

    def result(self, clip: Clip) -> Result:
        precision = self.entrant.precision
        return result_of(self, clip, means(self.frames), nonfinite=self.nonfinite, precision=precision)


@dataclass
class ReferenceRun:
    """The reference's way through one clip: its noise floors, and where most comes into view."""

    signal: Signal
    name: str = REFERENCE
    reads: tuple[str, ...] = ()
    before: Luminances | None = None
    frames: list[Values] = field(default_factory=list)
    crops: list[dict[str, int]] = field(default_factory=list)

    def key(self, clip: Clip) -> str:
        return result_key(clip, [__name__], {"name": self.name, "signal": self.signal})

    def step(self, frame: Frame, halves: Tensor, exposure: float, still: bool) -> Tensor:
        """Measure one frame's reference. Returns the radiance (1, 3, H, W)."""
        reference = halves.mean(dim=0, keepdim=True)
        disoccluded_pixels = hidden(frame)
        comparison = Comparison(reference, halves, exposure, disoccluded_pixels, self.before, still)
        crop = densest_crop(disoccluded_pixels[0, 0])
        if crop:
            self.crops.append({"frame": len(self.frames)} | crop._asdict())
        self.frames.append(noise_floors(comparison))
        self.before = comparison.luminances
        return reference

    def result(self, clip: Clip) -> Result:
        return result_of(self, clip, mean_floor(self.frames), crops=self.crops)


Run = ClipRun | ReferenceRun


def result_of(run: Run, clip: Clip, metrics: Values, **facts: Any) -> Result:
    """What a run through a clip ended with: its mean `metrics`, and `facts` by the names of Result's fields."""
    return Result(run.key(clip), run.name, run.signal, clip.scene, clip.name, metrics, run.frames, **facts)


def hidden(frame: Frame) -> Tensor:
    """The pixels (1, 1, H, W) that were hidden in the frame before."""
    return disoccluded(frame.motion, frame.dual_motion)


def is_still(clip: Clip) -> bool:
    """Whether neither the camera nor any mesh moves in the clip."""
    first = clip.view(0)
    views = (clip.view(frame) for frame in range(1, clip.frames))
    return all(np.array_equal(a, b) for view in views for a, b in zip(first, view, strict=True))


@torch.no_grad()
def play(clip: Clip, runs: Sequence[Run], folders: Sequence[Path], quiet: bool = False) -> None:
    """Take all runs through a clip frame by frame, in memory that does not grow with its length; keep what they show.

    Each is held to the reference of the signal that it returns.
    """
    channels = sorted({*METRICS_CHANNELS, *(channel for run in runs for channel in run.reads)})
    signals = {run.signal for run in runs}
    still = is_still(clip)
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False, disable=quiet):
        frame = read_frame(clip, index, channels)
        halves = {signal: to_tensor(clip.reference(index, signal), has_buffers=True)[0] for signal in signals}
        for run, folder in zip(runs, folders, strict=True):
            output = run.step(frame, halves[run.signal], clip.exposure, still)
            image = display(finite(output), clip.exposure)
            save_picture(folder, index, image[0].permute(1, 2, 0).numpy())
            if isinstance(run, ClipRun) and run.error is not None:
                save_error(folder, index, run.error[0].numpy())
