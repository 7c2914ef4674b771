"""models.networks.affinity for the processor, with its gradients: every loop along a row is vectorised."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory, match_threads
from models.compiled.lines import add_line, add_product, scale_line

MIN_LOGIT = -40.0  # smallest logit of a tap's weight: smaller ones are clamped
ZERO = np.float32(0)
TWO = np.float32(2)
BLOCK_PIXELS = 2048  # px; so many, in whole rows, are filtered together: what they need stays in the first caches
STRIDE = 4  # features that are compared in one pass


@jit_in_any_order
def add_squares(distance: Any, a: Any, b: Any, c: Any, d: Any, to_a: Any, to_b: Any, to_c: Any, to_d: Any) -> None:
    for x in range(distance.size):
        by_a = a[x] - to_a[x]
        by_b = b[x] - to_b[x]
        by_c = c[x] - to_c[x]
        by_d = d[x] - to_d[x]
        distance[x] += by_a * by_a + by_b * by_b + by_c * by_c + by_d * by_d


@jit_in_any_order
def measure(distance: Any, features: Any, low: Any, high: Any, offset: Any) -> None:
    """distance (n): |f_p - f_q|² of the pixels low to high and those `offset` further."""
    distance[:] = ZERO
    for f in range(0, features.shape[0], STRIDE):
        add_squares(
            distance,
            features[f, low:high],
            features[f + 1, low:high],
            features[f + 2, low:high],
            features[f + 3, low:high],
            features[f, low + offset : high + offset],
            features[f + 1, low + offset : high + offset],
            features[f + 2, low + offset : high + offset],
            features[f + 3, low + offset : high + offset],
        )


@jit_in_any_order
def weigh(weight: Any, distance: Any, sharpness: Any, importance: Any, surface: Any) -> None:
    for x in range(weight.size):
        exponent = importance[x] - sharpness[x] * distance[x]
        weight[x] = exp(min(max(exponent, np.float32(MIN_LOGIT)), -np.float32(MIN_LOGIT))) * surface[x]


@jit_in_any_order
def weigh_own(weight: Any, own: Any, surface: Any) -> None:
    for x in range(weight.size):
        weight[x] = exp(own[x]) * surface[x]


@jit_in_any_order
def add_weighted(
    red: Any, green: Any, blue: Any, total: Any, weight: Any, from_red: Any, from_green: Any, from_blue: Any
) -> None:
    for x in range(total.size):
        w = weight[x]
        red[x] += w * from_red[x]
        green[x] += w * from_green[x]
        blue[x] += w * from_blue[x]
        total[x] += w


@jit_in_any_order
def normalise(red: Any, green: Any, blue: Any, total: Any) -> None:
    for x in range(total.size):
        scale = np.float32(1) / total[x] if total[x] > ZERO else ZERO
        red[x] *= scale
        green[x] *= scale
        blue[x] *= scale


@jit_in_any_order
def weigh_tap(
    weight: Any,
    distance: Any,
    features: Any,
    sharpness: Any,
    own: Any,
    importance: Any,
    surface: Any,
    inside: Any,
    low: Any,
    high: Any,
    offset: Any,
) -> None:
    """weight (n) of the taps `offset` further than the pixels low to high, 0 where they are not `inside` (n)."""
    if offset == 0:
        weigh_own(weight, own[low:high], surface[low:high])
        return
    measure(distance, features, low, high, offset)
    there = slice(low + offset, high + offset)
    weigh(weight, distance, sharpness[low:high], importance[there], surface[there])
    scale_line(weight, inside)


@jit_with_memory
def columns_inside(pixels: int, width: int, step: int) -> Any:
    """Whether the taps to the left, above or below, and to the right of `pixels` in whole rows are inside: (3, N)."""
    inside = np.ones((3, pixels), np.float32)
    for p in range(pixels):
        inside[0, p] = np.float32(p % width >= step)
        inside[2, p] = np.float32(p % width < width - step)
    return inside


@jit_parallel
def filter_image(
    out: Any,
    total: Any,
    image: Any,
    features: Any,
    sharpness: Any,
    own: Any,
    importance: Any,
    surface: Any,
    width: int,
    step: int,
) -> None:
    """out (3, N) and the sums of weights, total (N), from image (3, N), features (F, N), others (N), row after row."""
    pixels = total.size
    block = max(1, BLOCK_PIXELS // width) * width
    inside = columns_inside(block, width, step)
    for number in numba.prange((pixels + block - 1) // block):
        distances = np.empty(block, np.float32)
        weights = np.empty(block, np.float32)
        first: Any = np.int64(number) * block
        last = min(first + block, pixels)
        out[:, first:last] = ZERO
        total[first:last] = ZERO
        for tap in range(9):
            offset = (tap // 3 - 1) * step * width + (tap % 3 - 1) * step
            # Rows above and below the image are cut off here, columns beside it have no weight.
            low = max(first, -offset)
            high = min(last, pixels - offset)
            if low >= high or (offset == 0) != (tap == 4):
                continue
            weight = weights[: high - low]
            weigh_tap(
                weight,
                distances[: high - low],
                features,
                sharpness,
                own,
                importance,
                surface,
                inside[tap % 3, low - first : high - first],
                low,
                high,
                offset,
            )
            there = slice(low + offset, high + offset)
            add_weighted(
                out[0, low:high],
                out[1, low:high],
                out[2, low:high],
                total[low:high],
                weight,
                image[0, there],
                image[1, there],
                image[2, there],
            )
        scale_line(total[first:last], surface[first:last])
        normalise(out[0, first:last], out[1, first:last], out[2, first:last], total[first:last])


def flat(tensor: Tensor) -> Any:
    """(B, C, H, W) as an array (B, C, N)."""
    return array(tensor).reshape(*tensor.shape[:2], -1)


def filter_level(
    image: Tensor, features: Tensor, sharpness: Tensor, own: Tensor, importance: Tensor, surface: Tensor, step: int
) -> tuple[Tensor, Tensor]:
    """See models.networks.affinity.affinity_level; the sums of weights as well, (B, 1, H, W), 0 off surfaces."""
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    total = torch.empty_like(surface, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        filter_image(
            flat(out)[item],
            flat(total)[item, 0],
            flat(image)[item],
            flat(features)[item],
            flat(sharpness)[item, 0],
            flat(own)[item, 0],
            flat(importance)[item, 0],
            flat(surface)[item, 0],
            image.shape[-1],
            step,
        )
    return out, total


# --- Gradients --------------------------------------------------------------------------------------------------------
#
# With g the gradient of the output over the sum of weights, that of the weight of q for p is g_p (image_q - out_p).


@jit_in_any_order
def pull_weights(
    pull: Any, weight: Any, red: Any, green: Any, blue: Any, dot: Any, to_red: Any, to_green: Any, to_blue: Any
) -> None:
    """pull (n): the gradients of the weights, times the weights."""
    for x in range(pull.size):
        pull[x] = weight[x] * (red[x] * to_red[x] + green[x] * to_green[x] + blue[x] * to_blue[x] - dot[x])


@jit_in_any_order
def pull_exponent(to_sharpness: Any, pull: Any, distance: Any, sharpness: Any, importance: Any) -> None:
    """pull (n) becomes the gradient of the exponent; -2 sharpness times that, for features, is left in distance."""
    for x in range(pull.size):
        inside = importance[x] - sharpness[x] * distance[x] >= np.float32(MIN_LOGIT)
        pull[x] = pull[x] if inside else ZERO
        to_sharpness[x] -= pull[x] * distance[x]
        distance[x] = -TWO * sharpness[x] * pull[x]


@jit_in_any_order
def pull_feature(to_here: Any, to_there: Any, pull: Any, here: Any, there: Any) -> None:
    for x in range(pull.size):
        step = pull[x] * (here[x] - there[x])
        to_here[x] += step
        to_there[x] -= step


@jit_in_any_order
def scale_gradient(scaled: Any, dot: Any, gradient: Any, out: Any, total: Any) -> None:
    for x in range(scaled.size):
        scaled[x] = gradient[x] / total[x] if total[x] > ZERO else ZERO
        dot[x] += scaled[x] * out[x]


@jit_parallel
def pull_images(
    to_image: Any,
    to_features: Any,
    to_sharpness: Any,
    to_own: Any,
    to_importance: Any,
    gradient: Any,
    image: Any,
    features: Any,
    sharpness: Any,
    own: Any,
    importance: Any,
    surface: Any,
    out: Any,
    total: Any,
    width: int,
    step: int,
) -> None:
    """The gradients of what affinity_level takes, added to `to_...`: (B, ., N), items in parallel."""
    batch, colours, pixels = image.shape
    block = max(1, BLOCK_PIXELS // width) * width
    inside = columns_inside(block, width, step)
    for item in numba.prange(batch):
        distances = np.empty(block, np.float32)
        weights = np.empty(block, np.float32)
        pulls = np.empty(block, np.float32)
        dots = np.empty(block, np.float32)
        scaled = np.empty((colours, block), np.float32)
        for first in range(0, pixels, block):
            last = min(first + block, pixels)
            dots[:] = ZERO
            for c in range(colours):
                scale_gradient(
                    scaled[c, : last - first],
                    dots[: last - first],
                    gradient[item, c, first:last],
                    out[item, c, first:last],
                    total[item, 0, first:last],
                )
            for tap in range(9):
                offset = (tap // 3 - 1) * step * width + (tap % 3 - 1) * step
                low = max(first, -offset)
                high = min(last, pixels - offset)
                if low >= high or (offset == 0) != (tap == 4):
                    continue
                there = slice(low + offset, high + offset)
                here = slice(low - first, high - first)
                weight = weights[: high - low]
                distance = distances[: high - low]
                pull = pulls[: high - low]
                weigh_tap(
                    weight,
                    distance,
                    features[item],
                    sharpness[item, 0],
                    own[item, 0],
                    importance[item, 0],
                    surface[item, 0],
                    inside[tap % 3, here],
                    low,
                    high,
                    offset,
                )
                pull_weights(
                    pull,
                    weight,
                    scaled[0, here],
                    scaled[1, here],
                    scaled[2, here],
                    dots[here],
                    image[item, 0, there],
                    image[item, 1, there],
                    image[item, 2, there],
                )
                for c in range(colours):
                    add_product(to_image[item, c, there], weight, scaled[c, here])
                if offset == 0:
                    add_line(to_own[item, 0, low:high], pull)
                    continue
                pull_exponent(
                    to_sharpness[item, 0, low:high],
                    pull,
                    distance,
                    sharpness[item, 0, low:high],
                    importance[item, 0, there],
                )
                add_line(to_importance[item, 0, there], pull)
                for f in range(features.shape[1]):
                    pull_feature(
                        to_features[item, f, low:high],
                        to_features[item, f, there],
                        distance,
                        features[item, f, low:high],
                        features[item, f, there],
                    )


def pull_level(
    gradient: Tensor, given: Sequence[Tensor], surface: Tensor, out: Tensor, total: Tensor, step: int
) -> tuple[Tensor, ...]:
    """The gradients of what was `given`: image, features, sharpness, own and importance."""
    match_threads()
    image, features, sharpness, own, importance = given
    pulled = [torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in given]
    to_image, to_features, to_sharpness, to_own, to_importance = (flat(tensor) for tensor in pulled)
    pull_images(
        to_image,
        to_features,
        to_sharpness,
        to_own,
        to_importance,
        flat(gradient),
        flat(image),
        flat(features),
        flat(sharpness),
        flat(own),
        flat(importance),
        flat(surface),
        flat(out),
        flat(total),
        surface.shape[-1],
        step,
    )
    return tuple(pulled)
