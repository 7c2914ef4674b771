"""models.operators.Reprojection for the processor: all taps of a pixel at once, rows in parallel."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.compiled import array, threads

HALF, ONE = np.float32(0.5), np.float32(1)
jit = numba.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False)


@jit
def consistent(x: int, y: int, mesh: float, point: Any, normal: Any, then: Any, axes: Any, limits: Any) -> bool:
    """Whether the tap at column x, row y of the previous frame shows the surface point."""
    if x < 0 or y < 0 or y >= then[2].shape[0] or x >= then[2].shape[1] or then[2][y, x] != mesh:
        return False
    if mesh == 0:  # background
        return True
    px, py, depth = np.float32(x) + HALF, np.float32(y) + HALF, then[0][y, x]
    off_plane, cosine = np.float32(0), np.float32(0)
    for i in range(3):
        n = then[1][i, y, x]
        seen = depth * (axes[0, i] * px + axes[1, i] * py + axes[2, i])
        off_plane += (point[i] - seen) * n
        cosine += n * normal[i]
    return abs(off_plane) <= limits[0] * depth and cosine >= limits[1]


@jit
def expected(x: int, y: int, now: Any, to_then: Any, turn: Any, rays: Any, point: Any, normal: Any) -> None:
    """Where the surface point of pixel (x, y) and its normal were: directions of the world, from the previous eye."""
    mesh, depth = min(int(now[2][y, x]), to_then.shape[0] - 1), now[0][y, x]
    ray = (
        (rays[0, 0] * (np.float32(x) + HALF) + rays[0, 1]) * depth,
        (rays[1, 0] * (np.float32(y) + HALF) + rays[1, 1]) * depth,
        depth,
    )
    for i in range(3):
        point[i] = to_then[mesh, i, 3]
        normal[i] = 0
        for j in range(3):
            point[i] += to_then[mesh, i, j] * ray[j]
            normal[i] += turn[mesh, i, j] * now[1][j, y, x]


@jit
def gather(fetched: Any, history: Any, x: int, y: int, weight: Any) -> None:
    for c in range(history.shape[0]):
        fetched[c] += weight * history[c, y, x]


@jit
def box(fetched: Any, history: Any, x: int, y: int, mesh: float, point: Any, normal: Any, then: Any, axes: Any,
        limits: Any) -> bool:  # fmt: skip
    """The mean of the consistent ones of 3 x 3 taps; whether there was one."""
    count = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if consistent(x + dx, y + dy, mesh, point, normal, then, axes, limits):
                gather(fetched, history, x + dx, y + dy, ONE)
                count += 1
    for c in range(fetched.size):
        fetched[c] /= np.float32(max(count, 1))
    return count > 0


@jit
def fetch_row(past: Any, found: Any, y: int, history: Any, motion: Any, now: Any, then: Any, to_then: Any, turn: Any,
              rays: Any, axes: Any, limits: Any) -> None:  # fmt: skip
    channels, height, width = history.shape
    point, normal = np.empty(3, np.float32), np.empty(3, np.float32)
    fetched, weights, good = np.empty(channels, np.float32), np.empty(4, np.float32), np.empty(4, np.bool_)
    for x in range(width):
        expected(x, y, now, to_then, turn, rays, point, normal)
        mesh = now[2][y, x]
        # Far outside the image an index would overflow; any place outside is as good.
        u = min(max(np.float32(x) + motion[0, y, x], np.float32(-2)), np.float32(width + 1))
        v = min(max(np.float32(y) + motion[1, y, x], np.float32(-2)), np.float32(height + 1))
        left, top = int(np.floor(u)), int(np.floor(v))
        fu, fv = u - np.float32(left), v - np.float32(top)
        weights[0], weights[1] = (ONE - fu) * (ONE - fv), fu * (ONE - fv)
        weights[2], weights[3] = (ONE - fu) * fv, fu * fv
        count, failed = 0, np.float32(0)
        for tap in range(4):
            good[tap] = consistent(left + (tap & 1), top + (tap >> 1), mesh, point, normal, then, axes, limits)
            count += good[tap]
            if not good[tap]:
                failed += weights[tap]
        fetched[:] = 0
        if count:
            failed /= np.float32(count)
            for tap in range(4):
                if good[tap]:
                    gather(fetched, history, left + (tap & 1), top + (tap >> 1), weights[tap] + failed)
            found[0, y, x] = True
        else:
            u, v = u + HALF, v + HALF
            found[0, y, x] = box(fetched, history, int(np.floor(u)), int(np.floor(v)), mesh, point, normal, then, axes,
                                 limits)  # fmt: skip
        for c in range(channels):
            past[c, y, x] = fetched[c]


@numba.njit(cache=True, parallel=True, error_model="numpy")
def fetch_image(past: Any, found: Any, history: Any, motion: Any, now: Any, then: Any, to_then: Any, turn: Any,
                rays: Any, axes: Any, limits: Any) -> None:  # fmt: skip
    for y in numba.prange(history.shape[1]):
        fetch_row(past, found, y, history, motion, now, then, to_then, turn, rays, axes, limits)


def fetch(
    history: Tensor, motion: Tensor, now: Sequence[Tensor], then: Sequence[Tensor], matrices: Sequence[NDArray[Any]]
) -> tuple[Tensor, Tensor]:
    """The history (C, H, W) of every pixel, 0 where none was found, and whether it was found (1, H, W).

    Args:
        history: (C, H, W). motion: (2, H, W). now, then: depth (H, W), normal (3, H, W), mesh id (H, W) of this frame
            and the previous one.
        matrices: to_then (M + 1, 3, 4) by mesh id, from this camera's frame to the world's axes around the previous
            eye; turn (M + 1, 3, 3), of world-space normals; rays (2, 2), slope and intercept over x and over y; axes
            (3, 3), the previous camera's rays as x axes[0] + y axes[1] + axes[2]; limits (2,), of plane and normal.
    """
    threads()
    past = torch.empty_like(history, memory_format=torch.contiguous_format)
    found = torch.empty((1, *history.shape[1:]), dtype=torch.bool)
    surfaces = (tuple(array(tensor) for tensor in buffer) for buffer in (now, then))
    small = (np.ascontiguousarray(matrix, np.float32) for matrix in matrices)
    fetch_image(past.numpy(), found.numpy(), array(history), array(motion), *surfaces, *small)
    return past, found
