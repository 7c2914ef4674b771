"""models.features for the processor: in one pass, and in the order of memory that convolutions like."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import Frame
from models.compiled.exponential import exp, log
from models.compiled.jit import array, jit_parallel, jit_with_reciprocals
from models.parameters import FEATURE_CHANNELS, GAMMA
from models.running_scale import RunningScale

LEAST_ALBEDO = np.float32(ALBEDO_FLOOR)
INVERSE_GAMMA = np.float32(1 / GAMMA)
LEAST_EXPOSED = np.float32(1e-30)  # its power is 0 as far as a network can tell, and its logarithm is finite


@jit_with_reciprocals
def feature_row(out: Any, irradiance: Any, albedo: Any, normal: Any, depth: Any, exposure: Any, scale: Any) -> None:
    """out (W, 10) from irradiance, albedo and normal (3, W), depth (W), exposure (3,), and the depth `scale`."""
    line = np.empty(depth.size, np.float32)
    for c in range(3):
        for x in range(line.size):
            exposed = exposure[c] * irradiance[c, x] * max(albedo[c, x], LEAST_ALBEDO)
            line[x] = exp(INVERSE_GAMMA * log(min(max(exposed, LEAST_EXPOSED), np.float32(1))))
        for x in range(line.size):
            out[x, c] = line[x]
            out[x, 3 + c] = albedo[c, x]
            out[x, 6 + c] = normal[c, x] * np.float32(0.5) + np.float32(0.5)
    for x in range(line.size):
        out[x, 9] = depth[x] / (depth[x] + scale) if depth[x] > 0 else np.float32(1)


@jit_parallel
def feature_image(out: Any, irradiance: Any, albedo: Any, normal: Any, depth: Any, exposure: Any, scale: Any) -> None:
    for y in numba.prange(depth.shape[0]):
        feature_row(out[y], irradiance[:, y], albedo[:, y], normal[:, y], depth[y], exposure, scale)


def network_features(frame: Frame, irradiance: Tensor, scale: RunningScale) -> Tensor:
    """See models.features.network_features; channels come last in memory."""
    exposure = array((scale.exposure() * frame.gain).flatten(1))
    depth_scale = array(scale.log_depth.value.exp())
    out = torch.empty(len(irradiance), *frame.size, FEATURE_CHANNELS)
    for item in range(len(out)):
        feature_image(
            out[item].numpy(),
            array(irradiance[item]),
            array(frame.albedo[item]),
            array(frame.normal[item]),
            array(frame.depth[item, 0]),
            exposure[item],
            depth_scale[item],
        )
    return out.permute(0, 3, 1, 2)
