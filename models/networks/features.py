"""The inputs of WSKP's networks (Fan et al. 2021, §5.1)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import features as kernels
from models.compiled.features import FEATURE_CHANNELS, GAMMA
from models.history.running_scale import RunningScale


@compiled.by(kernels.network_features)
def network_features(
    frame: Frame, irradiance: Tensor, scale: RunningScale, names: Sequence[str] = tuple(FEATURE_CHANNELS)
) -> Tensor:
    """The network's input (B, 10, H, W) in [0, 1], or fewer channels for some `names` of FEATURE_CHANNELS only.

    Accumulated `irradiance` (B, 3, H, W), modulated and displayed (causal exposure, clipped, gamma 2.2); albedo; the
    world-space normal scaled to [0, 1]; the depth d / (d + s) with s its running `scale`.
    """
    exposure = scale.exposure() * frame.gain
    colour = (irradiance * frame.divisor * exposure).clamp(0, 1) ** (1 / GAMMA)
    depth = scale.normalised_depth(frame.depth)
    parts = {"colour": colour, "albedo": frame.albedo, "normal": scaled_normal(frame.normal), "depth": depth}
    return torch.cat([parts[name] for name in names], dim=1)


def scaled_normal(normal: Tensor) -> Tensor:
    """A normal's components, from [-1, 1] to [0, 1]."""
    return normal / 2 + 0.5
