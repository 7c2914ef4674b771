"""The layout of `one`'s network, and its kernels: inputs and head outputs, each in one pass over memory.

Networks take and give pixels with their channels side by side; all other loops here run along rows of one channel.
"""

import itertools
from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor, nn

from datasets.frame import Frame
from models.compiled.affinity import four
from models.compiled.arrays import RGB, Image, Index, Matrix, Row, Rows, Scalar, f32
from models.compiled.exponential import MIN_EXPONENT, exp, log
from models.compiled.jit import array, jit_in_any_order, jit_inlined_in_any_order, jit_parallel
from models.compiled.lines import copy_line, luminance, scale_depth, scale_line, transpose, triple
from models.history.running_scale import RunningScale

if TYPE_CHECKING:
    from models.networks.one import PixelInputs

LATENT = 6  # channels carried beside images, in [-1, 1]
FEATURES = 8  # that pixels are compared by
# Passes of the filter: levels, of which each has weights of its own, and px between taps. The last ones smooth the
# first ones' pattern.
FILTER_PASSES = ((0, 32), (1, 16), (2, 8), (3, 4), (4, 2), (5, 1))
SPREADING_PASSES = ((0, 64), (1, 16))  # those of outliers before them
GUIDED_PASSES = ((0, 64), (1, 16), (3, 4), (5, 1))  # those after them, guided by luminance
GUIDANCE = 30.0  # weight of squared differences of log luminance beside those of features, for each sample
DARKEST = 0.01  # exposed luminance: what is darker looks alike to guided levels
OUTLIER = 8.0  # times the mean over 9 x 9 pixels: what is brighter is spread
MAX_EXPOSED = 1e13  # exposed irradiance; what is brighter looks alike to the network
MAX_LOGIT = 10.0  # of the weights of taps
SIDE_MULTIPLE = 8  # of the sides of the network's images
MIN_LENGTH = 1e-3  # samples of a history, to divide by


# The inputs of the network in order, and how many channels each has: see models.networks.one.input_channels.
INPUT_CHANNELS = {
    "noisy": 3,
    "mean_3x3": 3,
    "mean_9x9": 3,
    "output": 3,
    "accumulated": 3,
    "deviation": 1,
    "1/samples": 1,
    "1/(length + samples)": 1,
    "has_history": 1,
    "latent": LATENT,
    "albedo": 3,
    "view_normal": 3,
    "depth": 1,
    "roughness": 1,
}


# The outputs of the network in order, and how many channels each has.
LEVELS = len(FILTER_PASSES)
HEAD_CHANNELS = {
    "features": FEATURES,
    "sharpness": LEVELS,
    "centre": LEVELS,
    "importance": LEVELS,
    "alpha": 2,
    "latent": LATENT,
}

# The first channel of each input, in the order of INPUT_CHANNELS: constants, as Numba needs them.
FIRST_CHANNELS = itertools.accumulate([*INPUT_CHANNELS.values()][:-1], initial=0)
NOISY, MEAN_3X3, MEAN_9X9, OUTPUT, ACCUMULATED, DEVIATION, NEWEST, OLDEST, HAS_HISTORY, *OTHERS = FIRST_CHANNELS
LATENT_INPUT, ALBEDO, VIEW_NORMAL, DEPTH, ROUGHNESS = OTHERS
CHUNK = 512
ROOM = CHUNK + 16  # for a line: lines that begin a power of two apart would fall on the same set of the cache
AT_ONCE = 4  # inputs of a layer that two outputs are summed from in one pass


class LinearLayer(NamedTuple):
    """A linear layer, padded to an even number of outputs and a multiple of AT_ONCE inputs."""

    weight: Matrix  # (outputs, inputs)
    bias: Row  # (outputs)

    @staticmethod
    def of(layer: nn.Linear) -> "LinearLayer":
        outputs, inputs = layer.weight.shape
        bias = np.zeros(outputs, np.float32) if layer.bias is None else array(layer.bias)
        weight = np.pad(array(layer.weight), ((0, outputs % 2), (0, -inputs % AT_ONCE)))
        return LinearLayer(weight, np.pad(bias, (0, outputs % 2)))


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


class PixelArrays(NamedTuple):
    """models.networks.one.PixelInputs of one item."""

    noisy: Image
    mean_3x3: Image
    mean_9x9: Image
    deviation: Image
    history: Image
    has_history: Image


class SurfaceArrays(NamedTuple):
    """What else the network's inputs of one item are computed from."""

    albedo: Image
    normal: Image
    depth: Image
    roughness: Image
    gain: Row  # (3): exposure times the frame's gain
    samples: Scalar
    to_view: Matrix  # (3, 3)
    depth_scale: Scalar


@jit_in_any_order
def fill_lines(lines: Rows, pixels: PixelArrays, surfaces: SurfaceArrays, y: Index, x: Index, n: int) -> None:
    """The network's inputs (C, ·) of n pixels of a row from x on, in the order of INPUT_CHANNELS."""
    row = slice(x, x + n)
    noisy, _, mean_9x9, _, history, _ = pixels
    valid = pixels.has_history[0, y, row]
    for c in range(3):
        gain = surfaces.gain[c]
        log_exposed(lines[NOISY + c, :n], noisy[c, y, row], gain)
        log_exposed(lines[MEAN_3X3 + c, :n], pixels.mean_3x3[c, y, row], gain)
        log_exposed(lines[MEAN_9X9 + c, :n], mean_9x9[c, y, row], gain)
        log_exposed_history(lines[OUTPUT + c, :n], valid, history[c, y, row], mean_9x9[c, y, row], gain)
        log_exposed_history(lines[ACCUMULATED + c, :n], valid, history[3 + c, y, row], noisy[c, y, row], gain)
    log_exposed(lines[DEVIATION, :n], pixels.deviation[0, y, row], f32(1))
    lines[NEWEST, :n] = f32(1) / surfaces.samples
    reciprocal_length(lines[OLDEST, :n], history[6, y, row], valid, surfaces.samples)
    copy_line(lines[HAS_HISTORY, :n], valid)
    for c in range(LATENT):
        copy_line(lines[LATENT_INPUT + c, :n], history[7 + c, y, row])
        scale_line(lines[LATENT_INPUT + c, :n], valid)
    normal = triple(surfaces.normal, y, x, x + n)
    for c in range(3):
        copy_line(lines[ALBEDO + c, :n], surfaces.albedo[c, y, row])
        dot(lines[VIEW_NORMAL + c, :n], normal, surfaces.to_view[c])
    scale_depth(lines[DEPTH, :n], surfaces.depth[0, y, row], surfaces.depth_scale)
    copy_line(lines[ROUGHNESS, :n], surfaces.roughness[0, y, row])


@jit_in_any_order
def write_patches(patches: Matrix, y: Index, x: Index, lines: Rows, n: int) -> None:
    """Pixels x to x + n of row y of patches (H / 2, W / 2, 2, 2, C) from lines (C, ·)."""
    for i in range(n):
        for c in range(patches.shape[4]):
            patches[y // 2, (x + i) // 2, y % 2, (x + i) % 2, c] = lines[c, i]


@jit_parallel
def write_inputs(
    patches: Matrix, hidden: Image, pixels: PixelArrays, surfaces: SurfaceArrays, layer: LinearLayer
) -> None:
    """Patches (H / 2, W / 2, 2, 2, C), borders repeated, and hidden (c, h, w): ReLU of the layer of each pixel."""
    _, height, width = pixels.noisy.shape
    for row in numba.prange(2 * patches.shape[0]):
        bottom = np.int64(row)
        y = min(bottom, height - 1)
        lines = np.zeros((layer.weight.shape[1], ROOM), np.float32)
        sums = np.empty((layer.weight.shape[0], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            fill_lines(lines, pixels, surfaces, y, x, n)
            write_patches(patches, bottom, x, lines, n)
            if bottom > y:
                continue
            for c in range(sums.shape[0]):
                sums[c, :n][:] = layer.bias[c]
            add_layer(sums, lines, layer.weight, n)
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
    gains = array((scale.exposure() * frame.gain).flatten(1))
    depth_scales = array(scale.log_depth.value.exp())
    to_view = array(frame.to_view)
    for item in range(batch):
        pixels = PixelArrays(*(array(image[item]) for image in inputs))
        albedo, normal = array(frame.albedo[item]), array(frame.normal[item])
        depth, roughness = array(frame.depth[item]), array(frame.roughness[item])
        numbers = gains[item], np.float32(frame.samples[item].item()), to_view[item], depth_scales[item]
        surfaces = SurfaceArrays(albedo, normal, depth, roughness, *numbers)
        write_inputs(out[item].numpy(), sums[item].numpy(), pixels, surfaces, LinearLayer.of(hidden))
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


@jit_in_any_order
def outlier_share(share: Row, colour: RGB, mean: RGB) -> None:
    """The share of colours' luminance that is beyond OUTLIER times that of their mean."""
    red, green, blue = colour
    mean_red, mean_green, mean_blue = mean
    for x in range(share.size):
        bright = luminance(red[x], green[x], blue[x])
        most = f32(OUTLIER) * luminance(mean_red[x], mean_green[x], mean_blue[x])
        share[x] = (bright - most) / bright if bright > most else f32(0)


class DecodedImages(NamedTuple):
    """models.networks.one.Decoded of one image."""

    features: Image
    sharpness: Image
    logits: Image  # centre and importance
    alpha: Image
    latent: Image
    accumulated: Image
    length: Image
    outliers: Image


@jit_in_any_order
def decode_lines(
    decoded: DecodedImages, lines: Rows, inputs: PixelArrays, samples: Scalar, y: Index, x: Index, n: int
) -> None:
    """Write n pixels of a row from x on, whose head outputs are lines (C, ·) in the order of HEAD_CHANNELS."""
    k = FEATURES + 3 * LEVELS
    for c in range(FEATURES):
        copy_line(decoded.features[c, y, x : x + n], lines[c, :n])
    for c in range(LEVELS):
        softplus(decoded.sharpness[c, y, x : x + n], lines[FEATURES + c, :n])
    for c in range(2 * LEVELS):
        clamp_logit(decoded.logits[c, y, x : x + n], lines[FEATURES + LEVELS + c, :n])
    valid = inputs.has_history[0, y, x : x + n]
    length = inputs.history[6, y, x : x + n]
    alpha = decoded.alpha[0, y, x : x + n]
    accumulation_alpha(alpha, lines[k, :n], valid, length, samples)
    sigmoid(decoded.alpha[1, y, x : x + n], lines[k + 1, :n], valid)
    for c in range(LATENT):
        tanh(decoded.latent[c, y, x : x + n], lines[k + 2 + c, :n])
    effective_length(decoded.length[0, y, x : x + n], length, alpha, samples)
    for c in range(3):
        past, noisy = inputs.history[3 + c, y, x : x + n], inputs.noisy[c, y, x : x + n]
        lerp(decoded.accumulated[c, y, x : x + n], past, noisy, alpha)
    colour, mean = triple(decoded.accumulated, y, x, x + n), triple(inputs.mean_9x9, y, x, x + n)
    outlier_share(decoded.outliers[0, y, x : x + n], colour, mean)


@jit_parallel
def decode_images(
    decoded: DecodedImages, head: Image, hidden: Image, layer: LinearLayer, inputs: PixelArrays, samples: Scalar
) -> None:
    """Decode the U-Net's outputs, head (H, W, C), plus the layer of hidden (c, H, W)."""
    height, width, _ = head.shape
    for row in numba.prange(height):
        y = np.int64(row)
        lines = np.empty((layer.weight.shape[0], ROOM), np.float32)
        columns = np.empty((layer.weight.shape[1], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            transpose(lines, head[y, x : x + n])
            for c in range(hidden.shape[0]):
                copy_line(columns[c, :n], hidden[c, y, x : x + n])
            add_layer(lines, columns, layer.weight, n)
            decode_lines(decoded, lines, inputs, samples, y, x, n)


def decode_head(
    head: Tensor, hidden: Tensor, last: nn.Linear, inputs: "PixelInputs", samples: Tensor
) -> tuple[Tensor, ...]:
    batch, _, height, width = head.shape
    counts = (FEATURES, LEVELS, 2 * LEVELS, 2, LATENT, 3, 1, 1)
    out = [torch.empty(batch, channels, height, width) for channels in counts]
    for item in range(batch):
        decoded = DecodedImages(*(each[item].numpy() for each in out))
        pixels = PixelArrays(*(array(image[item]) for image in inputs))
        head_and_hidden = head[item].movedim(0, -1).numpy(), array(hidden[item])
        decode_images(decoded, *head_and_hidden, LinearLayer.of(last), pixels, np.float32(samples[item].item()))
    return out[0], out[1], *out[2].split(LEVELS, dim=1), *out[3:]
