"""EAW: the edge-avoiding à-trous wavelet filter (Dammertz et al. 2010), on temporally accumulated irradiance.

As in SVGF's evaluation (Schied et al. 2017, §5.1). The paper leaves the widths of its edge-stopping functions to the
user, scene by scene; here they are in units of the scene's running scale.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import eaw as kernels
from models.denoiser import CLASSICAL, State, matching_state
from models.filters.atrous import ATROUS_STEPS, CENTRE, RADIUS, Tap, b3_spline, strip_taps, window_mean
from models.filters.baselines import AccumulatedState, Accumulating
from models.history.geometry import frame_rays
from models.history.running_scale import RunningScale, running_scale

SIGMA_COLOUR = 4.0  # exposed irradiance, at the first level; halved from level to level
EAW_SIGMA_NORMAL = 0.4
SIGMA_POSITION = 0.1  # of the median depth
BACKGROUND_POSITION = -1e3  # in σ, far from all surfaces
MAX_SIGMAS = 1e15  # in σ; its square must stay finite


def guides(frame: Frame, scale: RunningScale) -> Tensor:
    """Normals and positions in units of their σ, (B, 6, H, W); background is far from all surfaces."""
    unit = SIGMA_POSITION * torch.exp(scale.log_depth.value)[:, None, None, None]
    position = torch.where(frame.depth > 0, frame_rays(frame).movedim(-1, 1) * frame.depth / unit, BACKGROUND_POSITION)
    return torch.cat([frame.normal / EAW_SIGMA_NORMAL, position], dim=1)


@compiled.by(kernels.eaw_level)
def eaw_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform of colour (B, 3, H, W), with taps `step` pixels apart.

    w = exp(-|f(p) - f(q)|²) of features f (B, 9, H, W) is the product of Gaussians of colour, normal and position.
    """

    def weight(tap: Tap) -> Tensor:
        distance = (features[tap.p] - features[tap.q]).square_().sum(dim=1, keepdim=True)
        return distance.neg_().exp_().mul_(b3_spline(tap, step))

    return window_mean(colour, CENTRE, strip_taps(colour.shape[-2:], RADIUS, step), weight)


@dataclass(frozen=True)
class EAWState(AccumulatedState):
    scale: RunningScale


class EAW(Accumulating):
    """Filters accumulated irradiance within its [min, max] since the last reset."""

    made_from = "accounts"
    refuses = CLASSICAL
    convex = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, EAWState, frame)
        history = self.accumulated(frame, previous)
        reflected = frame.irradiance(self.signal) * frame.divisor
        scale = running_scale(reflected, frame.depth, previous.scale if previous else None)
        geometry = guides(frame, scale)
        colour = history.irradiance
        for step in ATROUS_STEPS:
            exposed = colour * (scale.exposure() * step / SIGMA_COLOUR)
            colour = eaw_level(colour, torch.cat([exposed.clamp(max=MAX_SIGMAS), geometry], dim=1), step)
        return frame.remodulate(colour, self.signal), EAWState(frame.moment, history, scale)
