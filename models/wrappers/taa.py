"""NAME+taa: temporal antialiasing after a denoiser (Karis 2014)."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models.denoiser import State, matching_state
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from models.history.running_scale import RunningScale, running_scale
from models.operators import sampling_grid
from models.wrappers.wrapper import Wrapper

TAA_ALPHA = 0.1  # weight of the current frame
YCOCG_FROM_RGB = ((0.25, 0.5, 0.25), (0.5, 0.0, -0.5), (-0.25, 0.5, -0.25))
RGB_FROM_YCOCG = ((1.0, 1.0, -1.0), (1.0, 0.0, 1.0), (1.0, -1.0, -1.0))


def transform_colours(image: Tensor, matrix: tuple[tuple[float, ...], ...]) -> Tensor:
    """An image (B, 3, H, W) in another colour space, by a 3 x 3 matrix."""
    return torch.einsum("ij,bjhw->bihw", torch.tensor(matrix).to(image), image)


def tone_map(radiance: Tensor) -> Tensor:
    """Exposed radiance (B, 3, H, W) tone-mapped by w = 1 / (1 + luma), in YCoCg, and w itself: (B, 4, H, W).

    With w, the inverse loses no digits where the tone-mapped luma is close to 1. Averages are weighted by w, which
    keeps fireflies from flickering.
    """
    ycocg = transform_colours(radiance, YCOCG_FROM_RGB)
    w = 1 / (1 + ycocg[:, :1])
    return torch.cat([ycocg * w, w], dim=1)


def inverse_tone_map(tone_mapped: Tensor) -> Tensor:
    """Exposed radiance (B, 3, H, W), clamped at 0: a box in YCoCg has corners outside of RGB."""
    return transform_colours(tone_mapped[:, :3] / tone_mapped[:, 3:], RGB_FROM_YCOCG).clamp(min=0)


def max_3x3(image: Tensor) -> Tensor:
    """Maxima over 3 × 3 pixels; much faster than F.max_pool2d on a CPU."""
    for dim, border in ((-1, (1, 1, 0, 0)), (-2, (0, 0, 1, 1))):
        length = image.shape[dim]
        padded = F.pad(image, border, value=-torch.inf)
        left, middle, right = (padded.narrow(dim, start, length) for start in range(3))
        image = torch.maximum(torch.maximum(left, middle), right)
    return image


@dataclass(frozen=True)
class TAAState(State):
    """The inner denoiser's state, the last output (B, 3, H, W), its G-buffer and exposure."""

    inner: State
    output: Tensor
    gbuffer: GBuffer
    scale: RunningScale

    def pictures(self) -> dict[str, Tensor]:
        return self.inner.pictures()


class TAA(Wrapper):
    """Temporal antialiasing of a denoiser's output.

    The history is fetched along motion vectors across edges, which is what smooths them, and dropped where reprojection
    finds none: disoccluded, or off-screen. Tone-mapped, it is clamped to the range of the current 3 x 3 pixels. Tone
    mapping takes the causal exposure of the outputs so far.
    """

    needs = ("normal", "depth", "mesh_id", "motion")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, TAAState, frame)
        output, inner = self.inner.run(frame, previous.inner if previous else None)
        scale = running_scale(output, frame.depth, previous.scale if previous else None)
        if previous:
            exposure = scale.exposure()
            _, has_history = reproject(frame, previous.gbuffer.mesh_id, previous.gbuffer)
            grid = sampling_grid(frame.motion)
            history = F.grid_sample(previous.output, grid, "bicubic", "border", align_corners=False).clamp(min=0)
            current = tone_map(output * exposure)
            clamped = tone_map(history * exposure).clamp(-max_3x3(-current), max_3x3(current))
            blended = torch.lerp(clamped, current, torch.where(has_history, TAA_ALPHA, 1))
            output = inverse_tone_map(blended) / exposure
        return output, TAAState(frame.moment, inner, output, GBuffer.of(frame), scale)
