"""EAW: the edge-avoiding à-trous wavelet filter (Dammertz et al. 2010), on temporally accumulated irradiance.

As SVGF's evaluation runs it (Schied et al. 2017, §5.1). Its edge-stopping functions know no variance: the paper leaves
their widths to the user, scene by scene. Here they count in units that a running scale of the scene gives.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import eaw as kernels
from models.denoiser import CLASSICAL, State, matching_state
from models.filters.atrous import ATROUS_LEVELS, CENTRE, RADIUS, WindowSum, b3_spline, strip_taps
from models.filters.baselines import Accumulated, AccumulatedState, Accumulating
from models.history.running_scale import RunningScale, running_scale
from models.history.surfaces import rays

SIGMA_COLOUR = 4.0  # exposed irradiance, at the first level; halved from level to level
SIGMA_NORMAL = 0.4
SIGMA_POSITION = 0.1  # of the median depth
FAR_AWAY = -1e3  # the background's position, in σ, away from all surfaces
LARGEST_EXPOSED = 1e15  # in σ; its square must stay finite


def positions(frame: Frame) -> Tensor:
    """Where the surfaces are in the camera's frame, (B, 3, H, W)."""
    height, width = frame.size
    columns = torch.arange(width).to(frame.depth) + 0.5
    rows = torch.arange(height).to(frame.depth) + 0.5
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    directions = torch.stack([rays(K, x, y) for K in frame.now.K])
    return directions.movedim(-1, 1) * frame.depth


def guides(frame: Frame, scale: RunningScale) -> Tensor:
    """Normals and positions in units of their σ, (B, 6, H, W); background lies away from all surfaces."""
    unit = SIGMA_POSITION * torch.exp(scale.log_depth.value)[:, None, None, None]
    position = torch.where(frame.depth > 0, positions(frame) / unit, FAR_AWAY)
    return torch.cat([frame.normal / SIGMA_NORMAL, position], dim=1)


@compiled.by(kernels.eaw_level)
def eaw_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform of colour (B, 3, H, W): w = exp(-|f(p) - f(q)|²) with features f (B, 9, H, W).

    A product of Gaussians of colour, normal and position is one of the distance between all of them. Taps are `step`
    pixels apart.
    """
    total = WindowSum(torch.ones_like(colour[:, :1]), CENTRE)
    mean = WindowSum(colour, CENTRE)
    for tap in strip_taps(colour.shape[-2:], RADIUS, step):
        apart = (features[tap.p] - features[tap.q]).square_().sum(dim=1, keepdim=True)
        weight = apart.neg_().exp_().mul_(b3_spline(tap, step))
        total.add(tap, weight)
        mean.add(tap, weight)
    return mean.sum / total.sum


@dataclass(frozen=True)
class EAWState(AccumulatedState):
    scale: RunningScale


class EAW(Accumulating):
    """Filters accumulated irradiance within its [min, max] since the last reset."""

    reads = Accumulated.reads
    refuses = CLASSICAL
    convex = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, EAWState, frame)
        history = self.accumulated(frame, before)
        scale = running_scale(
            frame.irradiance(self.signal) * frame.divisor, frame.depth, before.scale if before else None
        )
        geometry = guides(frame, scale)
        colour = history.irradiance
        for level in range(ATROUS_LEVELS):
            exposed = colour * (scale.exposure() * 2**level / SIGMA_COLOUR)
            colour = eaw_level(colour, torch.cat([exposed.clamp(max=LARGEST_EXPOSED), geometry], dim=1), 2**level)
        return frame.remodulate(colour, self.signal), EAWState(frame.moment, history, scale)
