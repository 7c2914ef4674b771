"""What `one` does around its network, for the processor: its inputs and what it says, each in one pass over memory.

Networks take and give pixels with their channels side by side; all other loops here run along lines of one channel.
"""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from models import parameters
from models.compiled.exponential import exp, log
from models.compiled.jit import array, jit_in_any_order, jit_parallel
from models.compiled.lines import copy_line, interleave, scale_depth
from models.running_scale import RunningScale

ONE = np.float32(1)
ZERO = np.float32(0)
TWO = np.float32(2)
LEAST_EXPONENT = np.float32(parameters.LEAST_EXPONENT)
LARGEST_LOGIT = np.float32(parameters.LARGEST_LOGIT)
FEWEST_SAMPLES = np.float32(parameters.FEWEST_SAMPLES)
BRIGHTEST = np.float32(parameters.BRIGHTEST)
BLOCK_ROWS = 8  # that share one piece of scratch memory


@jit_in_any_order
def compress(line: Any, image: Any, gain: Any) -> None:
    for x in range(line.size):
        line[x] = log(ONE + min(max(image[x], ZERO) * gain, BRIGHTEST))


@jit_in_any_order
def log_of_one_more(line: Any, image: Any) -> None:
    for x in range(line.size):
        line[x] = log(ONE + image[x])


@jit_in_any_order
def one_over(line: Any, length: Any, samples: Any) -> None:
    for x in range(line.size):
        line[x] = ONE / (length[x] + samples)


@jit_in_any_order
def turn(line: Any, nx: Any, ny: Any, nz: Any, axis: Any) -> None:
    ax, ay, az = axis[0], axis[1], axis[2]
    for x in range(line.size):
        line[x] = ax * nx[x] + ay * ny[x] + az * nz[x]


@jit_parallel
def write_inputs(
    out: Any,
    images: Any,
    gain: Any,
    deviation: Any,
    length: Any,
    samples: Any,
    found: Any,
    latent: Any,
    albedo: Any,
    normal: Any,
    to_view: Any,
    depth: Any,
    depth_scale: Any,
    roughness: Any,
) -> None:
    """out (H, W, C) from images, each (3, H, W), and others (c, H, W) or (H, W)."""
    height, width = depth.shape
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        lines = np.empty((out.shape[2], width), np.float32)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            k = 0
            for image in images:
                for c in range(3):
                    compress(lines[k], image[c, y], gain[c])
                    k += 1
            log_of_one_more(lines[k], deviation[y])
            lines[k + 1] = ONE / samples
            one_over(lines[k + 2], length[y], samples)
            copy_line(lines[k + 3], found[y])
            k += 4
            for channel in range(latent.shape[0]):
                copy_line(lines[k], latent[channel, y])
                k += 1
            for c in range(3):
                copy_line(lines[k + c], albedo[c, y])
                turn(lines[k + 3 + c], normal[0, y], normal[1, y], normal[2, y], to_view[c])
            scale_depth(lines[k + 6], depth[y], depth_scale)
            copy_line(lines[k + 7], roughness[y])
            interleave(out[y], lines)


def network_inputs(
    frame: Frame,
    scale: RunningScale,
    images: Sequence[Tensor],
    deviation: Tensor,
    length: Tensor,
    found: Tensor,
    latent: Tensor,
) -> Tensor:
    """See models.one.network_inputs; channels come last in memory."""
    batch = len(deviation)
    out = torch.empty(batch, *frame.size, sum(parameters.ONE_INPUTS.values()))
    gains = array((scale.exposure() * frame.gain).flatten(1))
    depth_scales = array(scale.log_depth.value.exp())
    to_view = array(frame.to_view)
    for item in range(batch):
        write_inputs(
            out[item].numpy(),
            tuple(array(image[item]) for image in images),
            gains[item],
            array(deviation[item, 0]),
            array(length[item, 0]),
            np.float32(frame.samples[item].item()),
            array(found[item, 0]),
            array(latent[item]),
            array(frame.albedo[item]),
            array(frame.normal[item]),
            to_view[item],
            array(frame.depth[item, 0]),
            depth_scales[item],
            array(frame.roughness[item, 0]),
        )
    return out.permute(0, 3, 1, 2)


# --- What the network says --------------------------------------------------------------------------------------------


@jit_in_any_order
def copy_channel(line: Any, pixels: Any, channel: int) -> None:
    for x in range(line.size):
        line[x] = pixels[x, channel]


@jit_in_any_order
def softplus(line: Any) -> None:
    for x in range(line.size):
        line[x] = max(line[x], ZERO) + log(ONE + exp(max(-abs(line[x]), LEAST_EXPONENT)))


@jit_in_any_order
def clamp(line: Any) -> None:
    for x in range(line.size):
        line[x] = min(max(line[x], -LARGEST_LOGIT), LARGEST_LOGIT)


@jit_in_any_order
def tanh(line: Any) -> None:
    for x in range(line.size):
        shrunk = exp(max(-TWO * abs(line[x]), LEAST_EXPONENT))
        size = (ONE - shrunk) / (ONE + shrunk)
        line[x] = size if line[x] > ZERO else -size


@jit_in_any_order
def odds(line: Any, found: Any, past: Any) -> None:
    """Logits less ln past become weights, 1 where nothing was found."""
    for x in range(line.size):
        against = past[x] * exp(min(max(-line[x], LEAST_EXPONENT), -LEAST_EXPONENT))
        line[x] = ONE / (ONE + against) if found[x] > ZERO else ONE


@jit_in_any_order
def count_samples(length: Any, past: Any, alpha: Any, samples: Any) -> None:
    for x in range(length.size):
        kept = ONE - alpha[x]
        length[x] = ONE / (alpha[x] * alpha[x] / samples + kept * kept / max(past[x], FEWEST_SAMPLES))


@jit_in_any_order
def relative_length(line: Any, length: Any, samples: Any) -> None:
    for x in range(line.size):
        line[x] = max(length[x], FEWEST_SAMPLES) / samples


@jit_in_any_order
def mix(line: Any, past: Any, new: Any, alpha: Any) -> None:
    for x in range(line.size):
        line[x] = past[x] + alpha[x] * (new[x] - past[x])


@jit_parallel
def read_outputs(
    features: Any,
    sharpness: Any,
    logits: Any,
    alpha: Any,
    latent: Any,
    accumulated: Any,
    length: Any,
    pixels: Any,
    noisy: Any,
    past: Any,
    past_length: Any,
    found: Any,
    samples: Any,
) -> None:
    """The first seven, (c, H, W) and length (H, W), from pixels (H, W, C) and others like them."""
    height, width = length.shape
    for row in numba.prange(height):
        y = np.int64(row)
        ratio = np.empty(width, np.float32)
        ones = np.ones(width, np.float32)
        k = 0
        for c in range(features.shape[0]):
            copy_channel(features[c, y], pixels[y], k)
            k += 1
        for c in range(sharpness.shape[0]):
            copy_channel(sharpness[c, y], pixels[y], k)
            softplus(sharpness[c, y])
            k += 1
        for c in range(logits.shape[0]):
            copy_channel(logits[c, y], pixels[y], k)
            clamp(logits[c, y])
            k += 1
        relative_length(ratio, past_length[y], samples)
        for c in range(2):
            copy_channel(alpha[c, y], pixels[y], k)
            odds(alpha[c, y], found[y], ratio if c == 0 else ones)
            k += 1
        for c in range(latent.shape[0]):
            copy_channel(latent[c, y], pixels[y], k)
            tanh(latent[c, y])
            k += 1
        count_samples(length[y], past_length[y], alpha[0, y], samples)
        for c in range(3):
            mix(accumulated[c, y], past[c, y], noisy[c, y], alpha[0, y])


def interpret(
    said: Tensor, noisy: Tensor, accumulated: Tensor, length: Tensor, found: Tensor, samples: Tensor
) -> tuple[Tensor, ...]:
    """See models.one.interpret."""
    batch, _, height, width = noisy.shape
    levels = (said.shape[1] - sum(parameters.outputs_of_one(0))) // 3
    counts = (parameters.COMPARED, levels, 2 * levels, 2, parameters.LATENT, 3, 1)
    out = [torch.empty(batch, channels, height, width) for channels in counts]
    features, sharpness, logits, alpha, latent, now_accumulated, now_length = out
    for item in range(batch):
        read_outputs(
            features[item].numpy(),
            sharpness[item].numpy(),
            logits[item].numpy(),
            alpha[item].numpy(),
            latent[item].numpy(),
            now_accumulated[item].numpy(),
            now_length[item, 0].numpy(),
            said[item].movedim(0, -1).numpy(),
            array(noisy[item]),
            array(accumulated[item]),
            array(length[item, 0]),
            array(found[item, 0]),
            np.float32(samples[item].item()),
        )
    return features, sharpness, *logits.split(levels, dim=1), alpha, latent, now_accumulated, now_length
