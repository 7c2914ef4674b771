"""models.networks.features for the processor: in one pass, and in the order of memory that convolutions like."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import Frame
from models.compiled.exponential import exp, log
from models.compiled.jit import array, jit_parallel, jit_with_reciprocals
from models.compiled.lines import interleave, scale_depth
from models.history.running_scale import RunningScale

FEATURES = {"colour": 3, "albedo": 3, "normal": 3, "depth": 1}  # inputs' channels (Fan et al. 2021, §5.1)
GAMMA = 2.2  # of the display transform before the network (§5.1)
ONE = np.float32(1)
HALF = np.float32(0.5)
BLOCK_ROWS = 8  # that share one piece of scratch memory
LEAST_ALBEDO = np.float32(ALBEDO_FLOOR)
INVERSE_GAMMA = np.float32(1 / GAMMA)
LEAST_EXPOSED = np.float32(1e-30)  # its power is 0 as far as a network can tell, and its logarithm is finite


@jit_with_reciprocals
def display(line: Any, irradiance: Any, albedo: Any, exposure: Any) -> None:
    for x in range(line.size):
        exposed = exposure * irradiance[x] * max(albedo[x], LEAST_ALBEDO)
        line[x] = exp(INVERSE_GAMMA * log(min(max(exposed, LEAST_EXPOSED), ONE)))


@jit_with_reciprocals
def scale_normal(line: Any, normal: Any) -> None:
    for x in range(line.size):
        line[x] = normal[x] * HALF + HALF


@jit_parallel
def feature_image(
    out: Any,
    irradiance: Any,
    albedo: Any,
    normal: Any,
    depth: Any,
    exposure: Any,
    scale: Any,
    sees_albedo: bool,
    sees_normal: bool,
) -> None:
    """out (H, W, C) from irradiance, albedo and normal (3, H, W), depth (H, W), exposure (3,), the depth's scale.

    C is 10, and 3 less for each of albedo and normal that the network does not see.
    """
    height, width = depth.shape
    after_albedo = 6 if sees_albedo else 3
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        lines = np.empty((out.shape[2], width), np.float32)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            for c in range(3):
                display(lines[c], irradiance[c, y], albedo[c, y], exposure[c])
                if sees_albedo:
                    lines[3 + c] = albedo[c, y]
                if sees_normal:
                    scale_normal(lines[after_albedo + c], normal[c, y])
            scale_depth(lines[out.shape[2] - 1], depth[y], scale)
            interleave(out[y], lines)


def network_features(
    frame: Frame, irradiance: Tensor, scale: RunningScale, names: Sequence[str] = tuple(FEATURES)
) -> Tensor:
    """See models.networks.features.network_features; channels come last in memory."""
    exposure = array((scale.exposure() * frame.gain).flatten(1))
    depth_scale = array(scale.log_depth.value.exp())
    out = torch.empty(len(irradiance), *frame.size, sum(FEATURES[name] for name in names))
    for item in range(len(out)):
        feature_image(
            out[item].numpy(),
            array(irradiance[item]),
            array(frame.albedo[item]),
            array(frame.normal[item]),
            array(frame.depth[item, 0]),
            exposure[item],
            depth_scale[item],
            "albedo" in names,
            "normal" in names,
        )
    return out.permute(0, 3, 1, 2)
