"""What is measured on the way through a clip: of a denoiser, and of the reference that it is held to."""

from dataclasses import dataclass, field

import torch
from torch import Tensor

from datasets.clip import Clip
from datasets.frame import Frame, Signal, disoccluded
from eval.disocclusion_crops import densest_window
from eval.metrics import TemporalMetrics, disocclusion_l1, image_metrics
from eval.noise_floor import noise_floor
from eval.results import REFERENCE, Result, Values, digest, key, mean_floor, means
from models.denoiser import Denoiser, State


@dataclass
class Track:
    """One denoiser's way through one clip."""

    name: str
    denoiser: Denoiser
    weights: str | None
    state: State | None = None
    temporal: TemporalMetrics = field(default_factory=TemporalMetrics)
    per_frame: list[Values] = field(default_factory=list)
    nonfinite: int = 0

    @property
    def signal(self) -> Signal:
        return self.denoiser.signal

    @property
    def precision(self) -> str:
        return str(self.denoiser.precision).removeprefix("torch.")

    def key(self, clip: Clip) -> str:
        weights = digest(self.weights) if self.weights else None
        return key(clip, name=self.name, signal=self.signal, precision=self.precision, weights=weights)

    def step(self, frame: Frame, halves: Tensor, exposure: float, still: bool) -> Tensor:
        """Denoise one frame and measure it. Returns the radiance (1, 3, H, W)."""
        output, self.state = self.denoiser(frame, self.state)
        self.nonfinite += int((~torch.isfinite(output)).any(dim=1).sum())
        metrics = image_metrics(output, halves, exposure) | self.temporal.update(output, halves, exposure, still)
        metrics["disocclusion_l1"] = disocclusion_l1(output, halves, exposure, frame.motion, frame.dual_motion)
        self.per_frame.append(metrics)
        return output

    def result(self, clip: Clip) -> Result:
        facts = self.key(clip), self.name, self.signal, clip.scene, clip.name
        return Result(*facts, means(self.per_frame), self.per_frame, self.nonfinite, self.precision)


@dataclass
class Truth:
    """The reference's way through one clip: its noise floors, and where most comes into view."""

    signal: Signal
    name: str = REFERENCE
    temporal: TemporalMetrics = field(default_factory=TemporalMetrics)
    per_frame: list[Values] = field(default_factory=list)
    crops: list[dict[str, int]] = field(default_factory=list)

    def key(self, clip: Clip) -> str:
        return key(clip, name=self.name, signal=self.signal)

    def step(self, frame: Frame, halves: Tensor, exposure: float, still: bool) -> Tensor:
        """Measure one frame's reference. Returns the radiance (1, 3, H, W)."""
        reference = halves.mean(dim=0, keepdim=True)
        floor = noise_floor(halves, exposure, frame.motion, frame.dual_motion)
        temporal = self.temporal.update(reference, halves, exposure, still)["temporal_error_floor"]
        window = densest_window(disoccluded(frame.motion, frame.dual_motion)[0, 0])
        self.crops += [{"frame": len(self.per_frame), **window._asdict()}] if window else []
        self.per_frame.append(floor | {"temporal_error": temporal})
        return reference

    def result(self, clip: Clip) -> Result:
        facts = self.key(clip), self.name, self.signal, clip.scene, clip.name
        return Result(*facts, mean_floor(self.per_frame), self.per_frame, crops=self.crops)
