"""The precision in which this machine convolves fastest: measured, since its instruction sets do not determine it."""

import os
import time
from contextlib import suppress
from functools import cache, partial

import torch
from torch.nn import functional as F

from errors import BadInput
from files import cache_folder, read_json, write_json
from provenance import processor_name
from timing import take_turns, thread_count

MIN_SPEEDUP = 1.1  # of bfloat16 over float32, to be used
TURNS = 7


@cache
def bfloat16_is_faster() -> bool:
    """Whether this machine convolves images faster in bfloat16 than in float32; measured once a machine, in 50 ms.

    Some processors take longer by AVX-512-BF16 instructions, where they have no matrix units, and some half as long.
    The result is kept in the user's cache folder, by processor, instruction set and version of PyTorch.
    """
    if not (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()):
        return False
    path = cache_folder() / "bfloat16.json"
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "all instructions")
    machine = f"{processor_name()}, {limit}, torch {torch.__version__}"
    speedups: dict[str, float] = {}
    with suppress(BadInput):  # missing or damaged: measured again
        speedups = read_json(path)
    if machine not in speedups:
        speedups[machine] = bfloat16_speedup()
        with suppress(OSError):  # a folder that cannot be written costs the next process 50 ms
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, speedups)
    return speedups[machine] > MIN_SPEEDUP


def bfloat16_speedup() -> float:
    """How many times faster this processor convolves in bfloat16, by the time that one thread computes, busy or not."""
    work = {}
    for dtype in (torch.float32, torch.bfloat16):
        image, weight = (torch.ones(shape, dtype=dtype) for shape in ((1, 32, 96, 96), (32, 32, 3, 3)))
        image, weight = (each.contiguous(memory_format=torch.channels_last) for each in (image, weight))
        work[str(dtype)] = partial(F.conv2d, image, weight, padding=1)
    with thread_count(1), torch.no_grad():
        seconds = take_turns(work, TURNS, clock=time.thread_time, label=None)
    return min(seconds[str(torch.float32)]) / min(seconds[str(torch.bfloat16)])
