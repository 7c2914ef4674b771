"""The camera of a foreign frame: from the header's matrices, or fitted to the positions of its pixels."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.camera import Array, View, pixel_centres, view_of

POSITIONS = 1 << 14  # that a camera is fitted to
DRAW_SIZE = 12  # of them that a first fit takes
DRAWS = 32  # first fits: one of them has no outlier, almost surely, where less than a tenth of the positions are
MAX_ERROR = 1 / 200  # of the image: the median distance of fitted positions from their pixels, rounded to half
MIN_THICKNESS = 1e-4  # of the positions, relative to their extent: flatter ones do not determine the camera
MAX_ORIGIN_DISTANCE = 0.01  # relative to the positions': a camera closer to (0, 0, 0) is taken to be there
MAX_OBLONGNESS = 0.01  # by how much focal lengths may differ


def view_of_positions(positions: NDArray[np.float32], surface: NDArray[np.bool_]) -> View | None:
    """The view that sees `positions` (H, W, 3) at their pixels where there is a `surface` (H, W).

    The direct linear transform (Hartley and Zisserman, §7.1), first of a few points (RANSAC, §4.7), then of all
    inliers. None where there is no such pinhole camera, or more than one, as for points in a plane.
    """
    usable = np.nonzero(surface & np.isfinite(positions).all(axis=-1))
    stride = max(1, len(usable[0]) // POSITIONS)
    rows, columns = (index[::stride] for index in usable)
    points = positions[rows, columns].astype(np.float64)
    pixels = pixel_centres(*surface.shape)[rows, columns]
    if len(points) < DRAW_SIZE:
        return None
    thickness = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if thickness[2] < MIN_THICKNESS * thickness[0]:
        return None

    def median_error(fit: Array) -> float:
        return float(np.median(reprojection_error(fit, points, pixels)))

    rng = np.random.default_rng(0)
    draws = (rng.choice(len(points), DRAW_SIZE, replace=False) for _ in range(DRAWS))
    fit = min((linear_fit(points[draw], pixels[draw]) for draw in draws), key=median_error)
    for _ in range(2):
        inliers = reprojection_error(fit, points, pixels) <= max(3 * median_error(fit), 1e-3)
        fit = linear_fit(points[inliers], pixels[inliers])
    return view_of(fit) if median_error(fit) <= MAX_ERROR * max(surface.shape) else None


def linear_fit(points: Array, pixels: Array) -> Array:
    """The projection (3, 4) that maps `points` (N, 3) to `pixels` (N, 2) with the least algebraic error."""
    to_unit_3 = normalising(points)
    to_unit_2 = normalising(pixels)
    p = homogeneous(points) @ to_unit_3.T
    x, y, _ = (homogeneous(pixels) @ to_unit_2.T).T
    zero = np.zeros_like(p)
    equations = np.concatenate([np.hstack([p, zero, -x[:, None] * p]), np.hstack([zero, p, -y[:, None] * p])])
    unit = np.linalg.svd(np.linalg.qr(equations, mode="r"))[2][-1].reshape(3, 4)
    projection: Array = np.linalg.inv(to_unit_2) @ unit @ to_unit_3
    return projection * np.sign(np.median(homogeneous(points) @ projection[2]))


def homogeneous(points: Array) -> Array:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def normalising(points: Array) -> Array:
    """The homogeneous transform that moves `points` (N, D) to mean 0 and scales them to a standard deviation of 1."""
    scale = 1 / max(float(points.std()), 1e-30)
    matrix = np.diag([scale] * points.shape[1] + [1.0])
    matrix[:-1, -1] = -scale * points.mean(axis=0)
    return matrix


def reprojection_error(projection: Array, points: Array, pixels: Array) -> Array:
    """Distances (N,) in pixels."""
    image = homogeneous(points) @ projection.T
    with np.errstate(divide="ignore", invalid="ignore"):
        error: Array = np.linalg.norm(image[:, :2] / image[:, 2:] - pixels, axis=1)
    return np.nan_to_num(error, nan=np.inf)


def view_of_header(header: Mapping[str, Any], height: int, width: int) -> View | None:
    """The view of `worldToNDC`, None without.

    OpenEXR specifies coordinates in [-1, 1] with y up; where the viewing axis meets the image at (1/2, 1/2), they are
    in [0, 1]. They are those of the display window, of which the pixels may be a part. A matrix that makes pixels
    oblong is ignored: pbrt writes one for images that are not square.
    """
    if "worldToNDC" not in header:
        return None
    ndc = np.asarray(header["worldToNDC"], np.float64).T  # EXR has matrices for row vectors
    axis = ndc @ [*ndc[3, :3], 0]
    if not axis[3] > 0:
        return None
    centre = axis[:2] / axis[3]
    from_zero = np.abs(centre - 0.5).max() < np.abs(centre).max()
    if "displayWindow" in header:
        low, high = header["displayWindow"]
        width, height = (int(number) for number in high - low + 1)
        left, top = low - header["dataWindow"][0]
    else:
        left, top = 0, 0
    scale, shift = ([width, -height], [0, height]) if from_zero else ([width / 2, -height / 2], [width / 2, height / 2])
    to_pixels = np.array([[scale[0], 0, shift[0] + left], [0, scale[1], shift[1] + top], [0, 0, 1.0]])
    view = view_of(to_pixels @ ndc[[0, 1, 3]])
    aspect = float(header.get("pixelAspectRatio", 1.0))
    if view is None or abs(view.K[1, 1] / (view.K[0, 0] * aspect) - 1) > MAX_OBLONGNESS:
        return None
    return view


def is_own_space(
    view: View, header: Mapping[str, Any], positions: NDArray[np.float32], surface: NDArray[np.bool_]
) -> bool:
    """Whether the `positions` that a camera was fitted to are in its own coordinates: the camera is at the origin.

    Where the header has a `worldToCamera`, it is if the fit is closer to the origin than to the camera's place in the
    world.
    """
    eye = view.camera_to_world[:3, 3]
    pose = to_world(header)
    if pose is not None:
        return bool(np.linalg.norm(eye) <= np.linalg.norm(eye - pose[:3, 3]))
    return bool(np.linalg.norm(eye) < MAX_ORIGIN_DISTANCE * np.median(np.linalg.norm(positions[surface], axis=-1)))


def to_world(header: Mapping[str, Any]) -> Array | None:
    """The inverse (4, 4) of `worldToCamera`, which EXR has for row vectors; None where there is none."""
    matrix = np.asarray(header.get("worldToCamera", np.zeros((4, 4))), np.float64).T
    regular = np.isfinite(matrix).all() and np.linalg.matrix_rank(matrix) == 4
    return np.linalg.inv(matrix).astype(np.float64) if regular else None


def in_the_world(view: View, header: Mapping[str, Any]) -> View | None:
    """A view fitted in the camera's own coordinates, moved to the world by `worldToCamera`; None without it."""
    pose = to_world(header)
    return None if pose is None else view._replace(camera_to_world=pose @ view.camera_to_world)
