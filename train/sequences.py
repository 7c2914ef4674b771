"""Training sequences: random crops of consecutive frames, augmented, read through memory maps."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset

from datasets.channels import HIT_CHANNELS, NOISY_CHANNELS, REFERENCE_CHANNELS
from datasets.clip import Clip, ImageWindow
from datasets.frame import Frame, read_frame
from errors import BadInput
from train.shading import WanderingEdge


@dataclass(frozen=True)
class Augmentation:
    """Which augmentations are on, those of RAE §4.3 first. Each transforms all channels and cameras consistently."""

    reverse: bool = False  # half of the sequences are played backward
    stop: bool = False  # in a quarter the camera stops at a random frame, while the noise goes on
    rotate: bool = False  # every sequence is turned by a random multiple of 90 degrees
    gain: bool = False  # every sequence has a random factor in [0, 2] for each colour channel
    exposure: bool = False  # or one for all, of 2^-1.5 to 2^1.5
    samples: bool = False  # three in ten sequences are means of 2, 4, 8, ... realisations
    light: bool = False  # over three in ten sequences the edge of a shadow or of more light wanders


def check_fits(clips: Sequence[Clip], length: int, crop: int | None) -> None:
    """Raises BadInput where a clip is shorter than `length` frames or smaller than a crop."""
    for clip in clips:
        if clip.frames < length or min(clip.height, clip.width) < (crop or 1):
            size = f" of {crop}x{crop}" if crop else ""
            raise BadInput(
                f"{clip.path} has {clip.frames} frames of {clip.width}x{clip.height}: too few or too small to train on "
                f"{length} frames{size}; train with a smaller profile"
            )


def random_window(clip: Clip, crop: int | None, rng: np.random.Generator) -> ImageWindow:
    """`crop` x `crop` pixels at a random place in the image, or all of it where `crop` is None."""
    if crop is None:
        return slice(0, clip.height), slice(0, clip.width)
    top = int(rng.integers(clip.height - crop + 1))
    left = int(rng.integers(clip.width - crop + 1))
    return slice(top, top + crop), slice(left, left + crop)


class TrainingSequences(TorchDataset[list[Frame]]):
    """Sequences of `length` frames and `crop` x `crop` pixels (None: whole frames), with the channels in `reads`.

    References are always among the channels. Item i of epoch e depends on (seed, e, i) only. The sequences of an epoch
    have together as many pixels as the clips. Raises BadInput where a clip is shorter than a sequence or smaller than a
    crop.

    `measure` tells of a clip, the number of a frame and that of its realisation what Frame.whole holds, (1, N).
    """

    def __init__(
        self,
        clips: Sequence[Clip],
        reads: Sequence[str],
        length: int,
        crop: int | None,
        augmentation: Augmentation,
        seed: int,
        measure: Callable[[Clip, int, int], Tensor] | None = None,
    ):
        check_fits(clips, length, crop)
        self.clips = clips
        self.channels = tuple(dict.fromkeys([*reads, *REFERENCE_CHANNELS]))
        self.length = length
        self.crop = crop
        self.augmentation = augmentation
        self.seed = seed
        self.measure = measure
        self.epoch = 0
        pixels = np.array([clip.frames * clip.height * clip.width for clip in clips])
        self.probabilities = pixels / pixels.sum()
        area = crop * crop if crop else pixels.sum() / sum(clip.frames for clip in clips)
        self.count = max(1, round(pixels.sum() / (length * area)))

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch whose sequences come next."""
        self.epoch = epoch

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> list[Frame]:
        rng = np.random.default_rng([self.seed, self.epoch, index])
        clip = self.clips[rng.choice(len(self.clips), p=self.probabilities)]
        playback = self._playback(clip, rng)
        window = random_window(clip, self.crop, rng)
        # Dealt out rather than drawn, so that a stopped camera sees new noise while there are unused realisations.
        deal = rng.permutation(clip.realisations)
        turns = int(rng.integers(4)) if self.augmentation.rotate else 0
        gain = torch.from_numpy(rng.uniform(0, 2, (1, 3, 1, 1)).astype(np.float32)) if self.augmentation.gain else None
        if self.augmentation.exposure:
            gain = torch.full((1, 3, 1, 1), 2 ** float(rng.uniform(-1.5, 1.5)))

        stopped = len(set(playback)) < self.length
        together = self._realisations_together(len(deal), rng) if self.augmentation.samples and not stopped else 1

        edge = WanderingEdge.random(rng, self.length) if self.augmentation.light and rng.random() < 0.3 else None

        brighter = 0.0  # the logarithm of how much light a change adds
        frames = []
        for t, position in enumerate(playback):
            chosen = [int(deal[(together * t + i) % len(deal)]) for i in range(together)]
            realisation = chosen[0]
            previous = playback[max(t - 1, 0)]
            frame = read_frame(clip, position, self.channels, realisation, previous, window)
            if together > 1:
                sampled = [name for name in self.channels if name in (*NOISY_CHANNELS, *HIT_CHANNELS)]
                frame = frame.with_more_samples(
                    [read_frame(clip, position, sampled, i, window=window) for i in chosen[1:]]
                )
            if edge is not None:
                light = edge.light(t, *frame.size)
                brighter = float(torch.log(light).mean())
                frame = frame.lit(light)
            for _ in range(turns):
                frame = frame.rot90()
            if gain is not None:
                frame = replace(frame, gain=gain)
            if self.measure is not None:
                frame = replace(frame, whole=self.measure(clip, position, realisation) + torch.tensor([brighter, 0.0]))
            frames.append(frame)
        return frames

    @staticmethod
    def _realisations_together(count: int, rng: np.random.Generator) -> int:
        """1 in seven of ten cases, else 2, 4, 8, ... of `count`."""
        most = int(np.log2(count))
        return 2 ** int(rng.integers(1, most + 1)) if most and rng.random() >= 0.7 else 1

    def _playback(self, clip: Clip, rng: np.random.Generator) -> list[int]:
        """Frame numbers in the order in which they are played."""
        start = int(rng.integers(clip.frames - self.length + 1))
        positions = np.arange(start, start + self.length)
        if self.augmentation.reverse and rng.random() < 0.5:
            positions = positions[::-1]
        if self.augmentation.stop and rng.random() < 0.25:
            positions = positions[np.minimum(np.arange(self.length), rng.integers(self.length))]
        return [int(position) for position in positions]


class Batch:
    """What a training step sees: for each time step, one Frame of all sequences.

    It is not a list, because Fabric converts the tensors in collections, and cameras must stay float64.
    """

    def __init__(self, frames: list[Frame]):
        self.frames = frames

    def to(self, device: torch.device | str) -> "Batch":
        """The batch with all tensors on `device`."""
        return Batch([frame.to(device) for frame in self.frames])


def collate(sequences: list[list[Frame]]) -> Batch:
    """One batch of several sequences of equal length."""
    return Batch([Frame.stack(step) for step in zip(*sequences, strict=True)])
