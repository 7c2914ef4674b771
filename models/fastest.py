"""Which floating-point precision this processor convolves fastest in: measured, for its instructions do not tell."""

import time
from functools import cache

import torch
from torch.nn import functional as F

from timing import take_turns, thread_count

WORTHWHILE = 1.1  # bfloat16 must be this many times faster to be used
TURNS = 7


@cache
def bfloat16_pays() -> bool:
    """Whether this processor convolves images faster in bfloat16 than in float32; measured once a process, in 50 ms.

    Some processors take longer by AVX-512-BF16 instructions, where they have no matrix units, and some half as long.
    Counted is the time that one thread computes, so that it does not matter what else the machine has to do.
    """
    if not (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()):
        return False
    image = torch.ones(1, 32, 96, 96).contiguous(memory_format=torch.channels_last)
    weight = torch.ones(32, 32, 3, 3).contiguous(memory_format=torch.channels_last)
    inputs = {dtype: (image.to(dtype), weight.to(dtype)) for dtype in (torch.float32, torch.bfloat16)}

    @torch.no_grad()
    def convolve(dtype: torch.dtype) -> None:
        F.conv2d(*inputs[dtype], padding=1)

    work = {str(dtype): lambda dtype=dtype: convolve(dtype) for dtype in inputs}
    with thread_count(1):
        seconds = take_turns(work, TURNS, clock=time.thread_time)
    return min(seconds[str(torch.float32)]) > WORTHWHILE * min(seconds[str(torch.bfloat16)])
