"""Runs of denoisers and of the reference through one clip, measured frame by frame."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d
from tqdm import tqdm

from datasets.clip import Clip
from datasets.frame import Frame, Signal, disoccluded, read_frame, to_image, to_tensor
from datasets.tonemap import display
from eval.comparison import Comparison, Previous
from eval.metrics import Values, mean_floor, means, measure, noise_floors, temporal_error_floor
from eval.results import MAX_SHOWN_ERROR, NOISE_FLOOR, Result, picture_path, result_key, save_picture
from models.denoiser import Denoiser, State
from models.operators import finite
from models.wrappers.error_estimate import denoise_with_error
from models.wrappers.shrinkage import JamesStein
from provenance import file_digest

if TYPE_CHECKING:  # it imports all denoisers, and results of one must not depend on the code of the others
    from models.spec import DenoiserSpec

METRICS_CHANNELS = ("motion", "dual_motion")
SMALLEST_CROP = 16  # px
CROPS_A_SIDE = 4  # a crop is a quarter of the image's shorter side


@dataclass
class NamedDenoiser:
    """A denoiser to evaluate on any number of clips, under the name that results give it."""

    spec: "DenoiserSpec"
    name: str
    saves_error: bool = False  # whether to store error maps, where it is a NAME+js and frames have two sample buffers

    @cached_property
    def denoiser(self) -> Denoiser:
        """Built on first use: only if results are missing."""
        return self.spec.build()

    @cached_property
    def weights_digest(self) -> str | None:
        return file_digest(self.spec.weights) if self.spec.weights else None

    def key(self, clip: Clip) -> str:
        """A digest of everything that determines its result on a clip."""
        facts = {
            "name": self.name,
            "signal": self.spec.returns,
            "precision": self.spec.precision,
            "weights": self.weights_digest,
            "device": self.spec.device,
            "c": self.spec.c_digest,
        }
        return result_key(clip, [__name__, *self.spec.modules], facts)


@dataclass
class DenoiserRun:
    evaluated: NamedDenoiser
    state: State | None = None
    before: Previous | None = None
    frames: list[Values] = field(default_factory=list)
    nonfinite: int = 0
    error: Tensor | None = None  # estimated for the last frame, (1, H, W), in radiance

    @property
    def name(self) -> str:
        return self.evaluated.name

    @property
    def signal(self) -> Signal:
        return self.evaluated.spec.returns

    @property
    def reads(self) -> tuple[str, ...]:
        return self.evaluated.denoiser.reads

    def key(self, clip: Clip) -> str:
        return self.evaluated.key(clip)

    def radiance(self, frame: Frame, reference_buffers: Tensor | None) -> Tensor:
        """The next frame denoised, (1, 3, H, W)."""
        denoiser = self.evaluated.denoiser
        moved = frame.to(denoiser.device)
        if self.evaluated.saves_error and isinstance(denoiser, JamesStein) and frame.has_buffers:
            output, self.state, estimate = denoise_with_error(denoiser, moved, self.state)
            self.error = estimate.radiance_error().cpu().square().mean(dim=1).sqrt()
        else:
            output, self.state = denoiser(moved, self.state)
        output = output.cpu()
        self.nonfinite += int((~torch.isfinite(output)).any(dim=1).sum())
        return output

    def values(self, comparison: Comparison) -> Values:
        return measure(comparison) | {"temporal_error_floor": temporal_error_floor(comparison)}

    def result(self, clip: Clip) -> Result:
        precision = self.evaluated.spec.precision
        return result_of(self, clip, means(self.frames), nonfinite=self.nonfinite, precision=precision)


def densest_crop(mask: Tensor) -> dict[str, int] | None:
    """The square window with most pixels of a mask (H, W), centred on them within the image; None for an empty mask.

    Its place `x` and `y` and its `size` are in pixels; it contains `pixels` of the mask.
    """
    height, width = mask.shape
    shorter = min(height, width)
    size = min(shorter, max(SMALLEST_CROP, shorter // CROPS_A_SIDE))
    best = int(avg_pool2d(mask[None, None].double(), size, stride=1).argmax())
    y, x = divmod(best, width - size + 1)
    inside = mask[y : y + size, x : x + size].nonzero().double()
    if not len(inside):
        return None
    dy, dx = (inside.mean(dim=0) - (size - 1) / 2).round().int().tolist()
    y = min(max(0, y + dy), height - size)
    x = min(max(0, x + dx), width - size)
    return {"x": x, "y": y, "size": size, "pixels": int(mask[y : y + size, x : x + size].sum())}


@dataclass
class ReferenceRun:
    """The reference's run through one clip: its noise floors, and the crops with most disocclusions."""

    signal: Signal
    name: str = NOISE_FLOOR
    reads: tuple[str, ...] = ()
    before: Previous | None = None
    frames: list[Values] = field(default_factory=list)
    crops: list[dict[str, int]] = field(default_factory=list)

    def key(self, clip: Clip) -> str:
        return result_key(clip, [__name__], {"name": self.name, "signal": self.signal})

    def radiance(self, frame: Frame, reference_buffers: Tensor | None) -> Tensor | None:
        """The frame's reference (1, 3, H, W); None where there is none."""
        return None if reference_buffers is None else reference_buffers.mean(dim=0, keepdim=True)

    def values(self, comparison: Comparison) -> Values:
        assert comparison.disoccluded is not None
        if crop := densest_crop(comparison.disoccluded[0, 0]):
            self.crops.append({"frame": len(self.frames)} | crop)
        return noise_floors(comparison)

    def result(self, clip: Clip) -> Result:
        return result_of(self, clip, mean_floor(self.frames), crops=self.crops)


Run = DenoiserRun | ReferenceRun


def result_of(run: Run, clip: Clip, metrics: Values, **facts: Any) -> Result:
    """The result of a finished run: its mean `metrics`, and `facts` by the names of Result's fields."""
    return Result(run.key(clip), run.name, run.signal, clip.scene, clip.name, metrics, run.frames, **facts)


def is_still(clip: Clip) -> bool:
    """Whether neither the camera nor any mesh moves in the clip."""
    first = clip.view(0)
    views = (clip.view(frame) for frame in range(1, clip.frames))
    return all(np.array_equal(a, b) for view in views for a, b in zip(first, view, strict=True))


@torch.no_grad()
def run_clip(clip: Clip, runs: Mapping[Path, Run], quiet: bool = False) -> None:
    """Step all runs through a clip frame by frame and store their pictures, in memory independent of its length.

    `runs` are by the folder of their pictures. Each is compared with the reference of the signal that it returns, and
    where there is none has no picture.
    """
    channels = sorted({*METRICS_CHANNELS, *(channel for run in runs.values() for channel in run.reads)})
    signals = {run.signal for run in runs.values()}
    still = is_still(clip)
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False, disable=quiet):
        frame = read_frame(clip, index, channels)
        hidden = disoccluded(frame.motion, frame.dual_motion)
        judged = signals if index in clip.judged else set()
        buffers = {signal: to_tensor(clip.reference(index, signal), has_buffers=True)[0] for signal in judged}
        for folder, run in runs.items():
            reference = buffers.get(run.signal)
            output = run.radiance(frame, reference)
            if output is None or reference is None:
                run.frames.append({})
                run.before = None
                continue
            context = (hidden, run.before, still, frame.motion, clip.is_imported)
            comparison = Comparison(output, reference, clip.exposure, *context)
            run.frames.append(run.values(comparison))
            run.before = comparison.as_previous()
            save_picture(picture_path(folder, index), as_displayed(output, clip.exposure))
            if isinstance(run, DenoiserRun) and run.error is not None:
                error = (clip.exposure * run.error)[0].numpy() / MAX_SHOWN_ERROR
                save_picture(picture_path(folder, index, "error-"), error.clip(0, 1))


def as_displayed(radiance: Tensor, exposure: float) -> NDArray[np.floating]:
    """(H, W, 3) in [0, 1] of radiance (1, 3, H, W)."""
    return to_image(display(finite(radiance), exposure))


def play(
    clip: Clip, denoisers: Sequence[Denoiser], also: Sequence[str] = ()
) -> Iterator[tuple[int, Frame, list[Tensor]]]:
    """The number of each frame of a clip, the frame, and its radiance (1, 3, H, W) by each denoiser, on the CPU.

    Frames have the channels that any of the denoisers reads, and those in `also`.
    """
    channels = sorted({*also, *(channel for denoiser in denoisers for channel in denoiser.reads)})
    states: list[State | None] = [None] * len(denoisers)
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False):
        frame = read_frame(clip, index, channels)
        outputs = []
        for place, denoiser in enumerate(denoisers):
            output, states[place] = denoiser(frame.to(denoiser.device), states[place])
            outputs.append(output.cpu())
        yield index, frame, outputs
