"""AAF: axis-aligned filtering of soft shadows (Mehta et al. 2012) and of indirect light (Mehta et al. 2013).

"Axis-Aligned Filtering for Interactive Sampled Soft Shadows", and "... for Interactive Physically-Based Diffuse
Indirect Lighting". Frequency analysis bounds how fast light varies along a surface: shadows by the distance of the
blocker and the size of the light, indirect light by the distance of what its rays hit. Each pixel has a Gaussian as
wide as that allows, in the plane of the surface, applied along rows and then columns. Its standard deviation is

- 1/k max(σ s, 1/Ω) for direct light: σ is that of the light, s = d₁ / d₂ - 1 from its distances to the surface and to
  the blocker, 1/Ω the size of a pixel, k = 3;
- z / (2 · 2.8) for indirect light: z is the distance of what its rays hit. The Gaussian exp(-2 (2.8 d / z)²) is
  truncated at the exponent -4 and reaches surfaces nearer than z whose normals are within 5°. On a glossy surface of
  Phong exponent m, 3.5 + 0.2 m replaces 2.8.

As in SVGF's evaluation (Schied et al. 2017, §5.1), the light that it filters has been accumulated over frames.

We know the papers by their abstracts, others' accounts and, of the second, the authors' code. We choose:

- s and z are minima over 3 x 3 pixels of the same mesh: those of a single sample are too noisy, and would make filters
  narrower the darker the sample. Minima over more pixels would make filters narrower than light requires.
- μ, by which filters narrow as samples increase, is 1.
- The papers leave direct light unfiltered where nothing blocks it: there it is free of noise. Ours is noisy, so a
  lamp is treated as a surface that indirect light comes from: z = d₁, or less by a shadow.
- For direct light, a tap is weighted by the narrower Gaussian of both pixels, so that shadows, whose filters are
  narrow, do not leak to where filters are wide; for indirect light, by that of the receiving pixel, as in the paper.
- GGX roughness α corresponds to Phong's m = (1/α² - 1) / 2. All light of a surface is filtered by the width of its
  roughness, since lobes are not stored separately.
- Filters of direct light have the edge-stopping functions of indirect ones, with the z of the same width.
- No filter reaches farther than 50 px, the authors' limit; wider ones are narrowed.
"""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models import compiled
from models.compiled import aaf as kernels
from models.compiled.aaf import COSINE_OF_5_DEGREES, DIFFUSE_BAND, MAX_REACH, TRUNCATION
from models.denoiser import CLASSICAL, Denoiser, State, matching_state
from models.filters.atrous import Tap, offset_taps, window_mean
from models.filters.neighbours import mesh_min
from models.filters.svgf import SVGF, Integrated, integrate, irradiances
from models.history.geometry import frame_rays
from models.operators import MAX_LUMINANCE, MIN_DIVISOR

SHADOW_SHARPNESS = 3.0  # k
GLOSSY_BAND = 3.5
BAND_PER_EXPONENT = 0.2
MIN_ROUGHNESS = 1e-3
MIN_LIGHT_GAP = 2.0**-10  # between blocker and light, of the distance of the light: the rounding of float16


def band_limit(roughness: Tensor) -> Tensor:
    """Band limit, times the distance of what is reflected, of surfaces of GGX roughness (B, 1, H, W); 1 is diffuse."""
    exponent = (1 / roughness.clamp(MIN_ROUGHNESS, 1).square() - 1) / 2
    return torch.where(roughness < 1, GLOSSY_BAND + BAND_PER_EXPONENT * exponent, DIFFUSE_BAND)


def penumbra(frame: Frame) -> Tensor:
    """σ s (B, 1, H, W) of shadows in world units, from each pixel's own samples; 0 where nothing blocks them."""
    blocked = frame.hit_distance[:, 1:]
    share = blocked / torch.where(frame.light_distance > 0, frame.light_distance, torch.inf)
    return frame.light_angle * blocked / (1 - share).clamp(min=MIN_LIGHT_GAP)


def widths(frame: Frame) -> Tensor:
    """Standard deviations (B, 2, 1, H, W) of the Gaussians for direct and for indirect light, in world units."""
    focal_length = frame.now.K[:, 0, 0].abs().to(frame.depth)[:, None, None, None]
    size = frame.depth / focal_length  # of a pixel, on a surface that faces the camera
    penumbras = torch.where(frame.hit_distance[:, 1:] > 0, penumbra(frame), torch.inf)
    shadow = torch.maximum(mesh_min(penumbras, frame.mesh_id), size) / SHADOW_SHARPNESS
    distance = torch.cat([frame.light_distance, frame.hit_distance[:, :1]], dim=1)
    nearest = mesh_min(torch.where(distance > 0, distance, torch.inf), frame.mesh_id)
    lamp, indirect = (nearest / (2 * band_limit(frame.roughness))).split(1, dim=1)
    sigmas = torch.stack([torch.minimum(shadow, lamp), indirect], dim=1)
    return torch.minimum(sigmas, (MAX_REACH / TRUNCATION * size)[:, None])


def pack_geometry(frame: Frame) -> Tensor:
    """The geometry that weights depend on, (B, 1, 6, H, W), in world axes.

    Positions relative to the camera, unit normals (0 for background).
    """
    rotation = frame.now.camera_to_world[:, :3, :3].to(frame.depth)
    position = torch.einsum("bij,bhwj->bihw", rotation, frame_rays(frame)) * frame.depth
    unit = torch.where(frame.depth > 0, F.normalize(frame.normal, dim=1, eps=MIN_DIVISOR), 0)
    return torch.cat([position, unit], dim=1)[:, None]


def gaussian_weight(width: Tensor, p: Tensor, q: Tensor) -> Tensor:
    """Weights (..., 1, h, w) of taps by Gaussians of `width`, from the geometry (..., 6, h, w) at p and q."""
    difference = q[..., :3, :, :] - p[..., :3, :, :]
    normal = p[..., 3:, :, :]
    distance = difference.square().sum(dim=-3, keepdim=True)
    in_plane = distance - (difference * normal).sum(dim=-3, keepdim=True).square()
    exponent = in_plane.clamp(min=0) / (2 * width.square())
    same = (normal * q[..., 3:, :, :]).sum(dim=-3, keepdim=True) > COSINE_OF_5_DEGREES
    near = distance < (2 * DIFFUSE_BAND * width).square()
    return torch.where(same & near & (exponent <= TRUNCATION**2 / 2), (-exponent).exp(), 0)


@compiled.by(kernels.filter_lines)
def filter_lines(image: Tensor, width: Tensor, max_width: Tensor, geometry: Tensor, down: bool) -> Tensor:
    """Images (B, S, 3, H, W) filtered along rows, or `down` columns, by Gaussians of `width`, limited by the tap's."""

    def weight(tap: Tap) -> Tensor:
        narrower = torch.minimum(width[tap.p], max_width[tap.q])
        return gaussian_weight(narrower, geometry[tap.p], geometry[tap.q])

    along = range(-MAX_REACH, MAX_REACH + 1)
    taps = offset_taps(image.shape[-2:], *((along, [0]) if down else ([0], along)))
    return window_mean(image, 1, taps, weight)


@dataclass(frozen=True)
class AAFState(State):
    history: Integrated

    def pictures(self) -> dict[str, Tensor]:
        return {"history length": self.history.length}


class AAF(Denoiser):
    """Filters accumulated direct and indirect irradiance separately, each within its range since the last reset."""

    made_from = "abstracts, code"
    reads = (*SVGF.reads, "roughness", "hit_distance", "light_distance", "light_angle")
    refuses = CLASSICAL
    convex = True
    separates_lights = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, AAFState, frame)
        noisy = irradiances(frame, self.signal).clamp(-MAX_LUMINANCE, MAX_LUMINANCE)
        history = integrate(frame, noisy, previous.history if previous else None)
        image = history.colour
        width = widths(frame)[:, -image.shape[1] :]
        max_width = width.clone()
        max_width[:, -1] = torch.inf  # of indirect light
        geometry = pack_geometry(frame)
        for down in (False, True):
            image = filter_lines(image, width, max_width, geometry, down)
        return frame.remodulate(image.sum(dim=1), self.signal), AAFState(frame.moment, history)
