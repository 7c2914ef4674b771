"""Training sequences: random crops of consecutive frames, augmented, read through memory maps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from datasets.channels import HIT_CHANNELS, NOISY_CHANNELS, REFERENCE_CHANNELS
from datasets.clip import Clip, ImageWindow
from datasets.frame import Frame, Signal, read_frame
from errors import BadInput
from models.history.running_scale import block_luminances, log_depth, log_luminance
from train.augmentation import Augmentation, averaged


def check_fits(clips: Sequence[Clip], length: int, crop: int | None, firsts: int = 0) -> None:
    """Raises BadInput where a clip is shorter than `length` frames or smaller than a crop.

    Where there are `firsts` beside the sequences, one clip of `length` frames is enough.
    """
    least = 1 if firsts and any(clip.frames >= length for clip in clips) else length
    for clip in clips:
        if clip.frames < least or min(clip.height, clip.width) < (crop or 1):
            size = f" of {crop}x{crop}" if crop else ""
            raise BadInput(
                f"{clip.path} has {clip.frames} frames of {clip.width}x{clip.height}: too few or too small to train on "
                f"{length} frames{size}; train with a smaller budget"
            )


def random_window(clip: Clip, crop: int | None, rng: np.random.Generator) -> ImageWindow:
    """`crop` x `crop` pixels at a random place in the image, or all of it where `crop` is None."""
    if crop is None:
        return slice(0, clip.height), slice(0, clip.width)
    top = int(rng.integers(clip.height - crop + 1))
    left = int(rng.integers(clip.width - crop + 1))
    return slice(top, top + crop), slice(left, left + crop)


class WholeFrames:
    """What running_scale measures in the noisy light of `signal`. Each frame and realisation is read once.

    A crop of 64 x 64 pixels may be three times brighter or darker than its frame; in use, networks get whole frames.
    """

    def __init__(self, signal: Signal):
        self.signal = signal
        self.measured: dict[tuple[str, int, int], tuple[Tensor, Tensor]] = {}

    @torch.no_grad()
    def __call__(self, clip: Clip, index: int, realisations: Sequence[int]) -> Tensor:
        """Logarithms of luminance and depth of the mean over `realisations` of frame `index`, (1, 2)."""
        luminances, scales = zip(*(self.measure(clip, index, each) for each in realisations), strict=True)
        if len(realisations) == 1:
            return scales[0]
        return torch.stack([log_luminance(torch.stack(luminances).mean(dim=0)), scales[0][:, 1]], dim=1)

    def measure(self, clip: Clip, index: int, realisation: int) -> tuple[Tensor, Tensor]:
        """Luminances of blocks, (1, blocks), and the logarithms of luminance and depth, (1, 2), of one realisation."""
        key = (str(clip.path), index, realisation)
        if key not in self.measured:
            light = ("indirect",) if self.signal == "indirect" else NOISY_CHANNELS
            frame = read_frame(clip, index, (*light, "albedo", "depth"), realisation, in_layers=False)
            radiance = frame.irradiance(self.signal).clamp(min=0) * frame.divisor
            luminances = block_luminances(radiance, frame.depth)
            scale = torch.stack([log_luminance(luminances), log_depth(frame.depth)], dim=1)
            self.measured[key] = luminances, scale
        return self.measured[key]


class Batch:
    """A Frame of all sequences for each time step. Fabric would convert a list, and cameras must stay float64.

    `firsts` are frames of other sequences, to be denoised without history.
    """

    def __init__(self, frames: list[Frame], firsts: Frame | None = None):
        self.frames = frames
        self.firsts = firsts

    def to(self, device: torch.device | str) -> "Batch":
        firsts = None if self.firsts is None else self.firsts.to(device)
        return Batch([frame.to(device) for frame in self.frames], firsts)


@dataclass(eq=False)
class TrainingSequences:
    """Sequences of `length` frames and `crop` x `crop` pixels (None: whole frames), with the channels in `reads`.

    References are always among the channels. Item i of epoch e depends on (seed, e, i) only. The sequences of an epoch
    have together as many pixels as the clips. Beside each, a batch has `firsts` frames without history, of any clip;
    then clips may be shorter than a sequence. Frames name the scale of the frames that they are crops of in the noisy
    light of `signal`, unless that is None. Raises BadInput as check_fits.
    """

    clips: Sequence[Clip]
    reads: Sequence[str]
    length: int
    crop: int | None
    augmentation: Augmentation
    seed: int
    signal: Signal | None = None
    firsts: int = 0
    epoch: int = 0  # that whose sequences come next

    def __post_init__(self) -> None:
        check_fits(self.clips, self.length, self.crop, self.firsts)
        self.channels = tuple(dict.fromkeys([*self.reads, *REFERENCE_CHANNELS]))
        self.sampled = [name for name in self.channels if name in (*NOISY_CHANNELS, *HIT_CHANNELS)]
        self.whole_frames = WholeFrames(self.signal) if self.signal else None
        self.long = [clip for clip in self.clips if clip.frames >= self.length]
        pixels = np.array([clip.frames * clip.height * clip.width for clip in self.long])
        self.probabilities = pixels / pixels.sum()
        area = self.crop * self.crop if self.crop else pixels.sum() / sum(clip.frames for clip in self.long)
        self.count = max(1, round(pixels.sum() / (self.length * area)))

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> list[Frame]:
        rng = np.random.default_rng([self.seed, self.epoch, index])
        clip = self.long[rng.choice(len(self.long), p=self.probabilities)]
        return self.sequence(clip, self.length, rng)

    def first_frames(self, index: int) -> list[Frame]:
        """The `firsts` beside item `index`."""
        rng = np.random.default_rng([self.seed, self.epoch, index, 1])
        return [self.sequence(self.clips[int(rng.integers(len(self.clips)))], 1, rng)[0] for _ in range(self.firsts)]

    def sequence(self, clip: Clip, length: int, rng: np.random.Generator) -> list[Frame]:
        """A random crop of `length` consecutive frames of a clip, augmented."""
        playback = self.augmentation.playback(clip.frames, length, rng)
        window = random_window(clip, self.crop, rng)
        stopped = len(set(playback)) < length
        draw = self.augmentation.draw(clip.realisations, length, stopped, rng)
        read = partial(read_frame, clip, window=window, in_layers=False)
        frames = []
        for time, position in enumerate(playback):
            first, *others = draw.realisations(time)
            frame = read(position, self.channels, first, playback[max(time - 1, 0)])
            if others:
                frame = averaged([frame, *(read(position, self.sampled, other) for other in others)])
            if self.whole_frames is not None:
                frame = replace(frame, whole=self.whole_frames(clip, position, [first, *others]))
            frames.append(draw.apply(frame, time))
        return frames

    def batch(self, numbers: Sequence[int]) -> Batch:
        frames = [Frame.stack(step) for step in zip(*(self[number] for number in numbers), strict=True)]
        firsts = [frame for number in numbers for frame in self.first_frames(number)]
        return Batch(frames, Frame.stack(firsts) if firsts else None)
