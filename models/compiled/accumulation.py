"""models.history.accumulation for the processor: history is found, fetched and blended row by row, in one pass."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from models.compiled.jit import array, jit_parallel, jit_with_reciprocals
from models.compiled.reprojection import (
    BLOCK_ROWS,
    HALF,
    ONE,
    Buffers,
    Past,
    Views,
    fetch,
    find_row,
    new_search,
)
from models.history.geometry import GBuffer

MIN_ALPHA = 0.2  # SVGF §4.1: weight of the newest frame in a long history


@jit_with_reciprocals
def weigh(alpha: Any, length: Any, past_length: Any, found: Any) -> None:
    """The weight of the newest frame and the new history length, (W), from those fetched and whether any was."""
    for x in range(alpha.size):
        longer = past_length[x] + ONE
        alpha[x] = max(ONE / longer, np.float32(MIN_ALPHA)) if found[x] > 0 else ONE
        length[x] = longer if found[x] > 0 else ONE


@jit_with_reciprocals
def blend(line: Any, past: Any, alpha: Any, noisy: Any) -> None:
    """line (W): from `past` by alpha of the way to `noisy`; from whichever end is nearer, where it is exact."""
    for x in range(line.size):
        step = noisy[x] - past[x]
        line[x] = past[x] + alpha[x] * step if alpha[x] < HALF else noisy[x] - (ONE - alpha[x]) * step


@jit_parallel
def accumulate_image(
    irradiance: Any,
    length: Any,
    noisy: Any,
    past_irradiance: Any,
    past_length: Any,
    motion: Any,
    now: Buffers,
    then: Buffers,
    views: Views,
) -> None:
    """irradiance (3, H, W) and length (H, W) from the `noisy` ones and the history."""
    _, height, width = noisy.shape
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        search = new_search(width)
        fetched = np.empty(width, np.float32)
        alpha = np.empty(width, np.float32)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            find_row(search, y, Past(motion, now, then, views))
            fetch(fetched, past_length, y, search)
            weigh(alpha, length[y], fetched, search.found)
            for c in range(3):
                fetch(fetched, past_irradiance[c], y, search)
                blend(irradiance[c, y], fetched, alpha, noisy[c, y])


def accumulate_samples(
    frame: Frame, noisy: Tensor, past_irradiance: Tensor, past_length: Tensor, gbuffer: GBuffer
) -> tuple[Tensor, Tensor]:
    """See models.history.accumulation.accumulate_samples."""
    irradiance = torch.empty_like(noisy, memory_format=torch.contiguous_format)
    length = torch.empty_like(past_length, memory_format=torch.contiguous_format)
    for item in range(len(noisy)):
        accumulate_image(
            irradiance[item].numpy(),
            length[item, 0].numpy(),
            array(noisy[item]),
            array(past_irradiance[item]),
            array(past_length[item, 0]),
            *Past.of(frame, gbuffer, item),
        )
    return irradiance, length
