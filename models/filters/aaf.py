"""AAF: axis-aligned filtering of soft shadows (Mehta et al. 2012) and of indirect light (Mehta et al. 2013).

Frequency analysis says how fast light can vary along a surface: the faster, the nearer the blocker to the surface and
the smaller the light; the faster, the nearer what indirect rays hit. So each pixel has a Gaussian of its own, as wide
as light varies slowly, measured in the plane of the surface and applied along rows and then along columns.

"Axis-Aligned Filtering for Interactive Sampled Soft Shadows", and "... for Interactive Physically-Based Diffuse
Indirect Lighting". Theirs are the widths

- 1/k max(σ s, 1/Ω) for direct light, with σ the standard deviation of the light, s = d₁ / d₂ - 1 of its distances from
  the surface and the blocker, 1/Ω the size of a pixel and k = 3;
- z / (2 · 2.8) for indirect light, with z the distance of what indirect rays hit; the Gaussian exp(-2 (2.8 d / z)²)
  ends where the exponent is -4, and goes to surfaces nearer than z whose normals lie within 5°. On a glossy surface of
  Phong exponent m, 3.5 + 0.2 m takes the place of 2.8.

We have not read the papers but their abstracts, others' accounts, and of the second the authors' code. What we choose:

- s and z are the least of 3 x 3 pixels of the own mesh: one sample a pixel knows too little of either, and by its own
  alone a filter would be the narrower the darker the sample. More pixels would make filters narrower than light needs.
- μ, which makes filters narrower as samples become more, is 1.
- The papers' direct light is free of noise where nothing blocks it, and they leave it as it is there. Ours is noisy,
  and a lamp is to it what other surfaces are to indirect light: its width is that by z = d₁, or less by a shadow.
- Of direct light, a tap counts by the narrower Gaussian, its own or that of the pixel that takes it: shadows, whose
  filters are narrow, must not leak to where they are wide. Of indirect light the taking pixel's alone counts, as there.
- GGX roughness α counts as Phong's m = (1/α² - 1) / 2. All light of a surface is filtered by that of its roughness,
  for we do not store lobes apart.
- What stops filters of indirect light stops those of direct light, with z of an equally wide one.
- No filter reaches farther than 50 px, the authors' limit; those that would are made narrower.
"""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models import compiled
from models.compiled import aaf as kernels
from models.compiled.aaf import COSINE_OF_5_DEGREES, DIFFUSE_BAND, MAX_REACH, TRUNCATION
from models.denoiser import CLASSICAL, Denoiser, State
from models.filters.atrous import Tap, WindowSum
from models.filters.neighbours import mesh_least
from models.filters.svgf import irradiances
from models.history.surfaces import rays
from models.operators import MAX_LUMINANCE, MIN_DIVISOR

SHADOW_SHARPNESS = 3.0  # k
GLOSSY_BAND = 3.5
BAND_OF_EXPONENT = 0.2
LEAST_ALPHA = 1e-3
NEAREST_TO_LIGHT = 2.0**-10  # of its distance: float16 rounds by as much


def band_limit(roughness: Tensor) -> Tensor:
    """Of what surfaces of GGX roughness (B, 1, H, W) reflect, times the distance of that; 1 is diffuse."""
    exponent = (1 / roughness.clamp(LEAST_ALPHA, 1).square() - 1) / 2
    return torch.where(roughness < 1, GLOSSY_BAND + BAND_OF_EXPONENT * exponent, DIFFUSE_BAND)


def penumbra(frame: Frame) -> Tensor:
    """σ s (B, 1, H, W) of shadows in world units, by each pixel's own samples; 0 where nothing blocks them."""
    blocked = frame.hit_distance[:, 1:]
    share = blocked / torch.where(frame.light_distance > 0, frame.light_distance, torch.inf)
    return frame.light_angle * blocked / (1 - share).clamp(min=NEAREST_TO_LIGHT)


def pixel_size(frame: Frame) -> Tensor:
    """How far apart pixel centres are on a surface that faces the eye, (B, 1, H, W), in world units."""
    return frame.depth / frame.now.K[:, 0, 0].abs().to(frame.depth)[:, None, None, None]


def widths(frame: Frame) -> Tensor:
    """Standard deviations (B, 2, 1, H, W) of the Gaussians for direct and for indirect light, in world units."""
    size = pixel_size(frame)
    shadow = frame.hit_distance[:, 1:] > 0
    known = torch.where(shadow, penumbra(frame), torch.inf)
    of_shadow = torch.maximum(mesh_least(known, frame.mesh_id), size) / SHADOW_SHARPNESS
    met = torch.cat([frame.light_distance, frame.hit_distance[:, :1]], dim=1)
    nearest = mesh_least(torch.where(met > 0, met, torch.inf), frame.mesh_id)
    of_lamp, indirect = (nearest / (2 * band_limit(frame.roughness))).split(1, dim=1)
    both = torch.stack([torch.minimum(of_shadow, of_lamp), indirect], dim=1)
    return torch.minimum(both, (MAX_REACH / TRUNCATION * size)[:, None])


def positions(frame: Frame) -> Tensor:
    """What pixels show, (B, 3, H, W), seen from the eye and along the axes of the world."""
    height, width = frame.size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    along = torch.stack([rays(K, x.to(frame.depth), y.to(frame.depth)) for K in frame.now.K])
    rotation = frame.now.camera_to_world[:, :3, :3].to(along)
    return torch.einsum("bij,bhwj->bihw", rotation, along) * frame.depth


def pack_geometry(frame: Frame) -> Tensor:
    """What measures and stops the filters, (B, 1, 6, H, W): positions, unit normals (0 for background)."""
    unit = torch.where(frame.depth > 0, F.normalize(frame.normal, dim=1, eps=MIN_DIVISOR), 0)
    return torch.cat([positions(frame), unit], dim=1)[:, None]


def line_taps(size: Sequence[int], reach: int, down: bool) -> Iterator[Tap]:
    """The places up to `reach` px to either side of a pixel, but for itself, in its row or down its column."""
    height, width = size
    for step in range(-reach, reach + 1):
        dx, dy = (0, step) if down else (step, 0)
        rows = slice(max(0, -dy), min(height, height - dy))
        columns = slice(max(0, -dx), min(width, width - dx))
        if step and rows.start < rows.stop and columns.start < columns.stop:
            there = slice(rows.start + dy, rows.stop + dy), slice(columns.start + dx, columns.stop + dx)
            yield Tap(dx, dy, (..., rows, columns), (..., *there))


def gaussian_weight(width: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """Weights (..., 1, h, w) of taps by Gaussians of that width, of the geometry (..., 6, h, w) at p and q."""
    apart = q[..., :3, :, :] - p[..., :3, :, :]
    normal = p[..., 3:, :, :]
    distance = apart.square().sum(dim=-3, keepdim=True)
    along = distance - (apart * normal).sum(dim=-3, keepdim=True).square()
    exponent = along.clamp(min=0) / (2 * width.square())
    same = (normal * q[..., 3:, :, :]).sum(dim=-3, keepdim=True) > COSINE_OF_5_DEGREES
    near = distance < (2 * DIFFUSE_BAND * width).square()
    return torch.where(same & near & (exponent <= TRUNCATION**2 / 2), (-exponent).exp(), 0)


@compiled.by(kernels.filter_lines)
def filter_lines(image: Tensor, width: Tensor, widest: Tensor, geometry: Tensor, down: bool) -> Tensor:
    """Images (B, S, 3, H, W), filtered along rows, or `down` columns, by Gaussians of `width` (B, S, 1, H, W).

    A tap is taken by none wider than `widest` says of it, (B, S, 1, H, W).
    """
    total = WindowSum(torch.ones_like(width), 1)
    mean = WindowSum(image, 1)
    for tap in line_taps(image.shape[-2:], MAX_REACH, down):
        narrower = torch.minimum(width[tap.p], widest[tap.q])
        weight = gaussian_weight(narrower, geometry[tap.p], geometry[tap.q])
        total.add(tap, weight)
        mean.add(tap, weight)
    return mean.sum / total.sum


class AAF(Denoiser):
    """Filters direct and indirect irradiance of each frame by itself, each within its own [min, max]."""

    reads = (
        *("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id"),
        *("hit_distance", "light_distance", "light_angle"),
    )
    refuses = CLASSICAL
    convex = True
    separates_lights = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        image = irradiances(frame, self.signal).clamp(-MAX_LUMINANCE, MAX_LUMINANCE)
        width = widths(frame)[:, -image.shape[1] :]
        widest = width.clone()
        widest[:, -1] = torch.inf  # of indirect light
        geometry = pack_geometry(frame)
        for down in (False, True):
            image = filter_lines(image, width, widest, geometry, down)
        return frame.remodulate(image.sum(dim=1), self.signal), State(frame.moment)
