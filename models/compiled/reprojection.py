"""models.history.reprojection for the CPU: rows in parallel, split into runs of pixels whose taps lie side by side.

Where neighbours show one mesh and move by the same whole pixels, their taps are contiguous lines of memory, and every
loop over them is vectorised; the few pixels of short runs and at borders are looked at one by one. Points and
directions are in the world's axes around the previous eye, so that they keep their precision wherever that is.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.frame import Frame
from models.compiled.jit import array, jit_parallel, jit_with_memory, jit_with_reciprocals
from models.compiled.lines import add_product
from models.history.geometry import BACKGROUND_ID, GBuffer, to_previous_camera

PLANE_TOLERANCE = 0.01  # of the depth: largest distance of a tap's surface from the point's plane
NORMAL_TOLERANCE = 0.9  # smallest cosine of the angle between a tap's normal and the point's
HALF = np.float32(0.5)
ONE = np.float32(1)
ZERO = np.float32(0)
SHORTEST_RUN = 8  # px; loops over less are not worth their beginning
BLOCK_ROWS = 8  # that share one piece of scratch memory


class Buffers(NamedTuple):
    """What one item of GBuffer holds."""

    depth: NDArray[np.float32]  # (H, W)
    normal: NDArray[np.float32]  # (3, H, W)
    mesh_id: NDArray[np.float32]  # (H, W)

    @staticmethod
    def of(gbuffer: GBuffer, item: int) -> "Buffers":
        return Buffers(array(gbuffer.depth[item, 0]), array(gbuffer.normal[item]), array(gbuffer.mesh_id[item, 0]))


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


class Past(NamedTuple):
    """Where the surfaces of one item of a frame were: all that finding its history takes."""

    motion: NDArray[np.float32]  # (2, H, W)
    now: Buffers
    then: Buffers
    views: Views

    @staticmethod
    def of(frame: Frame, gbuffer: GBuffer, item: int) -> "Past":
        now = Buffers.of(GBuffer.of(frame), item)
        return Past(array(frame.motion[item]), now, Buffers.of(gbuffer, item), Views.of(frame, item))


class Search(NamedTuple):
    """Scratch memory: what is known of the history of one row's pixels."""

    shift: NDArray[np.int32]  # (2, W), columns and rows from the pixel to its upper left tap
    part: NDArray[np.float32]  # (2, W), how far between the taps
    point: NDArray[np.float32]  # (3, W), where its surface point was
    normal: NDArray[np.float32]  # (3, W)
    weight: NDArray[np.float32]  # (4, W), of its taps: 1 or 0, consistent or not, then what they count
    found: NDArray[np.float32]  # (W,), 1 or 0
    runs: NDArray[np.int32]  # (W, 4), first and beyond last pixel, and those between which all taps are contiguous
    boxes: NDArray[np.int32]  # (W, 4), pixels without taps: column, that and row of the box, bits of its pixels
    counts: NDArray[np.int64]  # (2,), of runs and of boxes


@jit_with_memory
def new_search(width: int) -> Any:
    return Search(
        np.empty((2, width), np.int32),
        np.empty((2, width), np.float32),
        np.empty((3, width), np.float32),
        np.empty((3, width), np.float32),
        np.empty((4, width), np.float32),
        np.empty(width, np.float32),
        np.empty((width, 4), np.int32),
        np.empty((width, 4), np.int32),
        np.empty(2, np.int64),
    )


# --- Where the taps are -----------------------------------------------------------------------------------------------


@jit_with_reciprocals
def locate(shift: Any, part: Any, motion: Any, start: Any, step: Any, size: int) -> None:
    """shift, part (W): of the positions start + step x + motion (W) along an axis of `size` pixels."""
    # Far outside the image an index would overflow; any place outside is as good.
    end = np.float32(size + 1)
    for x in range(shift.size):
        here = start + step * np.int32(x)
        position = min(max(np.float32(here) + motion[x], np.float32(-2)), end)
        floor = np.floor(position)
        part[x] = position - floor
        shift[x] = np.int32(floor) - here


@jit_with_reciprocals
def split(runs: Any, mesh: Any, across: Any, down: Any) -> int:
    """runs (W, 4) of pixels with one mesh and shift; returns their number."""
    width = mesh.size
    count = 0
    first = 0
    for x in range(1, width + 1):
        if x < width and mesh[x] == mesh[first] and across[x] == across[first] and down[x] == down[first]:
            continue
        low = max(first, -across[first])
        high = min(x, width - 1 - across[first])
        runs[count, 0] = first
        runs[count, 1] = x
        runs[count, 2] = low if high - low >= SHORTEST_RUN else first
        runs[count, 3] = high if high - low >= SHORTEST_RUN else first
        count += 1
        first = x
    return count


# --- Which of them are consistent -------------------------------------------------------------------------------------


@jit_with_reciprocals
def transform_points(px: Any, py: Any, pz: Any, depth: Any, matrix: Any, across: Any, offset: Any, down: Any) -> None:
    """px, py, pz (n) = matrix (3, 4) times depth times the ray (across x + offset, down, 1)."""
    xx, xy, xz, xt = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    yx, yy, yz, yt = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    zx, zy, zz, zt = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in range(px.size):
        d = depth[i]
        x = (across * np.float32(np.int32(i)) + offset) * d
        y = down * d
        px[i] = xx * x + xy * y + xz * d + xt
        py[i] = yx * x + yy * y + yz * d + yt
        pz[i] = zx * x + zy * y + zz * d + zt


@jit_with_reciprocals
def turn_normals(nx: Any, ny: Any, nz: Any, x: Any, y: Any, z: Any, turn: Any) -> None:
    """nx, ny, nz (n) = turn (3, 3) times (x, y, z) (n)."""
    xx, xy, xz = turn[0, 0], turn[0, 1], turn[0, 2]
    yx, yy, yz = turn[1, 0], turn[1, 1], turn[1, 2]
    zx, zy, zz = turn[2, 0], turn[2, 1], turn[2, 2]
    for i in range(nx.size):
        nx[i] = xx * x[i] + xy * y[i] + xz * z[i]
        ny[i] = yx * x[i] + yy * y[i] + yz * z[i]
        nz[i] = zx * x[i] + zy * y[i] + zz * z[i]


@jit_with_reciprocals
def expect(search: Search, y: Any, first: Any, last: Any, past: Past) -> None:
    """Where the surface points of a run's pixels were, and their normals."""
    now = past.now
    views = past.views
    mesh = min(int(now.mesh_id[y, first]), views.to_then.shape[0] - 1)
    across = views.slopes[0, 0]
    offset = across * (np.float32(first) + HALF) + views.slopes[0, 1]
    down = views.slopes[1, 0] * (np.float32(y) + HALF) + views.slopes[1, 1]
    transform_points(
        search.point[0, first:last],
        search.point[1, first:last],
        search.point[2, first:last],
        now.depth[y, first:last],
        views.to_then[mesh],
        across,
        offset,
        down,
    )
    turn_normals(
        search.normal[0, first:last],
        search.normal[1, first:last],
        search.normal[2, first:last],
        now.normal[0, y, first:last],
        now.normal[1, y, first:last],
        now.normal[2, y, first:last],
        views.turn[mesh],
    )


@jit_with_reciprocals
def is_consistent(x: Any, y: Any, pixel: Any, mesh: float, search: Search, then: Buffers, views: Views) -> Any:
    """Whether the tap at column x, row y of the previous frame shows the surface point of the row's `pixel`."""
    height, width = then.mesh_id.shape
    if x < 0 or y < 0 or y >= height or x >= width or then.mesh_id[y, x] != mesh:
        return False
    if mesh == BACKGROUND_ID:
        return True
    px = np.float32(x) + HALF
    py = np.float32(y) + HALF
    depth = then.depth[y, x]
    off_plane = ZERO
    cosine = ZERO
    for i in range(3):
        n = then.normal[i, y, x]
        seen = depth * (views.axes[0, i] * px + views.axes[1, i] * py + views.axes[2, i])
        off_plane += (search.point[i, pixel] - seen) * n
        cosine += n * search.normal[i, pixel]
    return abs(off_plane) <= np.float32(PLANE_TOLERANCE) * depth and cosine >= np.float32(NORMAL_TOLERANCE)


@jit_with_reciprocals
def compare_meshes(good: Any, mesh: Any, other: Any) -> None:
    for i in range(good.size):
        good[i] = ONE if other[i] == mesh else ZERO


@jit_with_reciprocals
def compare_normals(good: Any, nx: Any, ny: Any, nz: Any, x: Any, y: Any, z: Any) -> None:
    """good (n) becomes 0 where the normals (x, y, z) of taps are not those expected."""
    for i in range(good.size):
        cosine = x[i] * nx[i] + y[i] * ny[i] + z[i] * nz[i]
        good[i] = good[i] if cosine >= np.float32(NORMAL_TOLERANCE) else ZERO


@jit_with_reciprocals
def compare_planes(
    good: Any, px: Any, py: Any, pz: Any, depth: Any, x: Any, y: Any, z: Any, axes: Any, left: Any, row: Any
) -> None:
    """good (n) becomes 0 where the points are not on the planes of taps with normals (x, y, z), from `left` on."""
    ax, ay, az = axes[0, 0], axes[0, 1], axes[0, 2]
    bx = ax * left + axes[1, 0] * row + axes[2, 0]
    by = ay * left + axes[1, 1] * row + axes[2, 1]
    bz = az * left + axes[1, 2] * row + axes[2, 2]
    for i in range(good.size):
        column = np.float32(np.int32(i))
        d = depth[i]
        off_plane = (px[i] - d * (ax * column + bx)) * x[i]
        off_plane += (py[i] - d * (ay * column + by)) * y[i]
        off_plane += (pz[i] - d * (az * column + bz)) * z[i]
        good[i] = good[i] if abs(off_plane) <= np.float32(PLANE_TOLERANCE) * d else ZERO


@jit_with_reciprocals
def compare(good: Any, search: Search, x: Any, y: Any, low: Any, mesh: float, then: Buffers, views: Views) -> None:
    """good (n): whether the taps from column x of row y on show the surface points of the pixels from `low` on."""
    high = low + good.size
    end = x + good.size
    if y < 0 or y >= then.mesh_id.shape[0]:
        good[:] = ZERO
        return
    compare_meshes(good, mesh, then.mesh_id[y, x:end])
    if mesh == BACKGROUND_ID:
        return
    nx = then.normal[0, y, x:end]
    ny = then.normal[1, y, x:end]
    nz = then.normal[2, y, x:end]
    expected = search.normal
    compare_normals(good, expected[0, low:high], expected[1, low:high], expected[2, low:high], nx, ny, nz)
    point = search.point
    compare_planes(
        good,
        point[0, low:high],
        point[1, low:high],
        point[2, low:high],
        then.depth[y, x:end],
        nx,
        ny,
        nz,
        views.axes,
        np.float32(x) + HALF,
        np.float32(y) + HALF,
    )


@jit_with_reciprocals
def weigh(found: Any, one: Any, two: Any, three: Any, four: Any, across: Any, down: Any) -> None:
    """Weights one to four (W) of the taps from whether they are consistent, and whether any is: found (W)."""
    for i in range(found.size):
        fu = across[i]
        fv = down[i]
        w1 = (ONE - fu) * (ONE - fv)
        w2 = fu * (ONE - fv)
        w3 = (ONE - fu) * fv
        w4 = fu * fv
        count = one[i] + two[i] + three[i] + four[i]
        failed = w1 * (ONE - one[i]) + w2 * (ONE - two[i]) + w3 * (ONE - three[i]) + w4 * (ONE - four[i])
        failed /= max(count, ONE)
        one[i] *= w1 + failed
        two[i] *= w2 + failed
        three[i] *= w3 + failed
        four[i] *= w4 + failed
        found[i] = min(count, ONE)


@jit_with_reciprocals
def find_boxes(search: Search, y: Any, past: Past) -> None:
    """Look for the pixels that have no consistent taps among the 3 x 3 around where they were."""
    count = 0
    for x in range(search.found.size):
        if search.found[x] > 0:
            continue
        column = x + np.int64(search.shift[0, x]) + (search.part[0, x] >= HALF)
        row = y + np.int64(search.shift[1, x]) + (search.part[1, x] >= HALF)
        mesh = past.now.mesh_id[y, x]
        bits = 0
        for tap in range(9):
            if is_consistent(column + tap % 3 - 1, row + tap // 3 - 1, x, mesh, search, past.then, past.views):
                bits |= 1 << tap
        if bits:
            search.found[x] = ONE
            search.boxes[count, 0] = x
            search.boxes[count, 1] = column
            search.boxes[count, 2] = row
            search.boxes[count, 3] = bits
            count += 1
    search.counts[1] = count


@jit_with_reciprocals
def find_row(search: Search, y: Any, past: Past) -> None:
    """Fill `search` for a row."""
    height, width = past.now.mesh_id.shape
    meshes = past.now.mesh_id[y]
    locate(search.shift[0], search.part[0], past.motion[0, y], np.int32(0), np.int32(1), width)
    locate(search.shift[1], search.part[1], past.motion[1, y], np.int32(y), np.int32(0), height)
    count = split(search.runs, meshes, search.shift[0], search.shift[1])
    for run in range(count):
        first = np.int64(search.runs[run, 0])
        last = np.int64(search.runs[run, 1])
        low = np.int64(search.runs[run, 2])
        high = np.int64(search.runs[run, 3])
        mesh = meshes[first]
        expect(search, y, first, last, past)
        for tap in range(4):
            left = np.int64(search.shift[0, first]) + (tap & 1)
            row = y + np.int64(search.shift[1, first]) + (tap >> 1)
            good = search.weight[tap]
            if high > low:
                compare(good[low:high], search, low + left, row, low, mesh, past.then, past.views)
            for begin, end in ((first, low), (high, last)):
                for x in range(begin, end):
                    good[x] = is_consistent(x + left, row, x, mesh, search, past.then, past.views)
    weight = search.weight
    weigh(search.found, weight[0], weight[1], weight[2], weight[3], search.part[0], search.part[1])
    search.counts[0] = count
    find_boxes(search, y, past)


# --- What they hold ---------------------------------------------------------------------------------------------------


@jit_with_reciprocals
def mix_taps(
    line: Any, one: Any, two: Any, three: Any, four: Any, above: Any, right: Any, below: Any, last: Any
) -> None:
    for i in range(line.size):
        line[i] = one[i] * above[i] + two[i] * right[i] + three[i] * below[i] + four[i] * last[i]


@jit_with_reciprocals
def fetch_runs(line: Any, plane: Any, y: Any, search: Search) -> None:
    """What consistent taps hold, in line (W)."""
    height, width = plane.shape
    weight = search.weight
    for run in range(search.counts[0]):
        first = np.int64(search.runs[run, 0])
        last = np.int64(search.runs[run, 1])
        low = np.int64(search.runs[run, 2])
        high = np.int64(search.runs[run, 3])
        left = np.int64(search.shift[0, first])
        row = y + np.int64(search.shift[1, first])
        # What is outside has no weight.
        upper = plane[min(max(row, 0), height - 1)]
        lower = plane[min(max(row + 1, 0), height - 1)]
        if high > low:
            mix_taps(
                line[low:high],
                weight[0, low:high],
                weight[1, low:high],
                weight[2, low:high],
                weight[3, low:high],
                upper[low + left : high + left],
                upper[low + left + 1 : high + left + 1],
                lower[low + left : high + left],
                lower[low + left + 1 : high + left + 1],
            )
        for begin, end in ((first, low), (high, last)):
            for x in range(begin, end):
                column = min(max(x + left, 0), width - 1)
                beside = min(max(x + left + 1, 0), width - 1)
                line[x] = weight[0, x] * upper[column] + weight[1, x] * upper[beside]
                line[x] += weight[2, x] * lower[column] + weight[3, x] * lower[beside]


@jit_with_reciprocals
def fetch_boxes(line: Any, plane: Any, search: Search) -> None:
    """The mean of what the consistent ones of 3 x 3 pixels hold, for pixels that were found in boxes."""
    for box in range(search.counts[1]):
        column = np.int64(search.boxes[box, 1])
        row = np.int64(search.boxes[box, 2])
        bits = search.boxes[box, 3]
        total = ZERO
        count = 0
        for tap in range(9):
            if bits >> tap & 1:
                total += plane[row + tap // 3 - 1, column + tap % 3 - 1]
                count += 1
        line[search.boxes[box, 0]] = total / np.float32(count)


@jit_with_reciprocals
def fetch(line: Any, plane: Any, y: Any, search: Search) -> None:
    """line (W): what `plane` (H, W) of the previous frame holds for the pixels of row y, 0 where none was found."""
    fetch_runs(line, plane, y, search)
    fetch_boxes(line, plane, search)


@jit_parallel
def fetch_image(fetched: Any, found: Any, history: Any, motion: Any, now: Buffers, then: Buffers, views: Views) -> None:
    """fetched (C, H, W), found (H, W)."""
    _, height, width = history.shape
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        search = new_search(width)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            find_row(search, y, Past(motion, now, then, views))
            for c in range(history.shape[0]):
                fetch(fetched[c, y], history[c], y, search)
            found[y] = search.found > 0


def reproject(frame: Frame, history: Tensor, gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
    """See models.history.reprojection.reproject."""
    fetched = torch.empty_like(history, memory_format=torch.contiguous_format)
    found = torch.empty((len(history), 1, *frame.size), dtype=torch.bool)
    for item in range(len(history)):
        past = Past.of(frame, gbuffer, item)
        fetch_image(fetched[item].numpy(), found[item, 0].numpy(), array(history[item]), *past)
    return fetched, found


# --- The gradient of the history --------------------------------------------------------------------------------------


@jit_with_reciprocals
def give_back(plane: Any, line: Any, y: Any, search: Search) -> None:
    """Add to `plane` (H, W) what `fetch` has taken from it, line (W): its transpose."""
    height, width = plane.shape
    for run in range(search.counts[0]):
        first = np.int64(search.runs[run, 0])
        last = np.int64(search.runs[run, 1])
        low = np.int64(search.runs[run, 2])
        high = np.int64(search.runs[run, 3])
        for tap in range(4):
            left = np.int64(search.shift[0, first]) + (tap & 1)
            weight = search.weight[tap]
            to = plane[min(max(y + np.int64(search.shift[1, first]) + (tap >> 1), 0), height - 1)]
            if high > low:
                add_product(to[low + left : high + left], weight[low:high], line[low:high])
            for begin, end in ((first, low), (high, last)):
                for x in range(begin, end):
                    to[min(max(x + left, 0), width - 1)] += weight[x] * line[x]
    for box in range(search.counts[1]):
        column = np.int64(search.boxes[box, 1])
        row = np.int64(search.boxes[box, 2])
        bits = search.boxes[box, 3]
        count = 0
        for tap in range(9):
            count += bits >> tap & 1
        share = line[search.boxes[box, 0]] / np.float32(count)
        for tap in range(9):
            if bits >> tap & 1:
                plane[row + tap // 3 - 1, column + tap % 3 - 1] += share


@numba.njit(cache=True, error_model="numpy", nogil=True)
def give_back_image(given: Any, gradient: Any, motion: Any, now: Buffers, then: Buffers, views: Views) -> None:
    """given (C, H, W) from the gradient (C, H, W) of what was fetched. Rows meet where they come from: one by one."""
    width = gradient.shape[2]
    search = new_search(width)
    for y in range(gradient.shape[1]):
        find_row(search, y, Past(motion, now, then, views))
        for c in range(gradient.shape[0]):
            give_back(given[c], gradient[c, y], y, search)


def reproject_back(gradient: Tensor, frame: Frame, gbuffer: GBuffer) -> Tensor:
    """The gradient of the history from that of what was fetched of it, both (B, C, H, W)."""
    given = torch.zeros_like(gradient, memory_format=torch.contiguous_format)
    for item in range(len(gradient)):
        give_back_image(given[item].numpy(), array(gradient[item]), *Past.of(frame, gbuffer, item))
    return given
