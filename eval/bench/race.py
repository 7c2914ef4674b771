"""A race of denoisers: what a frame costs each of them, from noisy Frame to radiance."""

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
RACE_SECONDS = 240.0


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
    """A denoiser on its way through the sequence.

    Attributes:
        in_network: seconds that each frame spent in the network; empty without one.
        seconds: of each frame that counts.
    """

    spec: DenoiserSpec
    denoiser: Denoiser
    state: State | None = None
    in_network: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    @staticmethod
    def of(spec: DenoiserSpec) -> "Contender":
        contender = Contender(spec, spec.build())
        if network := network_of(contender.denoiser):
            network.register_forward_pre_hook(lambda *_: contender.enter_network())
            network.register_forward_hook(lambda *_: contender.leave_network())
        return contender

    def enter_network(self) -> None:
        self.in_network.append(-device_clock(self.spec.device))

    def leave_network(self) -> None:
        self.in_network[-1] += device_clock(self.spec.device)

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
        """The part of a frame's time that the network takes, between 0 and 1; None without a network."""
        if not self.in_network:
            return None
        timed = self.in_network[-len(self.seconds) :]
        return float(np.median(np.divide(timed, self.seconds)))


def network_of(denoiser: Denoiser) -> nn.Module | None:
    network = getattr(unwrapped(denoiser), "network", None)
    return network if isinstance(network, nn.Module) else None


@torch.inference_mode()
def race(
    specs: Sequence[DenoiserSpec], size: Size, measured: int = TIMED_FRAMES, patience: float = RACE_SECONDS
) -> list[Contender]:
    """Time all specs, of one device, on one sequence: each frame by each of them in turn.

    After `patience` seconds it ends with fewer than `measured` frames, but at least FEWEST_FRAMES.
    """
    release_memory()  # what earlier races took: all these states of 1920 x 1080 fill most of 24 GB
    contenders = [Contender.of(spec) for spec in specs]
    device = specs[0].device
    frame: Frame

    def make_frame(index: int) -> None:
        nonlocal frame
        frame = synthetic_frame(index, *size).to(device)

    def stepping(contender: Contender) -> Callable[[], None]:
        return lambda: contender.step(frame)

    seconds = take_turns(
        {f"{contender.spec.way} {contender.spec.precision}": stepping(contender) for contender in contenders},
        measured,
        warm_up=WARM_UP_FRAMES,
        before_round=make_frame,
        fewest=FEWEST_FRAMES,
        patience=patience,
        clock=partial(device_clock, device),
        label=size_name(size),
    )
    for contender, spent in zip(contenders, seconds.values(), strict=True):
        contender.seconds = spent
    return contenders
