"""models.networks.fusion for CUDA devices, with Triton (part of PyTorch's CUDA builds): one kernel for all windows."""

from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from models.compiled.fusion import OUTSIDE_LOGIT

TRITON_OUTSIDE_LOGIT = tl.constexpr(OUTSIDE_LOGIT)
PROGRAM_WIDTH = 128  # pixels of a row that one program filters


@triton.jit  # type: ignore[untyped-decorator]
def fuse_rows(
    fused: Any,
    image: Any,
    importance: Any,
    mixture: Any,
    surface: Any,
    radii: Any,
    height: Any,
    width: Any,
    COUNT: tl.constexpr,
    MASKED: tl.constexpr,
    BLOCK: tl.constexpr,
) -> None:
    """Every window relative to its largest logit: one way over its taps for that, one for the sums."""
    x = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    y = tl.program_id(1)
    item = tl.program_id(2).to(tl.int64)
    plane = height * width
    within = x < width
    at = y * width + x
    image += item * 3 * plane
    fused += item * 3 * plane
    importance += item * COUNT * plane
    mixture += item * COUNT * plane
    surface += item * plane
    top = tl.full((BLOCK,), -float("inf"), tl.float32)
    for i in range(COUNT):
        top = tl.maximum(top, tl.load(mixture + i * plane + at, within, 0))
    total = tl.zeros((BLOCK,), tl.float32)
    red = total
    green = total
    blue = total
    for i in range(COUNT):
        logits = importance + i * plane
        radius = tl.load(radii + i)
        largest = tl.full((BLOCK,), TRITON_OUTSIDE_LOGIT, tl.float32)
        for v in range(tl.maximum(y - radius, 0), tl.minimum(y + radius + 1, height)):
            for dx in range(-radius, radius + 1):
                inside = (x + dx >= 0) & (x + dx < width)
                if MASKED:
                    inside &= tl.load(surface + v * width + x + dx, inside, 0) > 0
                largest = tl.maximum(largest, tl.load(logits + v * width + x + dx, inside, -float("inf")))
        weight = tl.zeros((BLOCK,), tl.float32)
        r = weight
        g = weight
        b = weight
        for v in range(tl.maximum(y - radius, 0), tl.minimum(y + radius + 1, height)):
            for dx in range(-radius, radius + 1):
                inside = (x + dx >= 0) & (x + dx < width)
                tap = v * width + x + dx
                if MASKED:
                    inside &= tl.load(surface + tap, inside, 0) > 0
                e = tl.exp(tl.load(logits + tap, inside, -float("inf")) - largest)
                weight += e
                r += e * tl.load(image + tap, inside, 0)
                g += e * tl.load(image + plane + tap, inside, 0)
                b += e * tl.load(image + 2 * plane + tap, inside, 0)
        share = tl.exp(tl.load(mixture + i * plane + at, within, 0) - top)
        total += share
        weight = tl.maximum(weight, 1)  # of the largest logit alone, or of none
        red += share * r / weight
        green += share * g / weight
        blue += share * b / weight
    tl.store(fused + at, red / total, within)
    tl.store(fused + plane + at, green / total, within)
    tl.store(fused + 2 * plane + at, blue / total, within)


def fuse(
    image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int], surface: Tensor | None = None
) -> Tensor:
    batch, _, height, width = image.shape
    fused = torch.empty_like(image, memory_format=torch.contiguous_format)
    radii = torch.tensor([window // 2 for window in windows], dtype=torch.int32, device=image.device)
    given = (image, importance, mixture, image if surface is None else surface)
    tensors = (tensor.float().contiguous() for tensor in given)
    grid = (triton.cdiv(width, PROGRAM_WIDTH), height, batch)
    with torch.cuda.device(image.device) if image.is_cuda else nullcontext():
        fuse_rows[grid](fused, *tensors, radii, height, width, len(windows), surface is not None, PROGRAM_WIDTH)
    return fused
