"""The layout of `one`'s network, and its kernels: inputs and head outputs, each in one pass over memory.

Networks take and give pixels with their channels side by side; all other loops here run along rows of one channel.
"""

import itertools
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numba
import numpy as np
import torch
from torch import Tensor, nn

from datasets.frame import Frame
from models.compiled.affinity import four
from models.compiled.arrays import RGB, Image, Index, Matrix, Row, Rows, Scalar, f32
from models.compiled.exponential import MIN_EXPONENT, exp, log
from models.compiled.jit import array, jit_in_any_order, jit_inlined_in_any_order, jit_parallel, run_items
from models.compiled.lines import copy_line, scale_depth, scale_line, transpose, triple
from models.history.running_scale import RunningScale

if TYPE_CHECKING:
    from models.networks.one import PixelInputs

LATENT = 6  # channels carried beside images, in [-1, 1]
FEATURES = 8  # that pixels are compared by
# px between taps of each filter level: the last ones smooth the first ones' pattern
TAP_SPACINGS = (32, 16, 8, 4, 2, 1)
MAX_EXPOSED = 1e13  # exposed irradiance; what is brighter looks alike to the network
MAX_LOGIT = 10.0  # of the weights of taps
SIDE_MULTIPLE = 8  # of the sides of the network's images
MIN_LENGTH = 1e-3  # samples of a history, to divide by


class NetworkInput(NamedTuple):
    """A row of ONE_INPUTS."""

    name: str
    channels: int
    # "log exposed": log(1 + exposure · irradiance); "per pixel": models.networks.one.per_pixel_inputs; "surface": of
    # the G-buffer
    transform: Literal["log exposed", "per pixel", "surface"]
    without_history: str | None = None  # the input whose irradiance stands in where there is no history


# The inputs of the network, in order. PyTorch, kernel and export all take their order from here.
ONE_INPUTS = (
    NetworkInput("noisy", 3, "log exposed"),
    NetworkInput("mean_3x3", 3, "log exposed"),
    NetworkInput("mean_9x9", 3, "log exposed"),
    NetworkInput("output", 3, "log exposed", without_history="mean_9x9"),
    NetworkInput("accumulated", 3, "log exposed", without_history="noisy"),
    NetworkInput("deviation", 1, "per pixel"),
    NetworkInput("1/samples", 1, "per pixel"),
    NetworkInput("1/(length + samples)", 1, "per pixel"),
    NetworkInput("has_history", 1, "per pixel"),
    NetworkInput("latent", LATENT, "per pixel"),
    NetworkInput("albedo", 3, "surface"),
    NetworkInput("view_normal", 3, "surface"),
    NetworkInput("depth", 1, "surface"),
    NetworkInput("roughness", 1, "surface"),
)
INPUT_CHANNELS = {row.name: row.channels for row in ONE_INPUTS}


def head_channels(levels: int) -> dict[str, int]:
    """The outputs of the network in order, and how many channels each has, for a filter of so many levels."""
    per_level = {"sharpness": levels, "centre": levels, "importance": levels}
    return {"features": FEATURES, **per_level, "alpha": 2, "latent": LATENT}


def filter_levels(outputs: int) -> int:
    """How many levels of the filter a network of so many outputs sets."""
    return (outputs - sum(head_channels(0).values())) // 3


# The first channel of each input, in the order of ONE_INPUTS: constants, as Numba needs them.
FIRST_CHANNELS = itertools.accumulate([row.channels for row in ONE_INPUTS[:-1]], initial=0)
NOISY, MEAN_3X3, MEAN_9X9, OUTPUT, ACCUMULATED, DEVIATION, NEWEST, OLDEST, HAS_HISTORY, *OTHERS = FIRST_CHANNELS
LATENT_INPUT, ALBEDO, VIEW_NORMAL, DEPTH, ROUGHNESS = OTHERS
CHUNK = 512
ROOM = CHUNK + 16  # for a line: lines that begin a power of two apart would fall on the same set of the cache
AT_ONCE = 4  # inputs of a layer that two outputs are summed from in one pass


def padded(layer: nn.Linear) -> tuple[Matrix, Row]:
    """Weight (outputs, inputs) and bias (outputs), with 0 for an even number of outputs and AT_ONCE inputs or more."""
    outputs, inputs = layer.weight.shape
    bias = np.zeros(outputs, np.float32) if layer.bias is None else array(layer.bias)
    weight = np.pad(array(layer.weight), ((0, outputs % 2), (0, -inputs % AT_ONCE)))
    return weight, np.pad(bias, (0, outputs % 2))


@jit_inlined_in_any_order
def add_products(first: Row, second: Row, inputs: tuple[Row, Row, Row, Row], w: Row, v: Row) -> None:
    """Add w · inputs to the first row and v · inputs to the second."""
    a, b, c, d = inputs
    wa, wb, wc, wd = w[0], w[1], w[2], w[3]
    va, vb, vc, vd = v[0], v[1], v[2], v[3]
    for x in range(first.size):
        first[x] += wa * a[x] + wb * b[x] + wc * c[x] + wd * d[x]
        second[x] += va * a[x] + vb * b[x] + vc * c[x] + vd * d[x]


@jit_in_any_order
def add_layer(lines: Rows, inputs: Rows, weight: Matrix, n: int) -> None:
    """lines (outputs, n) += weight (outputs, inputs) · inputs (inputs, n), for the first n pixels."""
    for o in range(0, weight.shape[0], 2):
        for i in range(0, weight.shape[1], AT_ONCE):
            w, v = weight[o, i : i + AT_ONCE], weight[o + 1, i : i + AT_ONCE]
            add_products(lines[o, :n], lines[o + 1, :n], four(inputs, i, 0, n), w, v)


@jit_in_any_order
def log_exposed(line: Row, image: Row, gain: Scalar) -> None:
    """ln(1 + gain image), in the range of exposed irradiance."""
    for x in range(line.size):
        line[x] = log(f32(1) + min(max(image[x], f32(0)) * gain, f32(MAX_EXPOSED)))


@jit_in_any_order
def reciprocal_length(line: Row, length: Row, has_history: Row, samples: Scalar) -> None:
    for x in range(line.size):
        line[x] = f32(1) / (length[x] * has_history[x] + samples)


@jit_in_any_order
def dot(line: Row, normal: RGB, axis: Row) -> None:
    nx, ny, nz = normal
    ax, ay, az = axis[0], axis[1], axis[2]
    for x in range(line.size):
        line[x] = ax * nx[x] + ay * ny[x] + az * nz[x]


@jit_in_any_order
def log_exposed_history(line: Row, has_history: Row, past: Row, other: Row, gain: Scalar) -> None:
    for x in range(line.size):
        value = past[x] if has_history[x] > f32(0) else other[x]
        line[x] = log(f32(1) + min(max(value, f32(0)) * gain, f32(MAX_EXPOSED)))


@jit_in_any_order
def relu(line: Row, sums: Row) -> None:
    for x in range(line.size):
        line[x] = max(sums[x], f32(0))


# Of one item of models.networks.one.PixelInputs: noisy, mean_3x3, mean_9x9, deviation, history, has_history.
PixelArrays: TypeAlias = tuple[Image, ...]
# Of one item: albedo, normal, depth, roughness; exposure times the frame's gain (3), samples (1), to_view (3, 3), depth
# scale (1).
SurfaceArrays: TypeAlias = tuple[Image, Image, Image, Image, Row, Row, Matrix, Row]


@jit_in_any_order
def fill_lines(lines: Rows, pixels: PixelArrays, surfaces: SurfaceArrays, y: Index, x: Index, n: int) -> None:
    """The network's inputs (C, ·) of n pixels of a row from x on, in the order of ONE_INPUTS."""
    row = slice(x, x + n)
    noisy, mean_3x3, mean_9x9, deviation, history, has_history = pixels
    valid = has_history[0, y, row]
    albedo, normal, depth, roughness, gain, samples, to_view, depth_scale = surfaces
    for c in range(3):
        log_exposed(lines[NOISY + c, :n], noisy[c, y, row], gain[c])
        log_exposed(lines[MEAN_3X3 + c, :n], mean_3x3[c, y, row], gain[c])
        log_exposed(lines[MEAN_9X9 + c, :n], mean_9x9[c, y, row], gain[c])
        log_exposed_history(lines[OUTPUT + c, :n], valid, history[c, y, row], mean_9x9[c, y, row], gain[c])
        log_exposed_history(lines[ACCUMULATED + c, :n], valid, history[3 + c, y, row], noisy[c, y, row], gain[c])
    log_exposed(lines[DEVIATION, :n], deviation[0, y, row], f32(1))
    lines[NEWEST, :n] = f32(1) / samples[0]
    reciprocal_length(lines[OLDEST, :n], history[6, y, row], valid, samples[0])
    copy_line(lines[HAS_HISTORY, :n], valid)
    for c in range(LATENT):
        copy_line(lines[LATENT_INPUT + c, :n], history[7 + c, y, row])
        scale_line(lines[LATENT_INPUT + c, :n], valid)
    for c in range(3):
        copy_line(lines[ALBEDO + c, :n], albedo[c, y, row])
        dot(lines[VIEW_NORMAL + c, :n], triple(normal, y, x, x + n), to_view[c])
    scale_depth(lines[DEPTH, :n], depth[0, y, row], depth_scale[0])
    copy_line(lines[ROUGHNESS, :n], roughness[0, y, row])


@jit_in_any_order
def write_patches(patches: Matrix, y: Index, x: Index, lines: Rows, n: int) -> None:
    """Pixels x to x + n of row y of patches (H / 2, W / 2, 2, 2, C) from lines (C, ·)."""
    for i in range(n):
        for c in range(patches.shape[4]):
            patches[y // 2, (x + i) // 2, y % 2, (x + i) % 2, c] = lines[c, i]


@jit_parallel
def write_inputs(
    patches: Matrix, hidden: Image, pixels: PixelArrays, surfaces: SurfaceArrays, weight: Matrix, bias: Row
) -> None:
    """Patches (H / 2, W / 2, 2, 2, C), borders repeated, and hidden (c, h, w): ReLU of the layer of each pixel."""
    _, height, width = hidden.shape
    for row in numba.prange(2 * patches.shape[0]):
        bottom = np.int64(row)
        y = min(bottom, height - 1)
        lines = np.zeros((weight.shape[1], ROOM), np.float32)
        sums = np.empty((weight.shape[0], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            fill_lines(lines, pixels, surfaces, y, x, n)
            write_patches(patches, bottom, x, lines, n)
            if bottom > y:
                continue
            for c in range(sums.shape[0]):
                sums[c, :n][:] = bias[c]
            add_layer(sums, lines, weight, n)
            for c in range(hidden.shape[0]):
                relu(hidden[c, y, x : x + n], sums[c, :n])
        last = lines[:, (width - 1) % CHUNK :]
        for x in range(width, 2 * patches.shape[1]):
            write_patches(patches, bottom, x, last, 1)


def network_inputs(
    frame: Frame, scale: RunningScale, inputs: "PixelInputs", hidden: nn.Linear
) -> tuple[Tensor, Tensor]:
    """See models.networks.one.network_inputs; the channels of patches come last in memory."""
    batch, height, width = frame.shape
    rows, columns = (SIDE_MULTIPLE * -(-size // SIDE_MULTIPLE) // 2 for size in (height, width))
    out = torch.empty(batch, rows, columns, 2, 2, hidden.in_features)
    sums = torch.empty(batch, hidden.out_features, height, width)
    gains = (scale.exposure() * frame.gain).flatten(1)
    numbers = gains, frame.samples.flatten(1), frame.to_view, scale.log_depth.value.exp()[:, None]
    surfaces = frame.albedo, frame.normal, frame.depth, frame.roughness, *numbers
    run_items(write_inputs, [out, sums], [inputs, surfaces], *padded(hidden))
    return out.flatten(3).permute(0, 3, 1, 2), sums


# --- Head outputs -----------------------------------------------------------------------------------------------------


@jit_in_any_order
def softplus(line: Row, head: Row) -> None:
    for x in range(line.size):
        line[x] = max(head[x], f32(0)) + log(f32(1) + exp(max(-abs(head[x]), f32(MIN_EXPONENT))))


@jit_in_any_order
def clamp_logit(line: Row, head: Row) -> None:
    for x in range(line.size):
        line[x] = min(max(head[x], -f32(MAX_LOGIT)), f32(MAX_LOGIT))


@jit_in_any_order
def tanh(line: Row, head: Row) -> None:
    for x in range(line.size):
        shrunk = exp(max(-f32(2) * abs(head[x]), f32(MIN_EXPONENT)))
        size = (f32(1) - shrunk) / (f32(1) + shrunk)
        line[x] = size if head[x] > f32(0) else -size


@jit_in_any_order
def sigmoid(line: Row, head: Row, has_history: Row) -> None:
    """1 / (1 + exp(-head)), or 1 without history."""
    for x in range(line.size):
        against = exp(min(max(-head[x], f32(MIN_EXPONENT)), -f32(MIN_EXPONENT)))
        line[x] = f32(1) / (f32(1) + against) if has_history[x] > f32(0) else f32(1)


@jit_in_any_order
def accumulation_alpha(line: Row, head: Row, has_history: Row, length: Row, samples: Scalar) -> None:
    """σ(head - ln(length / samples)), or 1 without history: for head = 0 the plain mean of all samples."""
    for x in range(line.size):
        past = max(length[x], f32(MIN_LENGTH)) / samples
        against = past * exp(min(max(-head[x], f32(MIN_EXPONENT)), -f32(MIN_EXPONENT)))
        line[x] = f32(1) / (f32(1) + against) if has_history[x] > f32(0) else f32(1)


@jit_in_any_order
def effective_length(length: Row, past: Row, alpha: Row, samples: Scalar) -> None:
    """1 / (α² / samples + (1 - α)² / past)."""
    for x in range(length.size):
        kept = f32(1) - alpha[x]
        length[x] = f32(1) / (alpha[x] * alpha[x] / samples + kept * kept / max(past[x], f32(MIN_LENGTH)))


@jit_in_any_order
def lerp(line: Row, past: Row, new: Row, alpha: Row) -> None:
    for x in range(line.size):
        line[x] = alpha[x] * new[x] + (f32(1) - alpha[x]) * past[x]


# Of one item of models.networks.one.Decoded: features, sharpness, centre and importance in one, alpha, latent,
# accumulated, length.
DecodedArrays: TypeAlias = tuple[Image, ...]


@jit_in_any_order
def decode_lines(
    decoded: DecodedArrays, lines: Rows, inputs: PixelArrays, samples: Scalar, y: Index, x: Index, n: int
) -> None:
    """Write n pixels of a row from x on, whose head outputs are lines (C, ·) in the order of head_channels."""
    features, sharpness, logits, alphas, latent, accumulated, length = decoded
    noisy, _, _, _, history, has_history = inputs
    levels = sharpness.shape[0]
    row = slice(x, x + n)
    k = FEATURES + 3 * levels
    for c in range(FEATURES):
        copy_line(features[c, y, row], lines[c, :n])
    for c in range(levels):
        softplus(sharpness[c, y, row], lines[FEATURES + c, :n])
    for c in range(2 * levels):
        clamp_logit(logits[c, y, row], lines[FEATURES + levels + c, :n])
    valid, past_length, alpha = has_history[0, y, row], history[6, y, row], alphas[0, y, row]
    accumulation_alpha(alpha, lines[k, :n], valid, past_length, samples)
    sigmoid(alphas[1, y, row], lines[k + 1, :n], valid)
    for c in range(LATENT):
        tanh(latent[c, y, row], lines[k + 2 + c, :n])
    effective_length(length[0, y, row], past_length, alpha, samples)
    for c in range(3):
        lerp(accumulated[c, y, row], history[3 + c, y, row], noisy[c, y, row], alpha)


@jit_parallel
def decode_images(
    decoded: DecodedArrays, head: Image, hidden: Image, weight: Matrix, inputs: PixelArrays, samples: Scalar
) -> None:
    """Decode the U-Net's outputs, head (H, W, C), plus weight (C, c) times hidden (c, H, W)."""
    height, width, _ = head.shape
    for row in numba.prange(height):
        y = np.int64(row)
        lines = np.empty((weight.shape[0], ROOM), np.float32)
        columns = np.empty((weight.shape[1], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            transpose(lines, head[y, x : x + n])
            for c in range(hidden.shape[0]):
                copy_line(columns[c, :n], hidden[c, y, x : x + n])
            add_layer(lines, columns, weight, n)
            decode_lines(decoded, lines, inputs, samples, y, x, n)


def decode_head(
    head: Tensor, hidden: Tensor, last: nn.Linear, inputs: "PixelInputs", samples: Tensor
) -> tuple[Tensor, ...]:
    batch, _, height, width = head.shape
    levels = filter_levels(head.shape[1])
    counts = (FEATURES, levels, 2 * levels, 2, LATENT, 3, 1)
    out = [torch.empty(batch, channels, height, width) for channels in counts]
    for item in range(batch):
        decoded = tuple(each[item].numpy() for each in out)
        pixels = tuple(array(image[item]) for image in inputs)
        head_and_hidden = head[item].movedim(0, -1).numpy(), array(hidden[item])
        decode_images(decoded, *head_and_hidden, padded(last)[0], pixels, np.float32(samples[item].item()))
    return out[0], out[1], *out[2].split(levels, dim=1), *out[3:]
