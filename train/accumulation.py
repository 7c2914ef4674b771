"""Accumulated frames on disk: what WSKP learns from (§5.1) is computed once per clip."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import torch

from datasets.clip import Clip
from datasets.frame import read_frame
from provenance import code_digest, versions
from train.protocols import AccumulatingState, FilteringNetwork

ACCUMULATION_PACKAGES = ("torch", "numpy", "numba")  # that accumulation computes with
IRRADIANCE_FILE = "irradiance.npy"
SCALE_FILE = "scale.npy"


def accumulation_digest(network: FilteringNetwork) -> str:
    """16 hexadecimal digits that identify the code and the packages that accumulate for a network."""
    module = type(network).accumulate.__module__
    everything = [code_digest("train.accumulation", module), versions(ACCUMULATION_PACKAGES)]
    return hashlib.sha256(json.dumps(everything).encode()).hexdigest()[:16]


@torch.no_grad()
def accumulate_clip(clip: Clip, network: FilteringNetwork, cache: Path) -> Path:
    """Accumulate all realisations of a clip, unless `cache` has the result already. Returns its folder.

    It contains irradiance.npy (F, S, H, W, 3) and scale.npy (F, S, 2), logarithms of luminance and depth; float32. Its
    name identifies the clip and the code; what other code has made of the same clip is deleted.
    """
    folder = cache / f"{clip.fingerprint}-{accumulation_digest(network)}"
    if folder.exists():
        return folder
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    temporary.mkdir(parents=True, exist_ok=True)
    try:
        write_accumulated(clip, network, temporary)
        if not folder.exists():  # unless another process was faster
            temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    for other in cache.glob(f"{clip.fingerprint}*"):
        if other != folder:
            shutil.rmtree(other, ignore_errors=True)  # processes that have it open can still read it
    return folder


def write_accumulated(clip: Clip, network: FilteringNetwork, folder: Path) -> None:
    shape = (clip.frames, clip.realisations, clip.height, clip.width, 3)
    scale = np.zeros((*shape[:2], 2), np.float32)
    states: list[AccumulatingState | None] = [None] * clip.realisations
    # Written, not mapped: on a full disk a map ends the process, and a write raises an error.
    with (folder / IRRADIANCE_FILE).open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        for index, realisation in np.ndindex(shape[:2]):
            frame = read_frame(clip, index, network.reads, realisation, in_layers=False)
            after = network.accumulate(frame, states[realisation])
            states[realisation] = after
            file.write(after.history.irradiance[0].permute(1, 2, 0).numpy().tobytes())
            scale[index, realisation] = [mean.value.item() for mean in vars(after.scale).values()]
    np.save(folder / SCALE_FILE, scale)
