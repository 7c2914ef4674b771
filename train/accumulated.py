"""Training crops of accumulated frames: what WSKP learns from (§5.1). Accumulated once a clip, then memory-mapped."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset as TorchDataset
from tqdm import tqdm

from datasets.channels import REFERENCES
from datasets.clip import Clip
from datasets.frame import Frame, read_frame, to_tensor
from datasets.sequences import check_fits, random_window
from models.denoiser import State
from models.running_scale import RunningMean, RunningScale
from models.wskp import KernelPredictor

IRRADIANCE, SCALE = "irradiance.npy", "scale.npy"


class Crops:
    """What a training step sees: frames, their accumulated irradiance (B, 3, h, w), and the running scales there.

    Not a dataclass: Fabric takes those apart.
    """

    def __init__(self, frame: Frame, irradiance: Tensor, scale: RunningScale):
        self.frame, self.irradiance, self.scale = frame, irradiance, scale

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


@torch.no_grad()
def accumulate_clip(clip: Clip, denoiser: KernelPredictor, cache: Path) -> Path:
    """Accumulate all realisations of a clip, unless `cache` holds that already. Returns the folder with the result.

    It holds irradiance.npy (F, S, H, W, 3) and scale.npy (F, S, 2), logarithms of luminance and depth; float32.
    """
    folder = cache / clip.fingerprint
    if folder.exists():
        return folder
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    temporary.mkdir(parents=True, exist_ok=True)
    try:
        shape = (clip.frames, clip.realisations, clip.height, clip.width, 3)
        scale = np.zeros((*shape[:2], 2), np.float32)
        states: list[State | None] = [None] * clip.realisations
        # Written, not mapped: on a full disk a map ends the process, and a write says why.
        with (temporary / IRRADIANCE).open("wb") as file:
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, header)
            for index, realisation in np.ndindex(shape[:2]):
                frame = read_frame(clip, index, denoiser.reads, realisation)
                states[realisation] = after = denoiser.accumulate(frame, states[realisation])
                file.write(after.history.irradiance[0].permute(1, 2, 0).numpy().tobytes())
                scale[index, realisation] = [mean.value.item() for mean in vars(after.scale).values()]
        np.save(temporary / SCALE, scale)
        if not folder.exists():  # another process may have been as busy
            temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return folder


class AccumulatedCrops(TorchDataset[Crops]):
    """Crops of `crop` x `crop` pixels (None: whole frames); item i of epoch e depends on (seed, e, i) only.

    An epoch holds `count` crops for every frame of the clips, at random places. Raises BadInput where a clip is
    smaller than a crop.
    """

    def __init__(
        self, clips: Sequence[Clip], denoiser: KernelPredictor, count: int, crop: int | None, seed: int, cache: Path
    ):
        check_fits(clips, 1, crop)
        cache.mkdir(parents=True, exist_ok=True)
        folders = [accumulate_clip(clip, denoiser, cache) for clip in tqdm(clips, "accumulating", leave=False)]
        self.accumulated: list[NDArray[np.float32]] = [np.load(f / IRRADIANCE, mmap_mode="r") for f in folders]
        self.scales: list[NDArray[np.float32]] = [np.load(folder / SCALE) for folder in folders]
        self.clips, self.crop, self.seed, self.epoch = clips, crop, seed, 0
        self.channels = (*denoiser.filter_reads, *REFERENCES)
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
        position, realisation = int(rng.integers(clip.frames)), int(rng.integers(clip.realisations))
        window = random_window(clip, self.crop, rng)
        irradiance = to_tensor(self.accumulated[item][position, realisation][window])
        scales = torch.from_numpy(self.scales[item][position, realisation])
        means = (RunningMean(value[None], torch.ones(1)) for value in scales)
        return Crops(read_frame(clip, position, self.channels, window=window), irradiance, RunningScale(*means))
