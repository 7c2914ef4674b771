"""Compile all of Numba's kernels, which are then on disk: `python -m tests.helpers.kernels`."""

import os
from pathlib import Path

import torch

from eval.bench.synthetic_frames import synthetic_frame
from models.registry import create

COMPILED = ("wskp3", "svgf", "eaw", "kp")  # each with kernels of its own; all but kp reproject


def are_on_disk() -> bool:
    """Whether any kernels of this code are there; `models.compiled` has chosen the place."""
    return Path(os.environ["NUMBA_CACHE_DIR"]).exists()


@torch.inference_mode()
def compile_all() -> None:
    torch.set_num_threads(1)
    for name in COMPILED:
        denoiser = create(name)
        denoiser.prepare()
        state = None
        for index in range(2):
            _, state = denoiser(synthetic_frame(index, 16, 16), state)


if __name__ == "__main__":
    compile_all()
