"""What `one` does around its network, for the processor: its inputs and what it says, each in one pass over memory.

Networks take and give pixels with their channels side by side; all other loops here run along lines of one channel.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor, nn

from datasets.frame import Frame
from models import parameters
from models.compiled.exponential import MIN_EXPONENT, exp, log
from models.compiled.jit import array, jit_in_any_order, jit_inlined_in_any_order, jit_parallel
from models.compiled.lines import copy_line, fill_line, scale_depth, scale_line
from models.history.running_scale import RunningScale

if TYPE_CHECKING:
    from models.networks.one import Evidence

ONE = np.float32(1)
ZERO = np.float32(0)
TWO = np.float32(2)
LEAST_EXPONENT = np.float32(MIN_EXPONENT)
LARGEST_LOGIT = np.float32(parameters.LARGEST_LOGIT)
FEWEST_SAMPLES = np.float32(parameters.FEWEST_SAMPLES)
BRIGHTEST = np.float32(parameters.BRIGHTEST)
CHUNK = 512
ROOM = CHUNK + 16  # for a line: lines that begin a power of two apart would fall on the same set of the cache
AT_ONCE = 4  # inputs of a layer that two outputs are summed from in one pass


class Layer(NamedTuple):
    """A linear layer as kernels take it: rows for an even number of outputs, columns for AT_ONCE inputs each."""

    weight: Any  # (outputs, inputs)
    bias: Any  # (outputs)

    @staticmethod
    def of(layer: nn.Linear) -> "Layer":
        weight = array(layer.weight)
        outputs, inputs = weight.shape
        rows, columns = outputs + outputs % 2, -(-inputs // AT_ONCE) * AT_ONCE
        padded = np.zeros((rows, columns), np.float32)
        padded[:outputs, :inputs] = weight
        bias = np.zeros(rows, np.float32)
        bias[:outputs] = 0 if layer.bias is None else array(layer.bias)
        return Layer(padded, bias)


@jit_inlined_in_any_order
def add_products(one: Any, other: Any, a: Any, b: Any, c: Any, d: Any, to_one: Any, to_other: Any) -> None:
    one_a, one_b, one_c, one_d = to_one[0], to_one[1], to_one[2], to_one[3]
    other_a, other_b, other_c, other_d = to_other[0], to_other[1], to_other[2], to_other[3]
    for x in range(one.size):
        one[x] += one_a * a[x] + one_b * b[x] + one_c * c[x] + one_d * d[x]
        other[x] += other_a * a[x] + other_b * b[x] + other_c * c[x] + other_d * d[x]


@jit_in_any_order
def add_layer(lines: Any, inputs: Any, weight: Any, n: int) -> None:
    """Add to the first n of each of lines (outputs, ·) what a layer makes of inputs (inputs, ·)."""
    for o in range(0, weight.shape[0], 2):
        for i in range(0, weight.shape[1], AT_ONCE):
            add_products(
                lines[o, :n],
                lines[o + 1, :n],
                inputs[i, :n],
                inputs[i + 1, :n],
                inputs[i + 2, :n],
                inputs[i + 3, :n],
                weight[o, i : i + AT_ONCE],
                weight[o + 1, i : i + AT_ONCE],
            )


@jit_in_any_order
def compress(line: Any, image: Any, gain: Any) -> None:
    for x in range(line.size):
        line[x] = log(ONE + min(max(image[x], ZERO) * gain, BRIGHTEST))


@jit_in_any_order
def log_of_one_more(line: Any, image: Any) -> None:
    for x in range(line.size):
        line[x] = log(ONE + image[x])


@jit_in_any_order
def one_over(line: Any, length: Any, found: Any, samples: Any) -> None:
    for x in range(line.size):
        line[x] = ONE / (length[x] * found[x] + samples)


@jit_in_any_order
def turn(line: Any, nx: Any, ny: Any, nz: Any, axis: Any) -> None:
    ax, ay, az = axis[0], axis[1], axis[2]
    for x in range(line.size):
        line[x] = ax * nx[x] + ay * ny[x] + az * nz[x]


@jit_in_any_order
def compress_past(line: Any, found: Any, past: Any, other: Any, gain: Any) -> None:
    for x in range(line.size):
        known = past[x] if found[x] > ZERO else other[x]
        line[x] = log(ONE + min(max(known, ZERO) * gain, BRIGHTEST))


@jit_in_any_order
def activate(line: Any, sums: Any) -> None:
    for x in range(line.size):
        line[x] = max(sums[x], ZERO)


class Seen(NamedTuple):
    """What the network's inputs are made of: images (c, H, W) and (H, W), and numbers."""

    noisy: Any
    near: Any
    around: Any
    deviation: Any
    past: Any
    found: Any
    albedo: Any
    normal: Any
    depth: Any
    roughness: Any
    gain: Any  # (3)
    samples: Any
    to_view: Any  # (3, 3)
    depth_scale: Any


@jit_in_any_order
def fill_lines(lines: Any, seen: Seen, y: Any, x: Any, n: int) -> None:
    """The network's inputs (C, ·) of n pixels of a row from x on."""
    found = seen.found[y, x : x + n]
    k = 0
    for image in (seen.noisy, seen.near, seen.around):
        for c in range(3):
            compress(lines[k, :n], image[c, y, x : x + n], seen.gain[c])
            k += 1
    for c in range(3):
        past, other = seen.past[c, y, x : x + n], seen.around[c, y, x : x + n]
        compress_past(lines[k, :n], found, past, other, seen.gain[c])
        past, other = seen.past[3 + c, y, x : x + n], seen.noisy[c, y, x : x + n]
        compress_past(lines[k + 3, :n], found, past, other, seen.gain[c])
        k += 1
    k += 3
    log_of_one_more(lines[k, :n], seen.deviation[y, x : x + n])
    lines[k + 1, :n] = ONE / seen.samples
    one_over(lines[k + 2, :n], seen.past[6, y, x : x + n], found, seen.samples)
    copy_line(lines[k + 3, :n], found)
    k += 4
    for channel in range(7, seen.past.shape[0]):
        copy_line(lines[k, :n], seen.past[channel, y, x : x + n])
        scale_line(lines[k, :n], found)
        k += 1
    nx, ny, nz = seen.normal[0, y, x : x + n], seen.normal[1, y, x : x + n], seen.normal[2, y, x : x + n]
    for c in range(3):
        copy_line(lines[k + c, :n], seen.albedo[c, y, x : x + n])
        turn(lines[k + 3 + c, :n], nx, ny, nz, seen.to_view[c])
    scale_depth(lines[k + 6, :n], seen.depth[y, x : x + n], seen.depth_scale)
    copy_line(lines[k + 7, :n], seen.roughness[y, x : x + n])


@jit_in_any_order
def put(patches: Any, y: Any, x: Any, lines: Any, n: int) -> None:
    """Pixels x to x + n of row y of patches (H / 2, W / 2, 2, 2, C) from lines (C, ·)."""
    for i in range(n):
        for c in range(patches.shape[4]):
            patches[y // 2, (x + i) // 2, y % 2, (x + i) % 2, c] = lines[c, i]


@jit_parallel
def write_inputs(patches: Any, hidden: Any, seen: Seen, layer: Layer) -> None:
    """Patches (H / 2, W / 2, 2, 2, C), borders repeated, and what the layer makes of pixels, hidden (c, h, w)."""
    height, width = seen.depth.shape
    for row in numba.prange(2 * patches.shape[0]):
        bottom = np.int64(row)
        y = min(bottom, height - 1)
        lines = np.zeros((layer.weight.shape[1], ROOM), np.float32)
        sums = np.empty((layer.weight.shape[0], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            fill_lines(lines, seen, y, x, n)
            put(patches, bottom, x, lines, n)
            if bottom > y:
                continue
            for c in range(sums.shape[0]):
                fill_line(sums[c, :n], layer.bias[c])
            add_layer(sums, lines, layer.weight, n)
            for c in range(hidden.shape[0]):
                activate(hidden[c, y, x : x + n], sums[c, :n])
        last = lines[:, (width - 1) % CHUNK :]
        for x in range(width, 2 * patches.shape[1]):
            put(patches, bottom, x, last, 1)


def network_inputs(frame: Frame, scale: RunningScale, known: "Evidence", hidden: nn.Linear) -> tuple[Tensor, Tensor]:
    """See models.networks.one.network_inputs; the channels of patches come last in memory."""
    batch, height, width = frame.shape
    rows, columns = (parameters.MULTIPLE * -(-size // parameters.MULTIPLE) // 2 for size in (height, width))
    out = torch.empty(batch, rows, columns, 2, 2, hidden.in_features)
    sums = torch.empty(batch, hidden.out_features, height, width)
    gains = array((scale.exposure() * frame.gain).flatten(1))
    depth_scales = array(scale.log_depth.value.exp())
    to_view = array(frame.to_view)
    for item in range(batch):
        seen = Seen(
            array(known.noisy[item]),
            array(known.near[item]),
            array(known.around[item]),
            array(known.deviation[item, 0]),
            array(known.past[item]),
            array(known.found[item, 0]),
            array(frame.albedo[item]),
            array(frame.normal[item]),
            array(frame.depth[item, 0]),
            array(frame.roughness[item, 0]),
            gains[item],
            np.float32(frame.samples[item].item()),
            to_view[item],
            depth_scales[item],
        )
        write_inputs(out[item].numpy(), sums[item].numpy(), seen, Layer.of(hidden))
    return out.flatten(3).permute(0, 3, 1, 2), sums


# --- What the network says --------------------------------------------------------------------------------------------


@jit_in_any_order
def separate(lines: Any, pixels: Any) -> None:
    """lines (C, n) = pixels (n, C), transposed."""
    for c in range(pixels.shape[1]):
        for x in range(pixels.shape[0]):
            lines[c, x] = pixels[x, c]


@jit_in_any_order
def softplus(line: Any, said: Any) -> None:
    for x in range(line.size):
        line[x] = max(said[x], ZERO) + log(ONE + exp(max(-abs(said[x]), LEAST_EXPONENT)))


@jit_in_any_order
def clamp(line: Any, said: Any) -> None:
    for x in range(line.size):
        line[x] = min(max(said[x], -LARGEST_LOGIT), LARGEST_LOGIT)


@jit_in_any_order
def tanh(line: Any, said: Any) -> None:
    for x in range(line.size):
        shrunk = exp(max(-TWO * abs(said[x]), LEAST_EXPONENT))
        size = (ONE - shrunk) / (ONE + shrunk)
        line[x] = size if said[x] > ZERO else -size


@jit_in_any_order
def odds(line: Any, said: Any, found: Any) -> None:
    for x in range(line.size):
        line[x] = ONE / (ONE + exp(min(max(-said[x], LEAST_EXPONENT), -LEAST_EXPONENT))) if found[x] > ZERO else ONE


@jit_in_any_order
def odds_against(line: Any, said: Any, found: Any, length: Any, samples: Any) -> None:
    """The prior is the even mean of a history of so many samples."""
    for x in range(line.size):
        past = max(length[x], FEWEST_SAMPLES) / samples
        against = past * exp(min(max(-said[x], LEAST_EXPONENT), -LEAST_EXPONENT))
        line[x] = ONE / (ONE + against) if found[x] > ZERO else ONE


@jit_in_any_order
def count_samples(length: Any, past: Any, alpha: Any, samples: Any) -> None:
    for x in range(length.size):
        kept = ONE - alpha[x]
        length[x] = ONE / (alpha[x] * alpha[x] / samples + kept * kept / max(past[x], FEWEST_SAMPLES))


@jit_in_any_order
def mix(line: Any, past: Any, new: Any, alpha: Any) -> None:
    for x in range(line.size):
        line[x] = alpha[x] * new[x] + (ONE - alpha[x]) * past[x]


class Told(NamedTuple):
    """What models.networks.one.Said holds of one image, (c, H, W) and length (H, W)."""

    features: Any
    sharpness: Any
    logits: Any  # own and importance
    alpha: Any
    latent: Any
    accumulated: Any
    length: Any


@jit_in_any_order
def tell(told: Told, lines: Any, noisy: Any, past: Any, found: Any, samples: Any, y: Any, x: Any, n: int) -> None:
    """Write n pixels of a row from x on, for which the network's outputs are lines (C, ·)."""
    k = 0
    for c in range(told.features.shape[0]):
        copy_line(told.features[c, y, x : x + n], lines[k, :n])
        k += 1
    for c in range(told.sharpness.shape[0]):
        softplus(told.sharpness[c, y, x : x + n], lines[k, :n])
        k += 1
    for c in range(told.logits.shape[0]):
        clamp(told.logits[c, y, x : x + n], lines[k, :n])
        k += 1
    there = found[y, x : x + n]
    length = past[6, y, x : x + n]
    alpha = told.alpha[0, y, x : x + n]
    odds_against(alpha, lines[k, :n], there, length, samples)
    odds(told.alpha[1, y, x : x + n], lines[k + 1, :n], there)
    k += 2
    for c in range(told.latent.shape[0]):
        tanh(told.latent[c, y, x : x + n], lines[k, :n])
        k += 1
    count_samples(told.length[y, x : x + n], length, alpha, samples)
    for c in range(3):
        mix(told.accumulated[c, y, x : x + n], past[3 + c, y, x : x + n], noisy[c, y, x : x + n], alpha)


@jit_parallel
def read_outputs(
    told: Told, pixels: Any, hidden: Any, layer: Layer, noisy: Any, past: Any, found: Any, samples: Any
) -> None:
    """`told` from what the U-Net says, pixels (H, W, C), with what the layer adds to it, and others (c, H, W)."""
    height, width, _ = pixels.shape
    for row in numba.prange(height):
        y = np.int64(row)
        lines = np.empty((layer.weight.shape[0], ROOM), np.float32)
        inputs = np.empty((layer.weight.shape[1], ROOM), np.float32)
        for x in range(0, width, CHUNK):
            n = min(CHUNK, width - x)
            separate(lines, pixels[y, x : x + n])
            for c in range(hidden.shape[0]):
                copy_line(inputs[c, :n], hidden[c, y, x : x + n])
            add_layer(lines, inputs, layer.weight, n)
            tell(told, lines, noisy, past, found, samples, y, x, n)


def interpret(said: Tensor, hidden: Tensor, last: nn.Linear, known: "Evidence", samples: Tensor) -> tuple[Tensor, ...]:
    """See models.networks.one.interpret."""
    batch, _, height, width = said.shape
    levels = (said.shape[1] - sum(parameters.outputs_of_one(0))) // 3
    counts = (parameters.COMPARED, levels, 2 * levels, 2, parameters.LATENT, 3, 1)
    out = [torch.empty(batch, channels, height, width) for channels in counts]
    for item in range(batch):
        features, sharpness, logits, alpha, latent, accumulated, length = (each[item].numpy() for each in out)
        read_outputs(
            Told(features, sharpness, logits, alpha, latent, accumulated, length[0]),
            said[item].movedim(0, -1).numpy(),
            array(hidden[item]),
            Layer.of(last),
            array(known.noisy[item]),
            array(known.past[item]),
            array(known.found[item, 0]),
            np.float32(samples[item].item()),
        )
    return out[0], out[1], *out[2].split(levels, dim=1), *out[3:]
