"""TRMV: temporally reliable motion vectors (Zeng et al. 2021): SVGF that finds history by what causes light.

"Temporally Reliable Motion Vectors for Real-time Ray Tracing". A shadow moves with its blocker, a reflection with what
is reflected, and what was hidden resembles what was beside the occluder: so light's history is not where the surface's
is. The renderer follows blockers and reflected points (render/tracking.py) and hidden surfaces (dual motion).

We do not have the paper's text; its abstract, and what Zeng et al. say of it in their later paper (NTD §3.2, §6), tell
the three kinds of vectors. What we choose:

- Everything but where history is looked for is SVGF's: its tests, its blending, its filter. Direct and indirect light
  have histories of their own.
- One sample a pixel meets a blocker or does not, and by chance one of several. So shadows move by the mean of all
  samples over 9 × 9 pixels of the own mesh whose blocker moved, where these are SHADED of the window.
- Reflections move as what the pixel's own sample hit, where surfaces are smoother than GLOSSY and most samples of the
  window left them as by a mirror: plastic, of whose light the most part is its base's, moves as a surface. Direct
  light is a reflection there, too, of the lamp.
- Where neither holds, history is that of dual motion.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import State, matching_state
from models.filters.neighbours import mesh_sums
from models.filters.svgf import (
    ATROUS_STEPS,
    SVGF,
    Integrated,
    estimate_variance,
    integrate,
    irradiances,
    pack_geometry,
    svgf_levels,
)

MOVED = 1 / 64  # px; what is closer together counts as the same place
SHADED = 1 / 8
MIRRORING = 1 / 2
GLOSSY = 0.25  # GGX alpha


def offset_around(vectors: Tensor, frame: Frame) -> tuple[Tensor, Tensor]:
    """How much farther than their surfaces things move, by `vectors` (B, 2, H, W), around each pixel.

    The mean offset (B, 2, H, W) of those that do move farther, of 9 x 9 pixels of the own mesh, and their share of
    these, (B, 1, H, W).
    """
    offset = vectors - frame.motion
    farther = offset.abs().amax(dim=1, keepdim=True) > MOVED
    counted = torch.cat([torch.where(farther, offset, 0), farther, torch.ones_like(frame.depth)], dim=1)
    offsets, votes, pixels = mesh_sums(mesh_sums(counted, frame.mesh_id, 1), frame.mesh_id, 3).split([2, 1, 1], dim=1)
    return offsets / votes.clamp(min=1), votes / pixels


def reliable_vectors(frame: Frame) -> list[Tensor]:
    """Where the history of direct and of indirect light is, (B, 2, H, W) each, in pixels."""
    _, mirroring = offset_around(frame.reflection_motion, frame)
    shadow, shaded = offset_around(frame.shadow_motion, frame)
    glossy = (frame.roughness < GLOSSY) & (mirroring > MIRRORING)
    indirect = torch.where(glossy, frame.reflection_motion, frame.dual_motion)
    return [torch.where(~glossy & (shaded > SHADED), frame.motion + shadow, indirect), indirect]


@dataclass(frozen=True)
class TRMVState(State):
    """What is integrated in the next frame, a history for each signal."""

    histories: list[Integrated]

    def pictures(self) -> dict[str, Tensor]:
        names = ("history length direct", "history length indirect")[-len(self.histories) :]
        return {name: history.length for name, history in zip(names, self.histories, strict=True)}


class TRMV(SVGF):
    """Filters direct and indirect irradiance separately, each within its own [min, max] since the last reset."""

    reads: tuple[str, ...] = (*SVGF.reads, "roughness", "dual_motion", "shadow_motion", "reflection_motion")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, TRMVState, frame)
        signals = irradiances(frame, self.signal).split(1, dim=1)
        histories = before.histories if before else [None] * len(signals)
        integrated = [
            integrate(replace(frame, channels=frame.channels | {"motion": vectors}), signal, history)
            for vectors, signal, history in zip(
                reliable_vectors(frame)[-len(signals) :], signals, histories, strict=True
            )
        ]
        geometry = pack_geometry(frame.depth, frame.normal, frame.mesh_id)
        variance = torch.cat([estimate_variance(part, geometry) for part in integrated], dim=1)
        colour = torch.cat([part.colour for part in integrated], dim=1)
        first, colour, _ = svgf_levels(colour, variance, geometry, ATROUS_STEPS)
        kept = [replace(part, colour=own) for part, own in zip(integrated, first.split(1, dim=1), strict=True)]
        return frame.remodulate(colour.sum(dim=1), self.signal), TRMVState(frame.moment, kept)
