"""EAW: the edge-avoiding à-trous wavelet filter (Dammertz et al. 2010), on temporally accumulated irradiance.

As SVGF's evaluation runs it (Schied et al. 2017, §5.1). Its edge-stopping functions know no variance: the paper leaves
their widths to the user, scene by scene. Here they count in units that a running scale of the scene gives.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.atrous import CENTRE, LEVELS, RADIUS, WindowSum, b3_spline, taps
from models.baselines import Accumulated, AccumulatedState
from models.compiled import eaw as kernels
from models.denoiser import CLASSICAL, Denoiser, State, matching_state
from models.operators import RunningScale, accumulate, finite, rays, running_scale

SIGMA_COLOUR = 4.0  # exposed irradiance, at the first level; halved from level to level
SIGMA_NORMAL = 0.4
SIGMA_POSITION = 0.1  # of the median depth
BACKGROUND = -1e3  # a position, in σ, away from all surfaces
BRIGHTEST = 1e15  # in σ; its square must stay finite


def positions(frame: Frame) -> Tensor:
    """Where the surfaces are in the camera's frame, (B, 3, H, W)."""
    height, width = frame.size
    x, y = torch.arange(width).to(frame.depth) + 0.5, torch.arange(height).to(frame.depth) + 0.5
    y, x = torch.meshgrid(y, x, indexing="ij")
    directions = torch.stack([rays(K, x, y) for K in frame.now.K])
    return directions.movedim(-1, 1) * frame.depth


def guides(frame: Frame, scale: RunningScale) -> Tensor:
    """Normals and positions in units of their σ, (B, 6, H, W); background lies away from all surfaces."""
    unit = SIGMA_POSITION * torch.exp(scale.log_depth.value)[:, None, None, None]
    position = torch.where(frame.depth > 0, positions(frame) / unit, BACKGROUND)
    return torch.cat([frame.normal / SIGMA_NORMAL, position], dim=1)


def filter_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform of colour (B, 3, H, W): w = exp(-|f(p) - f(q)|²) with features f (B, 9, H, W).

    A product of Gaussians of colour, normal and position is one of the distance between all of them.
    """
    if compiled.usable(colour, features):
        return kernels.filter_level(colour, features, step)
    total, mean = WindowSum(torch.ones_like(colour[:, :1]), CENTRE), WindowSum(colour, CENTRE)
    for tap in taps(colour.shape[-2:], RADIUS, step):
        apart = (features[tap.p] - features[tap.q]).square_().sum(dim=1, keepdim=True)
        weight = apart.neg_().exp_().mul_(b3_spline(tap, step))
        total.add(tap, weight)
        mean.add(tap, weight)
    return mean.sum / total.sum


@dataclass(frozen=True)
class EAWState(AccumulatedState):
    scale: RunningScale


class EAW(Denoiser):
    """Filters accumulated irradiance within its [min, max] since the last reset."""

    reads = Accumulated.reads
    refuses = CLASSICAL

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, EAWState, frame)
        irradiance = finite(frame.irradiance(self.signal))
        history = accumulate(frame, irradiance, before.history if before else None)
        radiance = irradiance * frame.divisor
        scale = running_scale(radiance, frame.depth, before.scale if before else None)
        colour, geometry = history.irradiance, guides(frame, scale)
        for level in range(LEVELS):
            exposed = colour * (scale.exposure() * 2**level / SIGMA_COLOUR)
            colour = filter_level(colour, torch.cat([exposed.clamp(max=BRIGHTEST), geometry], dim=1), 2**level)
        return frame.remodulate(colour, self.signal), EAWState(frame.moment, history, scale)
