"""models.history.reprojection for the CPU: rows in parallel, split into runs of pixels whose taps lie side by side.

Where neighbours show one mesh and move by the same whole pixels, their taps are contiguous in memory, and every loop
over them is vectorised; the few pixels of short runs and at borders are handled one by one. Points and directions are
in the world's axes around the previous eye, so that they keep their precision wherever that is.
"""

from typing import NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.frame import Frame
from models.compiled.arrays import RGB, Image, Index, Integers, Mask, Matrix, Plane, Row, Rows, Scalar, f32
from models.compiled.jit import array, jit_parallel, jit_with_memory, jit_with_reciprocals
from models.compiled.lines import add_product, block_count, rows_of_block, triple, triple_of_lines
from models.history.geometry import BACKGROUND_ID, GBuffer, to_previous_camera

HISTORY_PLANE_TOLERANCE = 0.01  # of the depth: largest distance of a tap's surface from the point's plane
NORMAL_TOLERANCE = 0.9  # smallest cosine of the angle between a tap's normal and the point's
SHORTEST_RUN = 8  # px; loops over less are slower than pixel by pixel


class FramePair(NamedTuple):
    """A frame and the previous one, of one item: all that finding history takes."""

    motion: Image  # (2, H, W)
    depth: Plane
    normal: Image
    mesh_id: Plane
    depth_then: Plane  # of the previous frame, as those below
    normal_then: Image
    mesh_then: Plane
    to_then: Matrix  # (M + 1, 3, 4), by mesh id: from this camera's frame to where the mesh was
    turn: Matrix  # (M + 1, 3, 3), by mesh id: of world-space normals
    slopes: Matrix  # (2, 2), of this camera's rays: slope and intercept over x and over y
    axes: Matrix  # (3, 3), the previous camera's rays are x axes[0] + y axes[1] + axes[2]

    @staticmethod
    def of(frame: Frame, gbuffer: GBuffer, item: int) -> "FramePair":
        """`gbuffer` is the previous frame's."""
        now, previous = frame.now, frame.previous
        K = now.K[item]
        to_world = now.camera_to_world[item, :3, :3]
        then_to_world = previous.camera_to_world[item, :3, :3]
        to_then = then_to_world @ to_previous_camera(now, previous, item)[:, :3]
        turn = to_then[..., :3] @ to_world.T
        slopes = torch.stack([1 / K.diagonal()[:2], -K[:2, 2] / K.diagonal()[:2]], dim=1)
        axes = then_to_world @ torch.linalg.inv(previous.K[item])
        images = frame.motion[item], frame.depth[item, 0], frame.normal[item], frame.mesh_id[item, 0]
        images_then = gbuffer.depth[item, 0], gbuffer.normal[item], gbuffer.mesh_id[item, 0]
        return FramePair(*(array(tensor) for tensor in (*images, *images_then, to_then, turn, slopes, axes.T)))


class RowTaps(NamedTuple):
    """Scratch memory: where the history of one row's pixels is."""

    shift: Integers  # (2, W), columns and rows from the pixel to its upper left tap
    fraction: Rows  # (2, W), of a pixel, from that tap to the position
    point: Rows  # (3, W), where the surface point was
    normal: Rows  # (3, W), and its normal
    weight: Rows  # (4, W), of the taps: 1 or 0, consistent or not, then bilinear
    valid: Row  # (W,), 1 with history, else 0
    runs: Integers  # (W, 4), first and beyond last pixel, and those between which all taps are contiguous
    boxes: Integers  # (W, 4), pixels without taps: column, that and row of the 3 x 3 box's middle, bits of its pixels
    counts: NDArray[np.int64]  # (2,), of runs and of boxes


@jit_with_memory
def new_taps(width: int) -> RowTaps:
    return RowTaps(
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
def locate(shift: Integers, fraction: Row, motion: Row, start: np.int32, step: np.int32, size: int) -> None:
    """shift, fraction (W): of the positions start + step x + motion (W) along an axis of `size` pixels."""
    # Far outside the image an index would overflow; any place outside is as good.
    end = f32(size + 1)
    for x in range(shift.size):
        here = start + step * np.int32(x)
        position = min(max(f32(here) + motion[x], f32(-2)), end)
        floor = np.floor(position)
        fraction[x] = position - floor
        shift[x] = np.int32(floor) - here


@jit_with_reciprocals
def split(runs: Integers, mesh: Row, across: Integers, down: Integers) -> int:
    """runs (W, 4) of pixels with one mesh and shift; returns their number."""
    width = mesh.size
    count = first = 0
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


@jit_with_reciprocals
def bounds(taps: RowTaps, run: int) -> tuple[Index, Index, Index, Index]:
    runs = taps.runs
    return np.int64(runs[run, 0]), np.int64(runs[run, 1]), np.int64(runs[run, 2]), np.int64(runs[run, 3])


# --- Which of them are consistent -------------------------------------------------------------------------------------


@jit_with_reciprocals
def transform_points(point: RGB, depth: Row, matrix: Matrix, across: Scalar, offset: Scalar, down: Scalar) -> None:
    """point (n) = matrix (3, 4) times (depth times the ray (across x + offset, down, 1), 1)."""
    px, py, pz = point
    xx, xy, xz, xt = matrix[0, 0], matrix[0, 1], matrix[0, 2], matrix[0, 3]
    yx, yy, yz, yt = matrix[1, 0], matrix[1, 1], matrix[1, 2], matrix[1, 3]
    zx, zy, zz, zt = matrix[2, 0], matrix[2, 1], matrix[2, 2], matrix[2, 3]
    for i in range(px.size):
        d = depth[i]
        x = (across * f32(np.int32(i)) + offset) * d
        y = down * d
        px[i] = xx * x + xy * y + xz * d + xt
        py[i] = yx * x + yy * y + yz * d + yt
        pz[i] = zx * x + zy * y + zz * d + zt


@jit_with_reciprocals
def turn_normals(turned: RGB, normal: RGB, turn: Matrix) -> None:
    """turned (n) = turn (3, 3) times the normals (n)."""
    nx, ny, nz = turned
    x, y, z = normal
    xx, xy, xz = turn[0, 0], turn[0, 1], turn[0, 2]
    yx, yy, yz = turn[1, 0], turn[1, 1], turn[1, 2]
    zx, zy, zz = turn[2, 0], turn[2, 1], turn[2, 2]
    for i in range(nx.size):
        nx[i] = xx * x[i] + xy * y[i] + xz * z[i]
        ny[i] = yx * x[i] + yy * y[i] + yz * z[i]
        nz[i] = zx * x[i] + zy * y[i] + zz * z[i]


@jit_with_reciprocals
def predict_surface(taps: RowTaps, y: Index, first: Index, last: Index, pair: FramePair) -> None:
    """Where the surface points of a run's pixels were in the previous frame, and their normals."""
    number = pair.mesh_id[y, first]
    # Meshes without a pose stand still, as background. Compared as it is: a huge number overflows an integer.
    mesh = int(number) if number >= f32(0) and number < f32(pair.to_then.shape[0]) else BACKGROUND_ID
    across = pair.slopes[0, 0]
    offset = across * (f32(first) + f32(0.5)) + pair.slopes[0, 1]
    down = pair.slopes[1, 0] * (f32(y) + f32(0.5)) + pair.slopes[1, 1]
    point = triple_of_lines(taps.point, first, last)
    transform_points(point, pair.depth[y, first:last], pair.to_then[mesh], across, offset, down)
    turn_normals(triple_of_lines(taps.normal, first, last), triple(pair.normal, y, first, last), pair.turn[mesh])


@jit_with_reciprocals
def is_consistent(x: Index, y: Index, pixel: Index, mesh: Scalar, taps: RowTaps, pair: FramePair) -> bool | np.bool_:
    """Whether the tap at column x, row y of the previous frame shows the surface point of the row's `pixel`."""
    axes = pair.axes
    height, width = pair.mesh_then.shape
    if x < 0 or y < 0 or y >= height or x >= width or pair.mesh_then[y, x] != mesh:
        return False
    if mesh == BACKGROUND_ID:
        return True
    px = f32(x) + f32(0.5)
    py = f32(y) + f32(0.5)
    depth = pair.depth_then[y, x]
    off_plane = cosine = f32(0)
    for i in range(3):
        n = pair.normal_then[i, y, x]
        visible = depth * (axes[0, i] * px + axes[1, i] * py + axes[2, i])
        off_plane += (taps.point[i, pixel] - visible) * n
        cosine += n * taps.normal[i, pixel]
    return abs(off_plane) <= f32(HISTORY_PLANE_TOLERANCE) * depth and cosine >= f32(NORMAL_TOLERANCE)


@jit_with_reciprocals
def compare_normals(good: Row, predicted: RGB, normal: RGB) -> None:
    """good (n) becomes 0 where the normals of taps differ from those predicted."""
    nx, ny, nz = predicted
    x, y, z = normal
    for i in range(good.size):
        cosine = x[i] * nx[i] + y[i] * ny[i] + z[i] * nz[i]
        good[i] = good[i] if cosine >= f32(NORMAL_TOLERANCE) else f32(0)


@jit_with_reciprocals
def compare_planes(good: Row, point: RGB, depth: Row, normal: RGB, axes: Matrix, left: Scalar, row: Scalar) -> None:
    """good (n) becomes 0 where the points are not on the planes of taps, of which the first is at (left, row)."""
    px, py, pz = point
    x, y, z = normal
    ax, ay, az = axes[0, 0], axes[0, 1], axes[0, 2]
    bx = ax * left + axes[1, 0] * row + axes[2, 0]
    by = ay * left + axes[1, 1] * row + axes[2, 1]
    bz = az * left + axes[1, 2] * row + axes[2, 2]
    for i in range(good.size):
        column = f32(np.int32(i))
        d = depth[i]
        off_plane = (px[i] - d * (ax * column + bx)) * x[i]
        off_plane += (py[i] - d * (ay * column + by)) * y[i]
        off_plane += (pz[i] - d * (az * column + bz)) * z[i]
        good[i] = good[i] if abs(off_plane) <= f32(HISTORY_PLANE_TOLERANCE) * d else f32(0)


@jit_with_reciprocals
def compare(good: Row, taps: RowTaps, x: Index, y: Index, low: Index, mesh: Scalar, pair: FramePair) -> None:
    """good (n): whether the taps from column x of row y on show the surface points of the pixels from `low` on."""
    high = low + good.size
    end = x + good.size
    if y < 0 or y >= pair.mesh_then.shape[0]:
        good[:] = f32(0)
        return
    other = pair.mesh_then[y, x:end]
    for i in range(good.size):
        good[i] = f32(1) if other[i] == mesh else f32(0)
    if mesh == BACKGROUND_ID:
        return
    normal = triple(pair.normal_then, y, x, end)
    compare_normals(good, triple_of_lines(taps.normal, low, high), normal)
    point = triple_of_lines(taps.point, low, high)
    compare_planes(good, point, pair.depth_then[y, x:end], normal, pair.axes, f32(x) + f32(0.5), f32(y) + f32(0.5))


@jit_with_reciprocals
def weigh(taps: RowTaps) -> None:
    """Bilinear weights of the consistent taps, among which those of the others are spread evenly (SVGF §4.1)."""
    across, down = taps.fraction[0], taps.fraction[1]
    a, b, c, d = taps.weight[0], taps.weight[1], taps.weight[2], taps.weight[3]
    valid = taps.valid
    for i in range(valid.size):
        fu = across[i]
        fv = down[i]
        w1 = (f32(1) - fu) * (f32(1) - fv)
        w2 = fu * (f32(1) - fv)
        w3 = (f32(1) - fu) * fv
        w4 = fu * fv
        count = a[i] + b[i] + c[i] + d[i]
        failed = w1 * (f32(1) - a[i]) + w2 * (f32(1) - b[i]) + w3 * (f32(1) - c[i]) + w4 * (f32(1) - d[i])
        failed /= max(count, f32(1))
        a[i] *= w1 + failed
        b[i] *= w2 + failed
        c[i] *= w3 + failed
        d[i] *= w4 + failed
        valid[i] = min(count, f32(1))


@jit_with_reciprocals
def find_boxes(taps: RowTaps, y: Index, pair: FramePair) -> None:
    """Validate, for the pixels without consistent taps, the 3 x 3 pixels around their previous position."""
    count = 0
    for x in range(taps.valid.size):
        if taps.valid[x] > 0:
            continue
        column = x + np.int64(taps.shift[0, x]) + (taps.fraction[0, x] >= f32(0.5))
        row = y + np.int64(taps.shift[1, x]) + (taps.fraction[1, x] >= f32(0.5))
        mesh = pair.mesh_id[y, x]
        bits = 0
        for tap in range(9):
            if is_consistent(column + tap % 3 - 1, row + tap // 3 - 1, x, mesh, taps, pair):
                bits |= 1 << tap
        if bits:
            taps.valid[x] = f32(1)
            taps.boxes[count, 0] = x
            taps.boxes[count, 1] = column
            taps.boxes[count, 2] = row
            taps.boxes[count, 3] = bits
            count += 1
    taps.counts[1] = count


@jit_with_reciprocals
def find_taps(taps: RowTaps, y: Index, pair: FramePair) -> None:
    """Fill `taps` for row y."""
    height, width = pair.mesh_id.shape
    meshes = pair.mesh_id[y]
    locate(taps.shift[0], taps.fraction[0], pair.motion[0, y], np.int32(0), np.int32(1), width)
    locate(taps.shift[1], taps.fraction[1], pair.motion[1, y], np.int32(y), np.int32(0), height)
    count = split(taps.runs, meshes, taps.shift[0], taps.shift[1])
    for run in range(count):
        first, last, low, high = bounds(taps, run)
        mesh = meshes[first]
        predict_surface(taps, y, first, last, pair)
        for tap in range(4):
            left = np.int64(taps.shift[0, first]) + (tap & 1)
            row = y + np.int64(taps.shift[1, first]) + (tap >> 1)
            good = taps.weight[tap]
            if high > low:
                compare(good[low:high], taps, low + left, row, low, mesh, pair)
            for begin, end in ((first, low), (high, last)):
                for x in range(begin, end):
                    good[x] = is_consistent(x + left, row, x, mesh, taps, pair)
    weigh(taps)
    taps.counts[0] = count
    find_boxes(taps, y, pair)


# --- What they contain ------------------------------------------------------------------------------------------------


@jit_with_reciprocals
def mix_taps(line: Row, weight: Rows, low: Index, upper: Row, lower: Row) -> None:
    """line (n), for pixels from `low` on: the weighted sum of two pixels each of the rows upper and lower (n + 1)."""
    high = low + line.size
    a, b, c, d = weight[0, low:high], weight[1, low:high], weight[2, low:high], weight[3, low:high]
    right, lower_right = upper[1:], lower[1:]
    for i in range(line.size):
        line[i] = a[i] * upper[i] + b[i] * right[i] + c[i] * lower[i] + d[i] * lower_right[i]


@jit_with_reciprocals
def gather(line: Row, plane: Plane, y: Index, taps: RowTaps) -> None:
    """line (W): the previous frame's `plane` (H, W) for the pixels of row y, by taps and boxes; 0 without history."""
    height, width = plane.shape
    weight = taps.weight
    for run in range(taps.counts[0]):
        first, last, low, high = bounds(taps, run)
        left = np.int64(taps.shift[0, first])
        row = y + np.int64(taps.shift[1, first])
        # What is outside has no weight.
        upper = plane[min(max(row, 0), height - 1)]
        lower = plane[min(max(row + 1, 0), height - 1)]
        if high > low:
            there = slice(low + left, high + left + 1)
            mix_taps(line[low:high], weight, low, upper[there], lower[there])
        for begin, end in ((first, low), (high, last)):
            for x in range(begin, end):
                column = min(max(x + left, 0), width - 1)
                beside = min(max(x + left + 1, 0), width - 1)
                line[x] = weight[0, x] * upper[column] + weight[1, x] * upper[beside]
                line[x] += weight[2, x] * lower[column] + weight[3, x] * lower[beside]
    for box in range(taps.counts[1]):
        column = np.int64(taps.boxes[box, 1])
        row = np.int64(taps.boxes[box, 2])
        bits = taps.boxes[box, 3]
        total = f32(0)
        count = 0
        for tap in range(9):
            if bits >> tap & 1:
                total += plane[row + tap // 3 - 1, column + tap % 3 - 1]
                count += 1
        line[taps.boxes[box, 0]] = total / f32(count)


@jit_parallel
def gather_image(gathered: Image, valid: Mask, history: Image, pair: FramePair) -> None:
    """gathered (C, H, W), valid (H, W)."""
    for block in numba.prange(block_count(history.shape[1])):
        taps = new_taps(history.shape[2])
        for y in rows_of_block(block, history.shape[1]):
            find_taps(taps, y, pair)
            for c in range(history.shape[0]):
                gather(gathered[c, y], history[c], y, taps)
            valid[y] = taps.valid > 0


def reproject(frame: Frame, history: Tensor, gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
    gathered = torch.empty_like(history, memory_format=torch.contiguous_format)
    valid = torch.empty((len(history), 1, *frame.size), dtype=torch.bool)
    for item in range(len(history)):
        pair = FramePair.of(frame, gbuffer, item)
        gather_image(gathered[item].numpy(), valid[item, 0].numpy(), array(history[item]), pair)
    return gathered, valid


# --- The gradient of the history --------------------------------------------------------------------------------------


@jit_with_reciprocals
def scatter(plane: Plane, line: Row, y: Index, taps: RowTaps) -> None:
    """The transpose of `gather`: add line (W), weighted, to the pixels of `plane` (H, W) that `gather` reads."""
    height, width = plane.shape
    for run in range(taps.counts[0]):
        first, last, low, high = bounds(taps, run)
        for tap in range(4):
            left = np.int64(taps.shift[0, first]) + (tap & 1)
            weight = taps.weight[tap]
            to = plane[min(max(y + np.int64(taps.shift[1, first]) + (tap >> 1), 0), height - 1)]
            if high > low:
                add_product(to[low + left : high + left], weight[low:high], line[low:high])
            for begin, end in ((first, low), (high, last)):
                for x in range(begin, end):
                    to[min(max(x + left, 0), width - 1)] += weight[x] * line[x]
    for box in range(taps.counts[1]):
        column = np.int64(taps.boxes[box, 1])
        row = np.int64(taps.boxes[box, 2])
        bits = taps.boxes[box, 3]
        count = 0
        for tap in range(9):
            count += bits >> tap & 1
        share = line[taps.boxes[box, 0]] / f32(count)
        for tap in range(9):
            if bits >> tap & 1:
                plane[row + tap // 3 - 1, column + tap % 3 - 1] += share


@numba.njit(cache=True, error_model="numpy", nogil=True)
def scatter_image(scattered: Image, gradient: Image, pair: FramePair) -> None:
    """scattered (C, H, W) from the gradient (C, H, W) of what was gathered; one thread, for rows share pixels."""
    taps = new_taps(gradient.shape[2])
    for y in range(gradient.shape[1]):
        find_taps(taps, y, pair)
        for c in range(gradient.shape[0]):
            scatter(scattered[c], gradient[c, y], y, taps)


def reproject_back(gradient: Tensor, frame: Frame, gbuffer: GBuffer) -> Tensor:
    """The gradient of the history from that of what was gathered of it, both (B, C, H, W)."""
    scattered = torch.zeros_like(gradient, memory_format=torch.contiguous_format)
    for item in range(len(gradient)):
        scatter_image(scattered[item].numpy(), array(gradient[item]), FramePair.of(frame, gbuffer, item))
    return scattered
