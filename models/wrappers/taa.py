"""Temporal antialiasing, for whatever denoiser (Karis 2014)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models.denoiser import State, matching_state
from models.history.geometry import GBuffer, pixel_centres
from models.history.reprojection import reproject
from models.history.running_scale import RunningScale, running_scale
from models.wrappers.wrapper import Wrapper

NEWEST = 0.1  # weight of the current frame
YCOCG = ((0.25, 0.5, 0.25), (0.5, 0.0, -0.5), (-0.25, 0.5, -0.25))  # from RGB
RGB = ((1.0, 1.0, -1.0), (1.0, 0.0, 1.0), (1.0, -1.0, -1.0))  # from YCoCg


def recolour(image: Tensor, matrix: tuple[tuple[float, ...], ...]) -> Tensor:
    """The colours (B, 3, H, W) of an image in another space, by a 3 x 3 matrix."""
    return torch.einsum("ij,bjhw->bihw", torch.tensor(matrix).to(image), image)


def compress(radiance: Tensor) -> Tensor:
    """Exposed radiance (B, 3, H, W) tone-mapped by w = 1 / (1 + luma), in YCoCg, and w itself: (B, 4, H, W).

    With w at hand, the way back loses no digits where the tone-mapped luma is close to 1. A mixture of several then
    weights them by w, which is what keeps fireflies from flickering.
    """
    ycocg = recolour(radiance, YCOCG)
    w = 1 / (1 + ycocg[:, :1])
    return torch.cat([ycocg * w, w], dim=1)


def expand(compressed: Tensor) -> Tensor:
    """Exposed radiance (B, 3, H, W): the inverse of `compress`.

    A box in YCoCg has corners outside of RGB, which are cut off.
    """
    return recolour(compressed[:, :3] / compressed[:, 3:], RGB).clamp(min=0)


def fetch_bicubic(history: Tensor, motion: Tensor) -> Tensor:
    """`history` (B, 3, H, W) at p + motion(p), bicubic, not below 0; beyond the border, that continues.

    `motion` (B, 2, H, W) is in pixels.
    """
    height, width = history.shape[-2:]
    x, y = pixel_centres(height, width, motion)
    # Far outside the image an index would overflow; any place outside is as good.
    x = (x + motion[:, 0]).clamp(-1, width + 1) * (2 / width) - 1
    y = (y + motion[:, 1]).clamp(-1, height + 1) * (2 / height) - 1
    grid = torch.stack([x, y], dim=-1)
    return F.grid_sample(history, grid, "bicubic", "border", align_corners=False).clamp(min=0)


def largest_around(image: Tensor) -> Tensor:
    """The largest value of the 3 × 3 pixels around each pixel; much faster than F.max_pool2d on a processor."""
    for dim, border in ((-1, (1, 1, 0, 0)), (-2, (0, 0, 1, 1))):
        length = image.shape[dim]
        wide = F.pad(image, border, value=-torch.inf)
        left, middle, right = (wide.narrow(dim, start, length) for start in range(3))
        image = torch.maximum(torch.maximum(left, middle), right)
    return image


def resolve(current: Tensor, history: Tensor, found: Tensor) -> Tensor:
    """Blend compressed images (B, 4, H, W), the history clamped to the range of the 3 x 3 pixels around each pixel.

    Where no history is `found` (B, 1, H, W), the current image is left alone.
    """
    low = -largest_around(-current)
    high = largest_around(current)
    return torch.lerp(torch.clamp(history, low, high), current, torch.where(found, NEWEST, 1))


@dataclass(frozen=True)
class AntialiasedState(State):
    """The inner denoiser's state, the last output (B, 3, H, W) and what the surfaces and exposure were."""

    inner: State
    output: Tensor
    gbuffer: GBuffer
    scale: RunningScale

    def pictures(self) -> dict[str, Tensor]:
        return self.inner.pictures()


class Antialiased(Wrapper):
    """Temporal antialiasing after a denoiser.

    The history follows the motion vectors and is blended across edges, which is what smooths them; it is dropped where
    reprojection finds no trace of the pixel's surface: disoccluded, or off-screen. Tone mapping needs an exposure: the
    causal one of the outputs so far.
    """

    def reads_with(self, reads: Sequence[str]) -> tuple[str, ...]:
        """With those that the history is fetched and tested by."""
        return tuple(dict.fromkeys((*reads, "normal", "depth", "mesh_id", "motion")))

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, AntialiasedState, frame)
        output, inner = self.inner.forward(frame, before.inner if before else None)
        scale = running_scale(output, frame.depth, before.scale if before else None)
        if before:
            exposure = scale.exposure()
            _, found = reproject(frame, before.gbuffer.mesh_id, before.gbuffer)
            past = compress(fetch_bicubic(before.output, frame.motion) * exposure)
            output = expand(resolve(compress(output * exposure), past, found)) / exposure
        return output, AntialiasedState(frame.moment, inner, output, GBuffer.of(frame), scale)
