"""Training crops of accumulated frames, memory-mapped."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from datasets.channels import REFERENCE_CHANNELS
from datasets.clip import Clip
from datasets.frame import Frame, read_frame, to_tensor
from models.history.running_scale import RunningMean, RunningScale
from train.accumulation import IRRADIANCE_FILE, SCALE_FILE, accumulate_clip
from train.protocols import FilteringNetwork
from train.sequences import Batch, check_fits, random_window


class Crops:
    """A batch of crops. It is not a dataclass, because Fabric converts the fields of those."""

    def __init__(self, frame: Frame, irradiance: Tensor, log_scale: Tensor):
        self.frame = frame
        self.irradiance = irradiance  # accumulated, (B, 3, h, w)
        self.log_scale = log_scale  # logarithms of luminance and depth, (B, 2), of the sequences of the crops

    @property
    def scale(self) -> RunningScale:
        return RunningScale(*(RunningMean(value, torch.ones_like(value)) for value in self.log_scale.unbind(dim=1)))

    def to(self, device: torch.device | str) -> "Crops":
        return Crops(self.frame.to(device), self.irradiance.to(device), self.log_scale.to(device))


AnyBatch = Batch | Crops


class AccumulatedCrops:
    """Crops of `crop` x `crop` pixels (None: whole frames); item i of epoch e depends on (seed, e, i) only.

    An epoch has `count` crops for every frame of the clips, at random places. Accumulated frames are kept in the
    folder `cache`. Raises BadInput where a clip is smaller than a crop.
    """

    def __init__(
        self, clips: Sequence[Clip], network: FilteringNetwork, count: int, crop: int | None, seed: int, cache: Path
    ):
        check_fits(clips, 1, crop)
        cache.mkdir(parents=True, exist_ok=True)
        folders = [accumulate_clip(clip, network, cache) for clip in tqdm(clips, "accumulating", leave=False)]
        self.irradiance: list[NDArray[np.float32]] = [np.load(f / IRRADIANCE_FILE, mmap_mode="r") for f in folders]
        self.scales: list[NDArray[np.float32]] = [np.load(folder / SCALE_FILE) for folder in folders]
        self.clips = clips
        self.crop = crop
        self.seed = seed
        self.epoch = 0  # that whose crops come next
        self.channels = (*network.filter_reads, *REFERENCE_CHANNELS)
        frames = np.array([clip.frames for clip in clips])
        self.share = frames / frames.sum()
        self.count = int(count * frames.sum())

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Crops:
        rng = np.random.default_rng([self.seed, self.epoch, index])
        item = rng.choice(len(self.clips), p=self.share)
        clip = self.clips[item]
        position = int(rng.integers(clip.frames))
        realisation = int(rng.integers(clip.realisations))
        window = random_window(clip, self.crop, rng)
        irradiance = to_tensor(self.irradiance[item][position, realisation][window])
        log_scale = torch.from_numpy(self.scales[item][position, realisation])[None]
        frame = read_frame(clip, position, self.channels, realisation, window=window, in_layers=False)
        return Crops(frame, irradiance, log_scale)

    def batch(self, numbers: Sequence[int]) -> Crops:
        crops = [self[number] for number in numbers]
        irradiance = torch.cat([crop.irradiance for crop in crops])
        log_scale = torch.cat([crop.log_scale for crop in crops])
        return Crops(Frame.stack([crop.frame for crop in crops]), irradiance, log_scale)
