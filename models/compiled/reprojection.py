"""models.reprojection for the processor: all taps of a pixel at once, rows in parallel.

Points and directions are in the world's axes around the previous eye, so that they keep their precision wherever in the
world that is.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.frame import Frame
from models import parameters
from models.compiled.jit import array, jit_parallel, jit_with_reciprocals
from models.surfaces import BACKGROUND_ID, Surfaces, to_previous_camera

HALF = np.float32(0.5)
ONE = np.float32(1)
PLANE_TOLERANCE = np.float32(parameters.PLANE_TOLERANCE)
NORMAL_TOLERANCE = np.float32(parameters.NORMAL_TOLERANCE)


class Buffers(NamedTuple):
    """What one item of Surfaces holds."""

    depth: NDArray[np.float32]  # (H, W)
    normal: NDArray[np.float32]  # (3, H, W)
    mesh_id: NDArray[np.float32]  # (H, W)

    @staticmethod
    def of(surfaces: Surfaces, item: int) -> "Buffers":
        return Buffers(array(surfaces.depth[item, 0]), array(surfaces.normal[item]), array(surfaces.mesh_id[item, 0]))


class Views(NamedTuple):
    """Both cameras of a frame, as matrices."""

    to_then: NDArray[np.float32]  # (M + 1, 3, 4), by mesh id: from this camera's frame to where the mesh was
    turn: NDArray[np.float32]  # (M + 1, 3, 3), by mesh id: of world-space normals
    slopes: NDArray[np.float32]  # (2, 2), of this camera's rays: slope and intercept over x and over y
    axes: NDArray[np.float32]  # (3, 3), the previous camera's rays are x axes[0] + y axes[1] + axes[2]

    @staticmethod
    def of(frame: Frame, item: int) -> "Views":
        now = frame.now
        previous = frame.previous
        K = now.K[item]
        to_world = now.camera_to_world[item, :3, :3]
        then_to_world = previous.camera_to_world[item, :3, :3]
        to_then = then_to_world @ to_previous_camera(now, previous, item)[:, :3]
        turn = to_then[..., :3] @ to_world.T
        slopes = torch.stack([1 / K.diagonal()[:2], -K[:2, 2] / K.diagonal()[:2]], dim=1)
        axes = then_to_world @ torch.linalg.inv(previous.K[item])
        return Views(*(array(matrix) for matrix in (to_then, turn, slopes, axes.T)))


@jit_with_reciprocals
def is_consistent(x: int, y: int, mesh: float, point: Any, normal: Any, then: Buffers, views: Views) -> Any:
    """Whether the tap at column x, row y of the previous frame shows the surface point."""
    height, width = then.mesh_id.shape
    if x < 0 or y < 0 or y >= height or x >= width or then.mesh_id[y, x] != mesh:
        return False
    if mesh == BACKGROUND_ID:
        return True
    px = np.float32(x) + HALF
    py = np.float32(y) + HALF
    depth = then.depth[y, x]
    off_plane = np.float32(0)
    cosine = np.float32(0)
    for i in range(3):
        n = then.normal[i, y, x]
        seen = depth * (views.axes[0, i] * px + views.axes[1, i] * py + views.axes[2, i])
        off_plane += (point[i] - seen) * n
        cosine += n * normal[i]
    return abs(off_plane) <= PLANE_TOLERANCE * depth and cosine >= NORMAL_TOLERANCE


@jit_with_reciprocals
def expect(x: int, y: int, now: Buffers, views: Views, point: Any, normal: Any) -> None:
    """point (3), normal (3): where the surface point of pixel (x, y) was, and its normal."""
    mesh = min(int(now.mesh_id[y, x]), views.to_then.shape[0] - 1)
    depth = now.depth[y, x]
    ray = (
        (views.slopes[0, 0] * (np.float32(x) + HALF) + views.slopes[0, 1]) * depth,
        (views.slopes[1, 0] * (np.float32(y) + HALF) + views.slopes[1, 1]) * depth,
        depth,
    )
    for i in range(3):
        point[i] = views.to_then[mesh, i, 3]
        normal[i] = 0
        for j in range(3):
            point[i] += views.to_then[mesh, i, j] * ray[j]
            normal[i] += views.turn[mesh, i, j] * now.normal[j, y, x]


@jit_with_reciprocals
def add_pixel(fetched: Any, history: Any, x: int, y: int, weight: Any) -> None:
    for c in range(history.shape[0]):
        fetched[c] += weight * history[c, y, x]


@jit_with_reciprocals
def fetch_box(
    fetched: Any, history: Any, x: int, y: int, mesh: float, point: Any, normal: Any, then: Buffers, views: Views
) -> bool:
    """The mean of the consistent ones of 3 x 3 taps; whether there was one."""
    count = 0
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            if is_consistent(x + dx, y + dy, mesh, point, normal, then, views):
                add_pixel(fetched, history, x + dx, y + dy, ONE)
                count += 1
    for c in range(fetched.size):
        fetched[c] /= np.float32(max(count, 1))
    return count > 0


@jit_with_reciprocals
def fetch_row(
    past: Any, found: Any, y: int, history: Any, motion: Any, now: Buffers, then: Buffers, views: Views
) -> None:
    """Row y of past (C, H, W) and of found (H, W)."""
    channels, height, width = history.shape
    point = np.empty(3, np.float32)
    normal = np.empty(3, np.float32)
    fetched = np.empty(channels, np.float32)
    weights = np.empty(4, np.float32)
    good = np.empty(4, np.bool_)
    for x in range(width):
        expect(x, y, now, views, point, normal)
        mesh = now.mesh_id[y, x]
        # Far outside the image an index would overflow; any place outside is as good.
        u = min(max(np.float32(x) + motion[0, y, x], np.float32(-2)), np.float32(width + 1))
        v = min(max(np.float32(y) + motion[1, y, x], np.float32(-2)), np.float32(height + 1))
        left = int(np.floor(u))
        top = int(np.floor(v))
        fu = u - np.float32(left)
        fv = v - np.float32(top)
        weights[0] = (ONE - fu) * (ONE - fv)
        weights[1] = fu * (ONE - fv)
        weights[2] = (ONE - fu) * fv
        weights[3] = fu * fv
        count = 0
        failed = np.float32(0)
        for tap in range(4):
            good[tap] = is_consistent(left + (tap & 1), top + (tap >> 1), mesh, point, normal, then, views)
            count += good[tap]
            if not good[tap]:
                failed += weights[tap]
        fetched[:] = 0
        if count:
            failed /= np.float32(count)
            for tap in range(4):
                if good[tap]:
                    add_pixel(fetched, history, left + (tap & 1), top + (tap >> 1), weights[tap] + failed)
            found[y, x] = True
        else:
            column = int(np.floor(u + HALF))
            row = int(np.floor(v + HALF))
            found[y, x] = fetch_box(fetched, history, column, row, mesh, point, normal, then, views)
        for c in range(channels):
            past[c, y, x] = fetched[c]


@jit_parallel
def fetch_image(past: Any, found: Any, history: Any, motion: Any, now: Buffers, then: Buffers, views: Views) -> None:
    for y in numba.prange(history.shape[1]):
        fetch_row(past, found, y, history, motion, now, then, views)


def reproject(frame: Frame, history: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """See models.reprojection.reproject."""
    past = torch.empty_like(history, memory_format=torch.contiguous_format)
    found = torch.empty((len(history), 1, *frame.size), dtype=torch.bool)
    now = Surfaces.of(frame)
    for item in range(len(history)):
        fetch_image(
            past[item].numpy(),
            found[item, 0].numpy(),
            array(history[item]),
            array(frame.motion[item]),
            Buffers.of(now, item),
            Buffers.of(surfaces, item),
            Views.of(frame, item),
        )
    return past, found
