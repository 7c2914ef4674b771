"""Augmentation of training sequences: each transforms all channels and cameras consistently."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from datasets.cameras import Cameras
from datasets.channels import CHANNELS
from datasets.frame import Frame


@dataclass(frozen=True)
class Augmentation:
    """Which augmentations are on, those of RAE §4.3 first."""

    reverse: bool = False  # half of the sequences are played backward
    stop: bool = False  # in a quarter the camera stops at a random frame, while noise keeps changing
    rotate: bool = False  # every sequence is turned by a random multiple of 90 degrees
    gain: bool = False  # every sequence has a random factor in [0, 2] for each colour channel
    exposure: bool = False  # or one for all, of 2^-1.5 to 2^1.5
    samples: bool = False  # three in ten sequences are means of 2, 4, 8, ... realisations
    light: bool = False  # over three in ten sequences the edge of a shadow or of more light moves

    def playback(self, frames: int, length: int, rng: np.random.Generator) -> list[int]:
        """`length` frame numbers of a clip of `frames`, in the order in which they are played."""
        start = int(rng.integers(frames - length + 1))
        positions = np.arange(start, start + length)
        if self.reverse and rng.random() < 0.5:
            positions = positions[::-1]
        if self.stop and rng.random() < 0.25:
            positions = positions[np.minimum(np.arange(length), rng.integers(length))]
        return [int(position) for position in positions]

    def draw(self, realisations: int, length: int, stopped: bool, rng: np.random.Generator) -> "Draw":
        """What is random about a sequence of `length` frames from a clip with so many `realisations`."""
        deal = [int(realisation) for realisation in rng.permutation(realisations)]
        turns = int(rng.integers(4)) if self.rotate else 0
        gain = torch.from_numpy(rng.uniform(0, 2, (1, 3, 1, 1)).astype(np.float32)) if self.gain else None
        if self.exposure:
            gain = torch.full((1, 3, 1, 1), 2 ** float(rng.uniform(-1.5, 1.5)))
        doublings = int(np.log2(realisations)) if self.samples and not stopped else 0
        together = 2 ** int(rng.integers(1, doublings + 1)) if doublings and rng.random() >= 0.7 else 1
        edge = LightEdge.random(rng, length) if self.light and rng.random() < 0.3 else None
        return Draw(deal, together, turns, gain, edge)


@dataclass(frozen=True)
class LightEdge:
    """The edge of a shadow, or of more light: light is multiplied by `factor` on one side of a moving line."""

    factor: float
    angle: float  # of the direction in which it moves, radians
    speed: float  # pixels per frame
    passes: float  # when it passes the middle of the image, in frames
    softness: float  # pixels over which it fades

    @staticmethod
    def random(rng: np.random.Generator, length: int) -> "LightEdge":
        """An edge that passes within a sequence of `length` frames."""
        return LightEdge(
            factor=2 ** float(rng.uniform(-4, 3)),
            angle=float(rng.uniform(0, 2 * math.pi)),
            speed=2 ** float(rng.uniform(-1, 8)),
            passes=float(rng.uniform(0, length - 1)),
            softness=2 ** float(rng.uniform(-1, 4)),
        )

    def light(self, frame: float, height: int, width: int) -> Tensor:
        """What light is multiplied by in a `frame`, (height, width), between 1 and the factor."""
        y = torch.arange(height)[:, None] - (height - 1) / 2
        x = torch.arange(width) - (width - 1) / 2
        ahead = x * math.cos(self.angle) + y * math.sin(self.angle) - self.speed * (frame - self.passes)
        return 1 + (self.factor - 1) * torch.sigmoid(-ahead / self.softness)


@dataclass(frozen=True)
class Draw:
    """What is random about the pixels of a sequence."""

    deal: list[int]  # realisations in the order of their use: a stopped camera has new noise while any is left
    together: int  # the number of realisations that a frame is the mean of
    turns: int  # by 90 degrees
    gain: Tensor | None  # of colours (1, 3, 1, 1)
    edge: LightEdge | None

    def realisations(self, time: int) -> list[int]:
        return [self.deal[(self.together * time + i) % len(self.deal)] for i in range(self.together)]

    def apply(self, frame: Frame, time: int) -> Frame:
        if self.edge is not None:
            frame = lit(frame, self.edge.light(time, *frame.size))
        for _ in range(self.turns):
            frame = rotated(frame)
        return frame if self.gain is None else replace(frame, colour_gain=self.gain)


def lit(frame: Frame, light: Tensor) -> Frame:
    """The frame with all reflected light, noisy and in references, times `light` (H, W)."""
    changed = {name: tensor * light for name, tensor in frame.channels.items() if CHANNELS[name].is_reflected}
    brightening = torch.stack([torch.log(light).mean(), torch.tensor(0.0)])
    return replace(frame.with_channels(changed), whole=None if frame.whole is None else frame.whole + brightening)


def averaged(frames: Sequence[Frame]) -> Frame:
    """The first of several realisations of a frame, with the mean over all of noise and of what it met."""

    def stacked(name: str) -> Tensor:
        return torch.stack([frame.channels[name] for frame in frames])

    means = {}
    for name in frames[0].channels:
        if CHANNELS[name].kind == "noisy":
            means[name] = stacked(name).mean(dim=0)
        elif CHANNELS[name].kind == "hit":  # the mean over those that met anything
            means[name] = stacked(name).sum(dim=0) / (stacked(name) > 0).sum(dim=0).clamp(min=1)
    return replace(frames[0].with_channels(means), spp=len(frames) * frames[0].samples)


def rotated(frame: Frame) -> Frame:
    """The frame turned by 90° counter-clockwise: images, motion vectors and cameras alike."""
    width = frame.size[1]
    channels = {name: torch.rot90(tensor, dims=(-2, -1)) for name, tensor in frame.channels.items()}
    for name, tensor in channels.items():
        if CHANNELS[name].kind == "motion":
            dx, dy = tensor.unbind(dim=1)
            channels[name] = torch.stack([dy, -dx], dim=1)
    now, previous = (rotated_cameras(cameras, width) for cameras in (frame.now, frame.previous))
    return replace(frame, channels=channels, now=now, previous=previous)


def rotated_cameras(cameras: Cameras, width: int) -> Cameras:
    """The cameras rolled about the viewing axis, as of the image turned by 90° counter-clockwise.

    A position (x, y) of the image, `width` pixels wide, becomes (y, width - x).
    """
    roll = torch.eye(4, dtype=torch.float64)
    roll[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return replace(cameras, K=turn @ cameras.K @ roll[:3, :3], camera_to_world=cameras.camera_to_world @ roll)
