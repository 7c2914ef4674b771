"""models.neighbours for the processor: rows in parallel, every loop along them vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.jit import array, jit_in_any_order, jit_parallel
from models.compiled.lines import add_product

ONE = np.float32(1)
ZERO = np.float32(0)


@jit_in_any_order
def compare(same: Any, mesh: Any, other: Any) -> None:
    for x in range(same.size):
        same[x] = ONE if mesh[x] == other[x] else ZERO


@jit_parallel
def sum_image(sums: Any, image: Any, mesh: Any, step: int) -> None:
    """sums (C, H, W) from image (C, H, W) and mesh (H, W)."""
    height, width = mesh.shape
    for row in numba.prange(height):
        y = np.int64(row)
        same = np.empty(width, np.float32)
        sums[:, y] = ZERO
        for tap in range(9):
            to = y + (tap // 3 - 1) * step
            dx = (tap % 3 - 1) * step
            low = max(0, -dx)
            high = min(width, width - dx)
            if to < 0 or to >= height or low >= high:
                continue
            compare(same[low:high], mesh[y, low:high], mesh[to, low + dx : high + dx])
            for c in range(image.shape[0]):
                add_product(sums[c, y, low:high], same[low:high], image[c, to, low + dx : high + dx])


def mesh_sums(image: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    """See models.neighbours.mesh_sums."""
    sums = torch.empty_like(image, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        sum_image(sums[item].numpy(), array(image[item]), array(mesh_id[item, 0]), step)
    return sums
