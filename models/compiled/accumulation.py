"""models.history.accumulation for the CPU: history is validated, gathered and blended row by row, in one pass."""

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from models.compiled.arrays import Image, Plane, Row, f32
from models.compiled.jit import array, jit_parallel, jit_with_reciprocals
from models.compiled.lines import block_count, rows_of_block
from models.compiled.reprojection import FramePair, find_taps, gather, new_taps
from models.history.geometry import GBuffer

MIN_ALPHA = 0.2  # SVGF §4.1: weight of the newest frame in a long history


@jit_with_reciprocals
def weigh(alpha: Row, length: Row, past_length: Row, change: Row, valid: Row) -> None:
    """The weight of the newest frame and the new history length, (W), where `change` of the history is dropped."""
    for x in range(alpha.size):
        kept = f32(1) - change[x]
        newest = kept * max(f32(MIN_ALPHA), f32(1) / (past_length[x] + f32(1))) + change[x]
        alpha[x] = newest if valid[x] > 0 else f32(1)
        length[x] = past_length[x] * kept + f32(1) if valid[x] > 0 else f32(1)


@jit_with_reciprocals
def blend(line: Row, past: Row, alpha: Row, noisy: Row) -> None:
    """line (W): from `past` by alpha of the way to `noisy`; from whichever end is nearer, where it is exact."""
    for x in range(line.size):
        step = noisy[x] - past[x]
        line[x] = past[x] + alpha[x] * step if alpha[x] < f32(0.5) else noisy[x] - (f32(1) - alpha[x]) * step


@jit_parallel
def accumulate_image(
    irradiance: Image, length: Plane, noisy: Image, past_irradiance: Image, past_length: Plane, pair: FramePair
) -> None:
    _, height, width = noisy.shape
    for block in numba.prange(block_count(height)):
        taps = new_taps(width)
        gathered = np.empty(width, np.float32)
        alpha = np.empty(width, np.float32)
        none = np.zeros(width, np.float32)
        for y in rows_of_block(block, height):
            find_taps(taps, y, pair)
            gather(gathered, past_length, y, taps)
            weigh(alpha, length[y], gathered, none, taps.valid)
            for c in range(3):
                gather(gathered, past_irradiance[c], y, taps)
                blend(irradiance[c, y], gathered, alpha, noisy[c, y])


def accumulate_samples(
    frame: Frame, noisy: Tensor, past_irradiance: Tensor, past_length: Tensor, gbuffer: GBuffer
) -> tuple[Tensor, Tensor]:
    irradiance = torch.empty_like(noisy, memory_format=torch.contiguous_format)
    length = torch.empty_like(past_length, memory_format=torch.contiguous_format)
    for item in range(len(noisy)):
        inputs = array(noisy[item]), array(past_irradiance[item]), array(past_length[item, 0])
        pair = FramePair.of(frame, gbuffer, item)
        accumulate_image(irradiance[item].numpy(), length[item, 0].numpy(), *inputs, pair)
    return irradiance, length
