"""Timing denoisers against each other, from noisy Frame to radiance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import nn

from datasets.frame import Frame
from eval.bench.memory import release_memory
from eval.bench.sizes import Size, size_name
from eval.bench.synthetic_frames import synthetic_frame
from models.denoiser import Denoiser, State
from models.spec import DenoiserSpec
from models.wrappers.wrapper import unwrapped
from timing import device_clock, take_turns

WARM_UP_FRAMES = 2
TIMED_FRAMES = 10
FEWEST_FRAMES = 5  # timed, where all denoisers together take longer than
MAX_SECONDS = 240.0


@dataclass(frozen=True)
class Timing:
    """Milliseconds per frame of a denoiser: median, 10th and 90th percentile."""

    denoiser: str
    height: int
    width: int
    dtype: str
    threads: int
    frames: int
    ms_median: float
    ms_p10: float
    ms_p90: float


@dataclass
class TimedDenoiser:
    """A denoiser, its state, and the times that were measured."""

    spec: DenoiserSpec
    denoiser: Denoiser
    state: State | None = None
    seconds: list[float] = field(default_factory=list)  # of each frame after warm-up

    @staticmethod
    def of(spec: DenoiserSpec) -> "TimedDenoiser":
        return TimedDenoiser(spec, spec.build())

    def step(self, frame: Frame) -> None:
        """Denoise the next frame, which is on the device already."""
        with self.spec.running():
            _, self.state = self.denoiser(frame, self.state)

    def timing(self, size: Size) -> Timing:
        p10, median, p90 = (float(ms) for ms in 1e3 * np.percentile(self.seconds, (10, 50, 90)))
        return Timing(
            self.spec.way, *size, self.spec.precision, torch.get_num_threads(), len(self.seconds), median, p10, p90
        )


def network_of(denoiser: Denoiser) -> nn.Module | None:
    network = getattr(unwrapped(denoiser), "network", None)
    return network if isinstance(network, nn.Module) else None


@torch.inference_mode()
def time_in_turns(
    specs: Sequence[DenoiserSpec], size: Size, measured: int = TIMED_FRAMES, max_seconds: float = MAX_SECONDS
) -> list[TimedDenoiser]:
    """Time all specs, of one device, on one sequence: each frame by each of them in turn.

    After `max_seconds` it stops before `measured` frames, but not before FEWEST_FRAMES.
    """
    release_memory()  # of earlier calls: the states of all denoisers at 1920 x 1080 fill most of 24 GB
    denoisers = [TimedDenoiser.of(spec) for spec in specs]
    device = specs[0].device
    frame: Frame

    def make_frame(index: int) -> None:
        nonlocal frame
        frame = synthetic_frame(index, *size).to(device)

    def stepping(timed: TimedDenoiser) -> Callable[[], None]:
        return lambda: timed.step(frame)

    seconds = take_turns(
        {f"{timed.spec.way} {timed.spec.precision}": stepping(timed) for timed in denoisers},
        measured,
        warm_up=WARM_UP_FRAMES,
        before_round=make_frame,
        fewest=FEWEST_FRAMES,
        patience=max_seconds,
        clock=partial(device_clock, device),
        label=size_name(size),
    )
    for timed, spent in zip(denoisers, seconds.values(), strict=True):
        timed.seconds = spent
    return denoisers
