"""network_features of models.networks.wskp for the CPU: in one pass, in the order of memory that convolutions want."""

from collections.abc import Sequence

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import Frame
from models.compiled.arrays import Image, Row, Scalar, f32
from models.compiled.exponential import exp, log
from models.compiled.jit import jit_parallel, jit_with_reciprocals, run_items
from models.compiled.lines import block_count, rows_of_block, scale_depth, transpose
from models.history.running_scale import RunningScale

FEATURE_CHANNELS = {"colour": 3, "albedo": 3, "normal": 3, "depth": 1}  # inputs' channels (Fan et al. 2021, §5.1)
GAMMA = 2.2  # of the display transform before the network (§5.1)
MIN_EXPOSED = 1e-30  # its power is 0 as far as a network can tell, and its logarithm is finite


@jit_with_reciprocals
def display(line: Row, irradiance: Row, albedo: Row, exposure: Scalar) -> None:
    """min(exposure irradiance max(albedo, floor), 1)^(1 / GAMMA)."""
    for x in range(line.size):
        exposed = exposure * irradiance[x] * max(albedo[x], f32(ALBEDO_FLOOR))
        line[x] = exp(f32(1 / GAMMA) * log(min(max(exposed, f32(MIN_EXPOSED)), f32(1))))


@jit_with_reciprocals
def scale_normal(line: Row, normal: Row) -> None:
    for x in range(line.size):
        line[x] = normal[x] * f32(0.5) + f32(0.5)


@jit_parallel
def feature_image(
    out: Image, images: tuple[Image, ...], exposure: Row, scale: Row, with_albedo: bool, with_normal: bool
) -> None:
    """out (H, W, C), C = 10, and 3 less without albedo and without normal; exposure (3), scale (1) of the depth."""
    irradiance, albedo, normal, depth = images
    _, height, width = depth.shape
    after_albedo = 6 if with_albedo else 3
    for block in numba.prange(block_count(height)):
        lines = np.empty((out.shape[2], width), np.float32)
        for y in rows_of_block(block, height):
            for c in range(3):
                display(lines[c], irradiance[c, y], albedo[c, y], exposure[c])
                if with_albedo:
                    lines[3 + c] = albedo[c, y]
                if with_normal:
                    scale_normal(lines[after_albedo + c], normal[c, y])
            scale_depth(lines[out.shape[2] - 1], depth[0, y], scale[0])
            transpose(out[y], lines)


def network_features(
    frame: Frame, irradiance: Tensor, scale: RunningScale, names: Sequence[str] = tuple(FEATURE_CHANNELS)
) -> Tensor:
    """See models.networks.wskp.network_features; channels come last in memory."""
    exposure = (scale.exposure() * frame.gain).flatten(1)
    depth_scale = scale.log_depth.value.exp()[:, None]
    out = torch.empty(len(irradiance), *frame.size, sum(FEATURE_CHANNELS[name] for name in names))
    images = irradiance, frame.albedo, frame.normal, frame.depth
    run_items(feature_image, [out], [images, exposure, depth_scale], "albedo" in names, "normal" in names)
    return out.permute(0, 3, 1, 2)
