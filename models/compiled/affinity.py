"""models.affinity for the processor, with its gradients: every loop along a row is vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_parallel, match_threads

ZERO = np.float32(0)
TWO = np.float32(2)
LEAST_EXPONENT = np.float32(-40)
LARGEST_EXPONENT = np.float32(40)
LEAST_WEIGHT = np.float32(1e-30)
BLOCK_ROWS = 8  # that share one piece of scratch memory
STRIDE = 4  # features that are compared in one pass


@jit_in_any_order
def add_squares(
    distance: Any, a: Any, b: Any, c: Any, d: Any, to_a: Any, to_b: Any, to_c: Any, to_d: Any
) -> None:
    for x in range(distance.size):
        by_a = a[x] - to_a[x]
        by_b = b[x] - to_b[x]
        by_c = c[x] - to_c[x]
        by_d = d[x] - to_d[x]
        distance[x] += by_a * by_a + by_b * by_b + by_c * by_c + by_d * by_d


@jit_in_any_order
def measure(distance: Any, features: Any, y: Any, to: Any, low: Any, high: Any, dx: Any) -> None:
    """distance (n): |f_p - f_q|² of the pixels low to high of row y and those dx further in row `to`."""
    distance[:] = ZERO
    for f in range(0, features.shape[0], STRIDE):
        add_squares(
            distance,
            features[f, y, low:high],
            features[f + 1, y, low:high],
            features[f + 2, y, low:high],
            features[f + 3, y, low:high],
            features[f, to, low + dx : high + dx],
            features[f + 1, to, low + dx : high + dx],
            features[f + 2, to, low + dx : high + dx],
            features[f + 3, to, low + dx : high + dx],
        )


@jit_in_any_order
def weigh(weight: Any, distance: Any, sharpness: Any, importance: Any, surface: Any) -> None:
    for x in range(weight.size):
        exponent = importance[x] - sharpness[x] * distance[x]
        weight[x] = exp(min(max(exponent, LEAST_EXPONENT), LARGEST_EXPONENT)) * surface[x]


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
    y: Any,
    to: Any,
    low: Any,
    high: Any,
    dx: Any,
) -> None:
    """weight (n) of the taps dx pixels further in row `to`, for the pixels low to high of row y."""
    if to == y and dx == 0:
        weigh_own(weight, own[y], surface[y])
        return
    measure(distance, features, y, to, low, high, dx)
    there = slice(low + dx, high + dx)
    weigh(weight, distance, sharpness[y, low:high], importance[to, there], surface[to, there])


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
    step: int,
) -> None:
    """out (3, H, W) and the sums of weights, total (H, W), from image (3, H, W), features (F, H, W), others (H, W)."""
    height, width = total.shape
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        distances = np.empty(width, np.float32)
        weights = np.empty(width, np.float32)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            out[:, y] = ZERO
            total[y] = ZERO
            for tap in range(9):
                to = y + (tap // 3 - 1) * step
                dx = (tap % 3 - 1) * step
                low = max(0, -dx)
                high = min(width, width - dx)
                if to < 0 or to >= height or low >= high:
                    continue
                weight = weights[low:high]
                weigh_tap(
                    weight, distances[low:high], features, sharpness, own, importance, surface, y, to, low, high, dx
                )
                there = slice(low + dx, high + dx)
                add_weighted(
                    out[0, y, low:high],
                    out[1, y, low:high],
                    out[2, y, low:high],
                    total[y, low:high],
                    weight,
                    image[0, to, there],
                    image[1, to, there],
                    image[2, to, there],
                )
            for x in range(width):
                total[y, x] *= surface[y, x]
            normalise(out[0, y], out[1, y], out[2, y], total[y])


def filter_level(
    image: Tensor, features: Tensor, sharpness: Tensor, own: Tensor, importance: Tensor, surface: Tensor, step: int
) -> tuple[Tensor, Tensor]:
    """See models.affinity.affinity_level; the sums of weights as well, (B, 1, H, W), 0 off surfaces."""
    match_threads()
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    total = torch.empty_like(surface, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        planes = (array(plane[item, 0]) for plane in (sharpness, own, importance, surface))
        filter_image(
            out[item].numpy(), total[item, 0].numpy(), array(image[item]), array(features[item]), *planes, step
        )
    return out, total


# --- Gradients --------------------------------------------------------------------------------------------------------
#
# With g the gradient of the output over the sum of weights, the weight of q for p has the gradient g_p (image_q - out_p).


@jit_in_any_order
def pull_weights(
    pull: Any, weight: Any, red: Any, green: Any, blue: Any, dot: Any, to_red: Any, to_green: Any, to_blue: Any
) -> None:
    """pull (n): the gradients of the weights, times the weights."""
    for x in range(pull.size):
        pull[x] = weight[x] * (red[x] * to_red[x] + green[x] * to_green[x] + blue[x] * to_blue[x] - dot[x])


@jit_in_any_order
def add_product(total: Any, a: Any, b: Any) -> None:
    for x in range(total.size):
        total[x] += a[x] * b[x]


@jit_in_any_order
def add(total: Any, a: Any) -> None:
    for x in range(total.size):
        total[x] += a[x]


@jit_in_any_order
def pull_exponent(to_sharpness: Any, pull: Any, distance: Any, sharpness: Any, importance: Any) -> None:
    """pull (n) becomes the gradient of the exponent; then, for features, -2 sharpness times that is left in distance."""
    for x in range(pull.size):
        inside = importance[x] - sharpness[x] * distance[x] >= LEAST_EXPONENT
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
    step: int,
) -> None:
    """The gradients of what affinity_level takes, added to `to_...`; all (B, ., H, W), items in parallel."""
    batch, colours, height, width = image.shape
    for item in numba.prange(batch):
        distances = np.empty(width, np.float32)
        weights = np.empty(width, np.float32)
        pulls = np.empty(width, np.float32)
        dot = np.empty(width, np.float32)
        g = np.empty((colours, width), np.float32)
        for y in range(height):
            dot[:] = ZERO
            for c in range(colours):
                scale_gradient(g[c], dot, gradient[item, c, y], out[item, c, y], total[item, 0, y])
            for tap in range(9):
                to = y + (tap // 3 - 1) * step
                dx = (tap % 3 - 1) * step
                low = max(0, -dx)
                high = min(width, width - dx)
                if to < 0 or to >= height or low >= high:
                    continue
                there = slice(low + dx, high + dx)
                weight = weights[low:high]
                distance = distances[low:high]
                pull = pulls[low:high]
                weigh_tap(
                    weight,
                    distance,
                    features[item],
                    sharpness[item, 0],
                    own[item, 0],
                    importance[item, 0],
                    surface[item, 0],
                    y,
                    to,
                    low,
                    high,
                    dx,
                )
                pull_weights(
                    pull,
                    weight,
                    g[0, low:high],
                    g[1, low:high],
                    g[2, low:high],
                    dot[low:high],
                    image[item, 0, to, there],
                    image[item, 1, to, there],
                    image[item, 2, to, there],
                )
                for c in range(colours):
                    add_product(to_image[item, c, to, there], weight, g[c, low:high])
                if to == y and dx == 0:
                    add(to_own[item, 0, y], pull)
                    continue
                pull_exponent(
                    to_sharpness[item, 0, y, low:high],
                    pull,
                    distance,
                    sharpness[item, 0, y, low:high],
                    importance[item, 0, to, there],
                )
                add(to_importance[item, 0, to, there], pull)
                for f in range(features.shape[1]):
                    pull_feature(
                        to_features[item, f, y, low:high],
                        to_features[item, f, to, there],
                        distance,
                        features[item, f, y, low:high],
                        features[item, f, to, there],
                    )


def pull_level(
    gradient: Tensor,
    image: Tensor,
    features: Tensor,
    sharpness: Tensor,
    own: Tensor,
    importance: Tensor,
    surface: Tensor,
    out: Tensor,
    total: Tensor,
    step: int,
) -> tuple[Tensor, ...]:
    """The gradients of image, features, sharpness, own and importance."""
    match_threads()
    given = (image, features, sharpness, own, importance)
    pulled = tuple(torch.zeros_like(tensor, memory_format=torch.contiguous_format) for tensor in given)
    known = (array(tensor) for tensor in (gradient, *given, surface, out, total))
    pull_images(*(tensor.numpy() for tensor in pulled), *known, step)
    return pulled
