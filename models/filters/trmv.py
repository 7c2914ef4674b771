"""TRMV: temporally reliable motion vectors (Zeng et al. 2021): SVGF with motion vectors for each cause of light.

"Temporally Reliable Motion Vectors for Real-time Ray Tracing". Shadows move with the blocker, reflections with what is
reflected, and what was hidden resembles what was beside the occluder. The renderer tracks blockers and reflected points
(render/motion.py) and hidden surfaces (dual motion).

We do not have the paper's text; the three kinds of vectors follow its abstract and the authors' later paper (NTD §3.2,
§6). We choose:

- All but the motion vectors is SVGF's: validation, blending, filter. Direct and indirect light have separate histories.
- One sample per pixel hits one of several blockers, by chance, or none. So shadows move by the mean of all samples over
  9 × 9 pixels of the same mesh whose blocker moved, where these are MIN_SHADOWED of the window.
- Reflections move with the hit point of the pixel's own sample, on surfaces smoother than MAX_GLOSSY_ALPHA where most
  samples of the window were mirror-like: plastic, dominated by its diffuse base, moves as a surface. There, direct
  light is the reflection of the lamp.
- Elsewhere, motion vectors are dual.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame, Signal
from models.denoiser import State, matching_state
from models.filters.atrous import ATROUS_STEPS
from models.filters.neighbours import mesh_sums_9x9
from models.filters.svgf import SVGF, Integrated, estimate_variance, integrate, irradiances, pack_geometry, svgf_levels

MIN_OFFSET = 1 / 64  # px; smaller offsets count as none
MIN_SHADOWED = 1 / 8
MIN_MIRRORED = 1 / 2
MAX_GLOSSY_ALPHA = 0.25  # GGX


def mean_offset(vectors: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
    """The mean offset (B, 2, H, W) of `vectors` (B, 2, H, W) from surface motion, over 9 x 9 pixels of the same mesh.

    Only pixels with an offset count; also returned is their share of the window, (B, 1, H, W).
    """
    offset = vectors - frame.motion
    moves = offset.abs().amax(dim=1, keepdim=True) > MIN_OFFSET
    summands = torch.cat([torch.where(moves, offset, 0), moves, torch.ones_like(frame.depth)], dim=1)
    offsets, count, pixels = mesh_sums_9x9(summands, frame.mesh_id).split([2, 1, 1], dim=1)
    return offsets / count.clamp(min=1), count / pixels


def reliable_vectors(frame: Frame) -> list[Tensor]:
    """Motion vectors of direct and of indirect light, (B, 2, H, W) each, in pixels."""
    _, mirrored = mean_offset(frame.reflection_motion, frame)
    offset, shadowed = mean_offset(frame.shadow_motion, frame)
    glossy = (frame.roughness < MAX_GLOSSY_ALPHA) & (mirrored > MIN_MIRRORED)
    indirect = torch.where(glossy, frame.reflection_motion, frame.dual_motion)
    return [torch.where(~glossy & (shadowed > MIN_SHADOWED), frame.motion + offset, indirect), indirect]


@dataclass(frozen=True)
class TRMVState(State):
    """The histories of the next frame, one for each signal."""

    histories: list[Integrated]

    def pictures(self) -> dict[str, Tensor]:
        names = ("history length direct", "history length indirect")[-len(self.histories) :]
        return {name: history.length for name, history in zip(names, self.histories, strict=True)}


class TRMV(SVGF):
    """Filters direct and indirect irradiance separately, each within its own [min, max] since the last reset."""

    made_from = "abstract, accounts"
    baseline_for: tuple[Signal, ...] = ("indirect",)
    reads: tuple[str, ...] = (*SVGF.reads, "roughness", "dual_motion", "shadow_motion", "reflection_motion")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, TRMVState, frame)
        signals = irradiances(frame, self.signal).split(1, dim=1)
        histories = previous.histories if previous else [None] * len(signals)
        integrated = []
        for vectors, signal, history in zip(reliable_vectors(frame)[-len(signals) :], signals, histories, strict=True):
            integrated.append(integrate(frame.with_channels({"motion": vectors}), signal, history))
        geometry = pack_geometry(frame.depth, frame.normal, frame.mesh_id)
        variance = torch.cat([estimate_variance(part, geometry) for part in integrated], dim=1)
        colour = torch.cat([part.colour for part in integrated], dim=1)
        first, colour, _ = svgf_levels(colour, variance, geometry, ATROUS_STEPS)
        kept = [part._replace(colour=level) for part, level in zip(integrated, first.split(1, dim=1), strict=True)]
        return frame.remodulate(colour.sum(dim=1), self.signal), TRMVState(frame.moment, kept)
