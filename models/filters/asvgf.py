"""A-SVGF: SVGF whose history is discarded where light changes (Schied et al. 2018).

"Gradient Estimation for Real-Time Adaptive Temporal Filtering". The channel `gradient` (render/gradient.py) holds the
temporal gradient samples. Where the paper is silent, or we do not have its text, we choose:

- The edge-avoiding filter of gradients has SVGF's kernel, five levels, and SVGF's weights of depth and normal; none of
  luminance, whose variance one sample per stratum does not reveal.
- The geometry of a stratum is that of its brightest sample; all its samples are summed; an empty stratum has weight 0.
- The history's length, which switches from spatial to temporal variance, also shrinks by 1 - λ.
"""

from torch import Tensor
from torch.nn import functional as F

from datasets.channels import STRATUM
from datasets.frame import Frame
from models.filters.atrous import ATROUS_STEPS, CENTRE, RADIUS, Tap, b3_spline, strip_taps, window_mean
from models.filters.svgf import SVGF, geometry_weight, pack_geometry
from models.layers import pixels_at
from models.operators import MIN_DIVISOR, block_sums, pad_to_multiple


def strata_sums(image: Tensor) -> Tensor:
    """Sums (B, C, h, w) of an image (B, C, H, W) over strata."""
    return block_sums(image, STRATUM)


def strata_centres(image: Tensor) -> Tensor:
    """The centre pixel of each stratum, (B, C, h, w), of an image (B, C, H, W); the last pixel of smaller ones."""
    centres = slice(STRATUM // 2, None, STRATUM)
    return pad_to_multiple(image, STRATUM)[..., centres, centres].contiguous()


def repeat_strata(strata: Tensor, size: tuple[int, int]) -> Tensor:
    """An image (B, C, H, W) of `size` (H, W) whose pixels have the values (B, C, h, w) of their strata."""
    return strata.repeat_interleave(STRATUM, dim=-2).repeat_interleave(STRATUM, dim=-1)[..., : size[0], : size[1]]


def gradient_level(gradient: Tensor, geometry: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform of gradients (B, 2, h, w) within `geometry`. Taps are `step` strata apart."""

    def weight(tap: Tap) -> Tensor:
        return geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy).mul_(b3_spline(tap, step))

    return window_mean(gradient, CENTRE, strip_taps(gradient.shape[-2:], RADIUS, step), weight)


def change_of_light(frame: Frame) -> Tensor:
    """λ = min(1, |δ| / Δ) of the filtered differences δ and luminances Δ, (B, 1, H, W)."""
    gradient = strata_sums(frame.gradient)
    _, brightest = F.max_pool2d(frame.gradient[:, 1:], STRATUM, ceil_mode=True, return_indices=True)
    surfaces = (pixels_at(channel, brightest) for channel in (frame.depth, frame.normal, frame.mesh_id))
    geometry = pack_geometry(*surfaces)[:, 0]
    for step in ATROUS_STEPS:
        gradient = gradient_level(gradient, geometry, step)
    difference, luminance = gradient.split(1, dim=1)
    return repeat_strata((difference.abs() / luminance.clamp(min=MIN_DIVISOR)).clamp(max=1), frame.size)


class ASVGF(SVGF):
    """SVGF with α = (1 - λ) max(0.2, 1 / n) + λ, for colour and moments alike."""

    made_from = "accounts"
    reads: tuple[str, ...] = (*SVGF.reads, "gradient")
    baseline_for = ()

    def change(self, frame: Frame) -> Tensor:
        return change_of_light(frame)
