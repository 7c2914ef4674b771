"""A race of denoisers: what a frame costs each of them, from noisy Frame to radiance."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from torch import nn

from datasets.frame import Frame
from eval.bench.memory import release
from eval.bench.sizes import Size, size_name
from eval.bench.synthetic_frames import synthetic_frame
from eval.spec import DenoiserSpec
from models.denoiser import Denoiser, State
from models.taa import inner_denoiser
from timing import take_turns

WARM_UP_FRAMES = 2
MEASURED_FRAMES = 10
FEWEST_FRAMES = 5  # measured, where all denoisers together take longer than
PATIENCE = 240.0  # seconds


@dataclass(frozen=True)
class Timing:
    """What a denoiser takes for a frame: median milliseconds, and how far they spread."""

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
class Contender:
    """A denoiser on its way through the sequence."""

    spec: DenoiserSpec
    denoiser: Denoiser
    state: State | None = None
    in_network: list[float] = field(default_factory=list)  # seconds of each frame; empty without a network
    seconds: list[float] = field(default_factory=list)  # of each frame that counts

    @staticmethod
    def of(spec: DenoiserSpec) -> "Contender":
        contender = Contender(spec, spec.build())
        if network := network_of(contender.denoiser):
            network.register_forward_pre_hook(lambda *_: contender.enter_network())
            network.register_forward_hook(lambda *_: contender.leave_network())
        return contender

    def clock(self) -> float:
        """Seconds, once the device has done all that it was given."""
        return device_clock(self.spec.device)

    def enter_network(self) -> None:
        self.in_network.append(-self.clock())

    def leave_network(self) -> None:
        self.in_network[-1] += self.clock()

    def step(self, frame: Frame) -> None:
        """Denoise the next frame, which is on the device already."""
        with self.spec.running():
            _, self.state = self.denoiser(frame, self.state)

    def timing(self, size: Size) -> Timing:
        p10, median, p90 = (float(ms) for ms in 1e3 * np.percentile(self.seconds, (10, 50, 90)))
        height, width = size
        return Timing(
            denoiser=self.spec.way,
            height=height,
            width=width,
            dtype=self.spec.precision,
            threads=torch.get_num_threads(),
            frames=len(self.seconds),
            ms_median=median,
            ms_p10=p10,
            ms_p90=p90,
        )

    def share_of_network(self) -> float | None:
        """Of a frame's time; None without a network."""
        if not self.in_network:
            return None
        return float(np.median(np.divide(self.in_network[-len(self.seconds) :], self.seconds)))


def network_of(denoiser: Denoiser) -> nn.Module | None:
    network = getattr(inner_denoiser(denoiser), "network", None)
    return network if isinstance(network, nn.Module) else None


def device_clock(device: str) -> float:
    """Seconds, once the device has done all that it was given."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


@torch.inference_mode()
def race(
    specs: Sequence[DenoiserSpec], size: Size, measured: int = MEASURED_FRAMES, patience: float = PATIENCE
) -> list[Contender]:
    """Time all specs, of one device, on one sequence: each frame by each of them in turn."""
    release()  # what earlier races took: all these states of 1920 x 1080 fill most of 24 GB
    contenders = [Contender.of(spec) for spec in specs]
    device = specs[0].device
    frames: list[Frame] = []

    def next_frame(index: int) -> None:
        frames[:] = [synthetic_frame(index, *size).to(device)]

    steps = [partial(step_with, contender, frames) for contender in contenders]
    seconds = take_turns(
        {f"{c.spec.way} {c.spec.precision}": step for c, step in zip(contenders, steps, strict=True)},
        measured,
        warm_up=WARM_UP_FRAMES,
        before_round=next_frame,
        fewest=min(measured, FEWEST_FRAMES),
        patience=patience,
        clock=partial(device_clock, device),
        label=size_name(size),
    )
    for contender, spent in zip(contenders, seconds.values(), strict=True):
        contender.seconds = spent
    return contenders


def step_with(contender: Contender, frames: Sequence[Frame]) -> None:
    contender.step(frames[0])
