"""The affinity filter of models.networks.one for the CPU, with its gradients: every loop along a row is vectorised.

A level filters with 3 x 3 taps q, `step` pixels apart, of each pixel p that shows a surface (surface_p = 1, else 0):

    out_p = Σ_q w_pq image_q / Σ_q w_pq
    w_pq = surface_q exp(importance_q - sharpness_p |features_p - features_q|²),  w_pp = exp(own_p)

The squared distance of features grows by MESH_DISTANCE where p and q show different meshes. A guide g of the strength k
adds k_p (g_p - g_q)² to it.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import Image, Index, Row, Rows, f32
from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_inlined, jit_parallel, jit_with_memory, match_threads
from models.compiled.lines import add_line, add_product, normalise, scale_line

# Added to the squared distance of features where meshes differ: the network gives like features to meshes of like
# colour, depth and normal (train/campaign/README.md).
MESH_DISTANCE = 2.0
MIN_LOGIT = -40.0  # smallest logit of a tap's weight: smaller ones are clamped
AFFINITY_BLOCK_PIXELS = 2048  # filtered together, in whole rows: what they need stays in the first caches
STRIDE = 4  # features that are compared in one pass


class Level(NamedTuple):
    """What a level filters, row after row (see models.networks.one), or the gradients of that."""

    image: Image  # (B, C, N)
    features: Image  # (B, F, N), F a multiple of STRIDE
    sharpness: Rows  # (B, N), as those below
    own: Rows
    importance: Rows
    guide: Image  # (B, 2, N), its values and their strength, or (B, 0, N) for none


class TapLayout(NamedTuple):
    """Which taps a pixel has."""

    width: int
    step: int
    surface: Rows  # (B, N), 1 for pixels that count, else 0
    mesh_id: Rows  # (B, N)
    inside: Rows  # (3, N), whether taps to the left, above or below, and to the right are inside, for whole rows


# The output of a level (B, C, N), its sums of weights (B, N), and the gradient of the output (B, C, N).
Filtered: TypeAlias = tuple[Image, Rows, Image]
# (offset, low, high, column): pixels `low` to `high` - 1, which have their taps `offset` pixels further in the image's
# rows: in column 0, to the left, 1, above, below or the pixels themselves, or 2, to the right.
Taps: TypeAlias = tuple[Index, Index, Index, int]


@jit_inlined
def four(features: Rows, f: int, low: Index, high: Index) -> tuple[Row, Row, Row, Row]:
    return features[f, low:high], features[f + 1, low:high], features[f + 2, low:high], features[f + 3, low:high]


@jit_in_any_order
def add_squares(distance: Row, here: tuple[Row, Row, Row, Row], there: tuple[Row, Row, Row, Row]) -> None:
    a, b, c, d = here
    to_a, to_b, to_c, to_d = there
    for x in range(distance.size):
        by_a = a[x] - to_a[x]
        by_b = b[x] - to_b[x]
        by_c = c[x] - to_c[x]
        by_d = d[x] - to_d[x]
        distance[x] += by_a * by_a + by_b * by_b + by_c * by_c + by_d * by_d


@jit_in_any_order
def measure(distance: Row, features: Rows, low: Index, high: Index, offset: Index) -> None:
    """distance (n): |f_p - f_q|² of the pixels low to high - 1 and those `offset` further."""
    distance[:] = f32(0)
    for f in range(0, features.shape[0], STRIDE):
        add_squares(distance, four(features, f, low, high), four(features, f, low + offset, high + offset))


@jit_in_any_order
def add_mesh_distance(distance: Row, here: Row, there: Row) -> None:
    for x in range(distance.size):
        distance[x] += f32(0) if here[x] == there[x] else f32(MESH_DISTANCE)


@jit_in_any_order
def add_guide(distance: Row, here: Row, there: Row, strength: Row) -> None:
    for x in range(distance.size):
        distance[x] += strength[x] * (here[x] - there[x]) * (here[x] - there[x])


@jit_in_any_order
def weigh(weight: Row, distance: Row, sharpness: Row, importance: Row, surface: Row) -> None:
    for x in range(weight.size):
        exponent = importance[x] - sharpness[x] * distance[x]
        weight[x] = exp(min(max(exponent, f32(MIN_LOGIT)), -f32(MIN_LOGIT))) * surface[x]


@jit_in_any_order
def weigh_own(weight: Row, own: Row, surface: Row) -> None:
    for x in range(weight.size):
        weight[x] = exp(own[x]) * surface[x]


@jit_in_any_order
def weigh_taps(
    weight: Row, distance: Row, level: Level, layout: TapLayout, item: Index, taps: Taps, first: Index
) -> None:
    """weight (n) of taps; `first` is the first pixel of the block."""
    offset, low, high, column = taps
    surface, mesh_id = layout.surface[item], layout.mesh_id[item]
    if offset == 0:
        weigh_own(weight, level.own[item, low:high], surface[low:high])
        return
    there = slice(low + offset, high + offset)
    measure(distance, level.features[item], low, high, offset)
    add_mesh_distance(distance, mesh_id[low:high], mesh_id[there])
    guide = level.guide[item]
    if len(guide):
        add_guide(distance, guide[0, low:high], guide[0, there], guide[1, low:high])
    weigh(weight, distance, level.sharpness[item, low:high], level.importance[item, there], surface[there])
    scale_line(weight, layout.inside[column, low - first : high - first])


@jit_in_any_order
def taps_of_block(layout: TapLayout, first: Index, last: Index) -> Iterator[Taps]:
    """The nine taps of the pixels `first` to `last` - 1, without those in rows above and below the image."""
    pixels = layout.surface.shape[1]
    for tap in range(9):
        offset = ((tap // 3 - 1) * layout.width + tap % 3 - 1) * layout.step
        low = max(first, -offset)
        high = min(last, pixels - offset)
        if low < high and (offset == 0) == (tap == 4):
            yield offset, low, high, tap % 3


@jit_with_memory
def filter_block(
    out: Rows, total: Row, level: Level, layout: TapLayout, item: Index, first: Index, last: Index
) -> None:
    """Pixels `first` to `last` - 1 of out (C, N) and total (N)."""
    weights = np.empty(last - first, np.float32)
    distances = np.empty(last - first, np.float32)
    out[:, first:last] = f32(0)
    total[first:last] = f32(0)
    for taps in taps_of_block(layout, first, last):
        offset, low, high, _ = taps
        weight = weights[: high - low]
        weigh_taps(weight, distances[: high - low], level, layout, item, taps, first)
        add_line(total[low:high], weight)
        for c in range(len(out)):
            add_product(out[c, low:high], weight, level.image[item, c, low + offset : high + offset])
    scale_line(total[first:last], layout.surface[item, first:last])
    for c in range(len(out)):
        normalise(out[c, first:last], total[first:last])


@jit_in_any_order
def block_size(width: int) -> int:
    return max(1, AFFINITY_BLOCK_PIXELS // width) * width


@jit_parallel
def filter_item(out: Image, total: Rows, level: Level, layout: TapLayout, item: int) -> None:
    pixels = total.shape[1]
    block = block_size(layout.width)
    for number in numba.prange((pixels + block - 1) // block):
        first = np.int64(number) * block
        filter_block(out[item], total[item], level, layout, item, first, min(first + block, pixels))


def flat(tensor: Tensor) -> Image:
    """(B, C, H, W) as an array (B, C, N)."""
    batch, channels, height, width = tensor.shape
    return array(tensor).reshape(batch, channels, height * width)


def level_of(inputs: Sequence[Tensor]) -> Level:
    image, features, *others, guide = inputs
    sharpness, own, importance = (flat(tensor)[:, 0] for tensor in others)
    return Level(flat(image), flat(features), sharpness, own, importance, flat(guide))


def layout_of(surface: Tensor, mesh_id: Tensor, step: int) -> TapLayout:
    width = surface.shape[-1]
    column = np.arange(block_size(width)) % width
    inside = np.stack([column >= step, column >= 0, column < width - step])
    return TapLayout(width, step, flat(surface)[:, 0], flat(mesh_id)[:, 0], inside.astype(np.float32))


def filter_level(inputs: Sequence[Tensor], surface: Tensor, mesh_id: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """See models.networks.one.affinity_level; the sums of weights as well, (B, 1, H, W), 0 off surfaces.

    The inputs are image, features, sharpness, own, importance and a guide (B, 2, H, W), or (B, 0, H, W) for none.
    """
    image = inputs[0]
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    total = torch.empty_like(surface, memory_format=torch.contiguous_format)
    level, layout = level_of(inputs), layout_of(surface, mesh_id, step)
    for item in range(len(image)):
        filter_item(flat(out), flat(total)[:, 0], level, layout, item)
    return out, total


# --- Gradients --------------------------------------------------------------------------------------------------------
#
# With g the gradient of the output, dL/dw_pq = g_p · (image_q - out_p) / Σ_q w_pq.


@jit_in_any_order
def scale_gradient(scaled: Row, dot: Row, gradient: Row, out: Row, total: Row) -> None:
    """scaled = g / Σ w, and dot += scaled · out, for one channel."""
    for x in range(scaled.size):
        scaled[x] = gradient[x] / total[x] if total[x] > f32(0) else f32(0)
        dot[x] += scaled[x] * out[x]


@jit_in_any_order
def pull_weights(pull: Row, weight: Row, dot: Row) -> None:
    """pull (n), g / Σ w times the tap's values, becomes the gradients of the weights, times the weights."""
    for x in range(pull.size):
        pull[x] = weight[x] * (pull[x] - dot[x])


@jit_in_any_order
def pull_exponent(to_sharpness: Row, pull: Row, distance: Row, sharpness: Row, importance: Row) -> None:
    """pull (n) becomes the gradient of the exponent; -2 sharpness times that, for features, is left in distance."""
    for x in range(pull.size):
        inside = importance[x] - sharpness[x] * distance[x] >= f32(MIN_LOGIT)
        pull[x] = pull[x] if inside else f32(0)
        to_sharpness[x] -= pull[x] * distance[x]
        distance[x] = -f32(2) * sharpness[x] * pull[x]


@jit_in_any_order
def pull_feature(to_here: Row, to_there: Row, pull: Row, here: Row, there: Row) -> None:
    for x in range(pull.size):
        step = pull[x] * (here[x] - there[x])
        to_here[x] += step
        to_there[x] -= step


@jit_with_memory
def pull_block(
    to: Level, level: Level, layout: TapLayout, filtered: Filtered, item: Index, first: Index, last: Index
) -> None:
    """Add to the gradients `to` those by the outputs of pixels `first` to `last` - 1."""
    n = last - first
    out, total, gradient = filtered
    weights, distances, pulls = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    dots = np.zeros(n, np.float32)
    channels = level.image.shape[1]
    scaled = np.empty((channels, n), np.float32)
    for c in range(channels):
        to_out, filtered_channel = gradient[item, c, first:last], out[item, c, first:last]
        scale_gradient(scaled[c], dots, to_out, filtered_channel, total[item, first:last])
    for taps in taps_of_block(layout, first, last):
        offset, low, high, _ = taps
        here = slice(low - first, high - first)
        there = slice(low + offset, high + offset)
        weight, distance, pull = weights[: high - low], distances[: high - low], pulls[: high - low]
        weigh_taps(weight, distance, level, layout, item, taps, first)
        pull[:] = f32(0)
        for c in range(channels):
            add_product(pull, scaled[c, here], level.image[item, c, there])
            add_product(to.image[item, c, there], weight, scaled[c, here])
        pull_weights(pull, weight, dots[here])
        if offset == 0:
            add_line(to.own[item, low:high], pull)
            continue
        sharpness = level.sharpness[item, low:high]
        pull_exponent(to.sharpness[item, low:high], pull, distance, sharpness, level.importance[item, there])
        add_line(to.importance[item, there], pull)
        for f in range(level.features.shape[1]):
            features, to_features = level.features[item, f], to.features[item, f]
            pull_feature(to_features[low:high], to_features[there], distance, features[low:high], features[there])
        guide, to_guide = level.guide[item], to.guide[item]
        if len(guide):
            scale_line(distance, guide[1, low:high])
            pull_feature(to_guide[0, low:high], to_guide[0, there], distance, guide[0, low:high], guide[0, there])


@jit_parallel
def pull_items(to: Level, level: Level, layout: TapLayout, filtered: Filtered) -> None:
    """The gradients of a level, added to `to`; items in parallel, for the blocks of one share pixels."""
    batch, pixels = layout.surface.shape
    block = block_size(layout.width)
    for item in numba.prange(batch):
        for first in range(0, pixels, block):
            pull_block(to, level, layout, filtered, np.int64(item), first, min(first + block, pixels))


def pull_level(
    gradient: Tensor,
    inputs: Sequence[Tensor],
    surface: Tensor,
    mesh_id: Tensor,
    out: Tensor,
    total: Tensor,
    step: int,
) -> tuple[Tensor, ...]:
    """The gradients of the `inputs` of filter_level; those of the guide's strength are left 0."""
    match_threads()
    pulled = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in inputs]
    filtered = flat(out), flat(total)[:, 0], flat(gradient)
    pull_items(level_of(pulled), level_of(inputs), layout_of(surface, mesh_id, step), filtered)
    return tuple(pulled)
