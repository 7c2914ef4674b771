"""Kernels of models.history.light_gain: sums over tiles, and a history multiplied by what they tell."""

from typing import TypeAlias

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import Image, Index, Indices, Plane, Row, f32
from models.compiled.jit import array, jit_in_any_order, jit_parallel
from models.compiled.lines import luminance, scale_line, triple
from models.operators import MAX_LUMINANCE

TILE = 16  # px


def between_tiles(size: int, tile: int = TILE) -> tuple[Tensor, Tensor, Tensor]:
    """For `size` pixels in a row: which tiles have centres before and after each, and its place between them."""
    place = ((torch.arange(size) + 0.5) / tile - 0.5).clamp(min=0)
    before = place.long()
    return before, (before + 1).clamp(max=(size - 1) // tile), place - before


@jit_in_any_order
def add_row(sums: Image, history: Image, noisy: Image, has_history: Row, y: Index) -> None:
    """Add a row of pixels to the sums (3, w) of its tiles."""
    width = has_history.size
    red, green, blue = triple(noisy, y, 0, width)
    past_red, past_green, past_blue = triple(history, y, 0, width)
    for tile in range(sums.shape[1]):
        past, change, square = f32(0), f32(0), f32(0)
        for x in range(tile * TILE, min((tile + 1) * TILE, width)):
            before = min(luminance(past_red[x], past_green[x], past_blue[x]), f32(MAX_LUMINANCE)) * has_history[x]
            now = min(luminance(red[x], green[x], blue[x]), f32(MAX_LUMINANCE)) * has_history[x]
            past += before
            change += now - before
            square += (now - before) * (now - before)
        sums[0, tile] += past
        sums[1, tile] += change
        sums[2, tile] += square


@jit_parallel
def sum_tiles(sums: Image, history: Image, noisy: Image, has_history: Plane) -> None:
    height = has_history.shape[0]
    for row in numba.prange(sums.shape[1]):
        tile = np.int64(row)
        for y in range(tile * TILE, min((tile + 1) * TILE, height)):
            add_row(sums[:, tile], history, noisy, has_history[y], y)


def tile_sums(history: Tensor, noisy: Tensor, has_history: Tensor) -> Tensor:
    """See models.history.light_gain.tile_sums."""
    batch, _, height, width = noisy.shape
    sums = torch.zeros(batch, 3, -(-height // TILE), -(-width // TILE))
    for item in range(batch):
        sum_tiles(sums[item].numpy(), array(history[item]), array(noisy[item]), array(has_history[item, 0]))
    return sums


Between: TypeAlias = tuple[Indices, Indices, Row]  # see between_tiles


@jit_in_any_order
def lerp_by_index(line: Row, values: Row, before: Indices, after: Indices, share: Row) -> None:
    for x in range(line.size):
        first = values[before[x]]
        line[x] = first + share[x] * (values[after[x]] - first)


@jit_in_any_order
def lerp_rows(line: Row, first: Row, last: Row, share: float) -> None:
    for x in range(line.size):
        line[x] = first[x] + share * (last[x] - first[x])


@jit_parallel
def multiply_rows(history: Image, gain: Plane, lights: int, rows: Between, columns: Between) -> None:
    """Multiply the first `lights` channels by the gain of tiles, interpolated."""
    for row in numba.prange(history.shape[1]):
        y = np.int64(row)
        tiles = np.empty(gain.shape[1], np.float32)
        line = np.empty(history.shape[2], np.float32)
        lerp_rows(tiles, gain[rows[0][y]], gain[rows[1][y]], rows[2][y])
        lerp_by_index(line, tiles, columns[0], columns[1], columns[2])
        for c in range(lights):
            scale_line(history[c, y], line)


def arrays_between(size: int) -> Between:
    before, after, share = between_tiles(size)
    return before.numpy(), after.numpy(), share.numpy()


def multiplied(history: Tensor, gain: Tensor, lights: int) -> Tensor:
    """See models.history.light_gain.multiplied: in the same memory."""
    rows, columns = map(arrays_between, history.shape[-2:])
    for item in range(len(history)):
        multiply_rows(history[item].numpy(), array(gain[item, 0]), lights, rows, columns)
    return history
