"""Training crops of accumulated frames, memory-mapped."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset
from tqdm import tqdm

from datasets.channels import REFERENCE_CHANNELS
from datasets.clip import Clip
from datasets.frame import Frame, read_frame, to_tensor
from models.history.running_scale import RunningMean, RunningScale
from train.accumulation import IRRADIANCE_FILE, SCALE_FILE, accumulate_clip
from train.protocols import A, FilteringNetwork
from train.sequences import check_fits, random_window


class Crops:
    """A batch of crops: frames, their accumulated irradiance (B, 3, h, w), and the running scales there.

    Not a dataclass, whose fields Fabric would convert.
    """

    def __init__(self, frame: Frame, irradiance: Tensor, scale: RunningScale):
        self.frame = frame
        self.irradiance = irradiance
        self.scale = scale

    def to(self, device: torch.device | str) -> "Crops":
        means = (RunningMean(m.value.to(device), m.count.to(device)) for m in vars(self.scale).values())
        return Crops(self.frame.to(device), self.irradiance.to(device), RunningScale(*means))

    @staticmethod
    def stack(crops: "Sequence[Crops]") -> "Crops":
        """One batch of all crops' batches."""
        scales = [list(vars(crop.scale).values()) for crop in crops]
        means = (
            RunningMean(torch.cat([m.value for m in means]), torch.cat([m.count for m in means]))
            for means in zip(*scales, strict=True)
        )
        irradiance = torch.cat([crop.irradiance for crop in crops])
        return Crops(Frame.stack([crop.frame for crop in crops]), irradiance, RunningScale(*means))


class AccumulatedCrops(TorchDataset[Crops]):
    """Crops of `crop` x `crop` pixels (None: whole frames); item i of epoch e depends on (seed, e, i) only.

    An epoch holds `count` crops for every frame of the clips, at random places. Accumulated frames are kept in the
    folder `cache`. Raises BadInput where a clip is smaller than a crop.
    """

    def __init__(
        self, clips: Sequence[Clip], network: FilteringNetwork[A], count: int, crop: int | None, seed: int, cache: Path
    ):
        check_fits(clips, 1, crop)
        cache.mkdir(parents=True, exist_ok=True)
        folders = [accumulate_clip(clip, network, cache) for clip in tqdm(clips, "accumulating", leave=False)]
        self.irradiance: list[NDArray[np.float32]] = [np.load(f / IRRADIANCE_FILE, mmap_mode="r") for f in folders]
        self.scales: list[NDArray[np.float32]] = [np.load(folder / SCALE_FILE) for folder in folders]
        self.clips = clips
        self.crop = crop
        self.seed = seed
        self.epoch = 0
        self.channels = (*network.filter_reads, *REFERENCE_CHANNELS)
        frames = np.array([clip.frames for clip in clips])
        self.share = frames / frames.sum()
        self.count = int(count * frames.sum())

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch whose crops come next."""
        self.epoch = epoch

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
        scales = torch.from_numpy(self.scales[item][position, realisation])
        means = (RunningMean(value[None], torch.ones(1)) for value in scales)
        return Crops(read_frame(clip, position, self.channels, window=window), irradiance, RunningScale(*means))
