"""models.layers for the CPU: rows in parallel, windows only around pixels without samples."""

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR
from models.compiled.arrays import Image, Index, Indices, Plane, f32
from models.compiled.jit import array, jit_in_order, jit_parallel, run_items

FILL_WINDOWS = ((1, True), (4, True), (13, True), (13, False))  # radius in pixels, and whether of the same mesh only


@jit_in_order
def mean_of_window(
    out: Image, weighted: Image, samples: Plane, mesh: Plane, y: Index, x: Index, radius: int, of_mesh: bool
) -> bool:
    """Set out at (y, x) to the mean over the samples in a window; whether there are any."""
    height, width = mesh.shape
    red, green, blue, count = f32(0), f32(0), f32(0), f32(0)
    for row in range(max(y - radius, 0), min(y + radius + 1, height)):
        for column in range(max(x - radius, 0), min(x + radius + 1, width)):
            if samples[row, column] > 0 and (not of_mesh or mesh[row, column] == mesh[y, x]):
                count += samples[row, column]
                red += weighted[0, row, column]
                green += weighted[1, row, column]
                blue += weighted[2, row, column]
    if count > 0:
        out[0, y, x], out[1, y, x], out[2, y, x] = red / count, green / count, blue / count
    return bool(count > 0)


@jit_parallel
def fill(out: Image, weighted: Image, samples: Plane, wanted: Plane, mesh: Plane, albedo: Image) -> None:
    """Where `wanted` > 0: the mean irradiance of samples in the pixel, or else around it, times albedo."""
    _, height, width = out.shape
    for number in numba.prange(height):
        y = np.int64(number)
        for x in range(width):
            if wanted[y, x] > 0:
                found = mean_of_window(out, weighted, samples, mesh, y, x, 0, False)
                for radius, of_mesh in FILL_WINDOWS:
                    found = found or mean_of_window(out, weighted, samples, mesh, y, x, radius, of_mesh)
                for c in range(3):
                    out[c, y, x] = out[c, y, x] * max(albedo[c, y, x], f32(ALBEDO_FLOOR)) if found else f32(0)


def light_of_samples(
    weighted: Tensor, samples: Tensor, wanted: Tensor, mesh_id: Tensor, albedo: Tensor, otherwise: Tensor
) -> Tensor:
    light = otherwise.clone(memory_format=torch.contiguous_format)
    run_items(fill, [light], [weighted, samples[:, 0], wanted[:, 0], mesh_id[:, 0], albedo])
    return light


@jit_parallel
def weigh(
    weighted: Image, samples: Plane, direct: Image, indirect: Image, second: Image, other: Plane, albedo: Image
) -> None:
    _, height, width = weighted.shape
    for y in numba.prange(height):
        for x in range(width):
            samples[y, x] = max(f32(1) - other[y, x], f32(0))
        for c in range(3):
            for x in range(width):
                light = max(direct[c, y, x] + indirect[c, y, x] - second[c, y, x], f32(0))
                weighted[c, y, x] = light / max(albedo[c, y, x], f32(ALBEDO_FLOOR))


def main_samples(
    direct: Tensor, indirect: Tensor, second: Tensor, second_samples: Tensor, albedo: Tensor
) -> tuple[Tensor, Tensor]:
    weighted = torch.empty_like(indirect, memory_format=torch.contiguous_format)
    samples = torch.empty_like(second_samples, memory_format=torch.contiguous_format)
    run_items(weigh, [weighted, samples[:, 0]], [direct, indirect, second, second_samples[:, 0], albedo])
    return weighted, samples


@jit_parallel
def pool(
    weighted: Image, samples: Plane, best: Plane, chosen: Indices, light: Image, own: Plane, share: Plane, albedo: Image
) -> None:
    """Sums over blocks of 2 x 2 pixels; `best` is the largest share in a block, `chosen` the index of its pixel."""
    height, width = share.shape
    for number in numba.prange(len(best)):
        y = np.int64(number)
        for x in range(best.shape[1]):
            best[y, x] = f32(-1)
            samples[y, x] = f32(0)
            weighted[0, y, x] = weighted[1, y, x] = weighted[2, y, x] = f32(0)
            for row in range(2 * y, min(2 * y + 2, height)):
                for column in range(2 * x, min(2 * x + 2, width)):
                    samples[y, x] += own[row, column]
                    for c in range(3):
                        weighted[c, y, x] += light[c, row, column] / max(albedo[c, row, column], f32(ALBEDO_FLOOR))
                    if share[row, column] > best[y, x]:
                        best[y, x] = share[row, column]
                        chosen[y, x] = row * width + column


def second_samples(
    second: Tensor, samples: Tensor, share: Tensor, albedo: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    batch, _, height, width = share.shape
    size = -(-height // 2), -(-width // 2)
    weighted, pooled, best = (torch.empty(batch, channels, *size) for channels in (3, 1, 1))
    chosen = torch.empty(batch, 1, *size, dtype=torch.int64)
    outputs = weighted, pooled[:, 0], best[:, 0], chosen[:, 0]
    run_items(pool, outputs, [second, samples[:, 0], share[:, 0], albedo])
    return weighted, pooled, best, chosen


@jit_parallel
def gather(out: Image, image: Image, chosen: Indices) -> None:
    """Pixels of image (C, N) at the indices `chosen` (h, w)."""
    channels, height, width = out.shape
    for y in numba.prange(height):
        for c in range(channels):
            for x in range(width):
                out[c, y, x] = image[c, chosen[y, x]]


def pixels_at(image: Tensor, chosen: Tensor) -> Tensor:
    out = torch.empty(*image.shape[:2], *chosen.shape[2:])
    for item in range(len(image)):
        gather(out[item].numpy(), array(image[item]).reshape(image.shape[1], -1), chosen[item, 0].numpy())
    return out


@jit_parallel
def add(out: Image, main: Image, irradiance: Image, share: Plane, albedo: Image, emission: Image) -> None:
    _, height, width = out.shape
    for y in numba.prange(height):
        for c in range(3):
            for x in range(width):
                light = irradiance[c, y // 2, x // 2] * max(albedo[c, y, x], f32(ALBEDO_FLOOR)) + emission[c, y, x]
                out[c, y, x] = main[c, y, x] + share[y, x] * (light - main[c, y, x])


def composed(main: Tensor, irradiance: Tensor, share: Tensor, albedo: Tensor, emission: Tensor) -> Tensor:
    out = torch.empty_like(main, memory_format=torch.contiguous_format)
    run_items(add, [out], [main, irradiance, share[:, 0], albedo, emission])
    return out
