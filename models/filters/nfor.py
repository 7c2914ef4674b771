"""NFOR: nonlinearly weighted first-order regression (Bitterli et al. 2016).

Two images of half of the samples each, A and B, are filtered alike. Around every pixel, A's colours are fitted by a
function that is linear in features, with weights that NL-means takes from B; what a pixel becomes is the weighted mean
of all fits whose windows hold it (§5.2). This happens with two bandwidths, and how far the filtered A is from B tells
which one errs less at which pixel (§5.3). The mean of the filtered halves is fitted once more (§5.4).

Where the paper leaves it open, we choose:

- Features are normal, albedo and depth, in units of the frame's largest; as in the authors' code, fits are linear in
  the position, too. Features are free of noise, so that filtering them beforehand (§5.1, §5.4) would change nothing and
  is left out.
- It filters irradiance. The paper filters radiance; but the halves of a frame of one sample a pixel take samples from
  neighbours, which have another albedo.
- Those halves are a chequerboard's: each has the samples of its squares, and in the others the mean of the four samples
  around, of the same mesh. So no sample is in both halves, but where a mesh has no pixel beside this one.
- The variance of the noise is the squared difference of the halves over 4, averaged over 9 x 9 pixels of the own mesh.
- Patches are as far from each other as their pixels are, on average over colours and over where both show surfaces.
- The bandwidths' errors are means over colours, so that one choice is made for all three.
- A ridge holds fits where features do not vary: far below their usual variance, above what float16 rounds them by.
- What fits extrapolate below 0 is cut.
"""

from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models import compiled
from models.compiled import nfor as kernels
from models.denoiser import CLASSICAL, Denoiser, State
from models.filters.neighbours import mesh_means, shifted
from models.parameters import (
    EPSILON_L,
    FARTHEST,
    LARGEST_DISTANCE,
    LARGEST_FITTED,
    LEAST_DIVISOR,
    REACH,
    RIDGE,
    WINDOW,
)

BANDWIDTHS = (0.5, 1.0)  # k, of the first pass
PATCH = 3  # F, px: patches of 7 x 7
SMALL_PATCH = 1  # where errors and choices are smoothed
STRIP_PIXELS = 2048  # fitted at once, as whole rows: all taps of all features are gathered


def around(image: Tensor) -> Iterator[Tensor]:
    """The image (..., H, W) as seen from all pixels at each place of the window, row by row; 0 outside of it."""
    height, width = image.shape[-2:]
    padded = F.pad(image, (REACH,) * 4)
    for dy, dx in product(range(WINDOW), repeat=2):
        yield padded[..., dy : dy + height, dx : dx + width]


@compiled.by(kernels.patch_distances)
def patch_distances(guide: Tensor, variance: Tensor, surface: Tensor, radius: int) -> Tensor:
    """Distances (B, WINDOW², H, W) >= 0, in units of noise, of the patch around every pixel to those around its taps.

    `variance` is that of the noise in `guide`, both (B, 3, H, W). A pixel that shows no `surface` (B, 1, H, W) is
    FARTHEST from all others. As by Rousselle et al. 2013, whose k comes with the weights: exp(-distance / k²).
    """
    side = 2 * radius + 1
    found = []
    for taps in around(torch.cat([guide, variance, surface], dim=1)):
        there, noise, surface_there = taps.split([3, 3, 1], dim=1)
        off = (guide - there).square() - (variance + torch.minimum(variance, noise))
        apart = (off / (EPSILON_L + variance + noise)).clamp(max=LARGEST_DISTANCE).mean(dim=1, keepdim=True)
        both = surface * surface_there
        total, count = (F.avg_pool2d(image, side, stride=1, padding=radius) for image in (apart * both, both))
        found.append(torch.where(both > 0, (total / count.clamp(min=side**-2)).clamp(min=0), FARTHEST))
    return torch.cat(found, dim=1)


@compiled.by(kernels.nl_means)
def nl_means(image: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """Means of the image (B, C, H, W) with weights exp(-distance / bandwidth²); 0 off surfaces."""
    weights = torch.exp(-distances / bandwidth**2)
    sums = torch.zeros_like(image)
    for weight, taps in zip(weights.split(1, dim=1), around(image), strict=True):
        sums.addcmul_(weight, taps)
    return sums / weights.sum(dim=1, keepdim=True).clamp(min=1)  # a pixel's weight for itself is 1


@compiled.by(kernels.regress)
def regress(image: Tensor, features: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """Collaborative regression of the image (B, 3, H, W), linear in features (B, F, H, W) and position; 0 off surfaces.

    Weights are exp(-distance / bandwidth²).
    """
    height, width = image.shape[-2:]
    count = features.shape[1]
    steps = torch.linspace(-1, 1, WINDOW).to(image)
    position = torch.cartesian_prod(steps, steps).T[None, :, :, None]
    padded = F.pad(torch.cat([features, image], dim=1), (REACH,) * 4)
    sums = torch.zeros_like(padded[:, :4])
    for rows in torch.arange(height).split(max(1, STRIP_PIXELS // width)):
        strip = slice(int(rows[0]), int(rows[-1]) + 1)
        wide = slice(strip.start, strip.stop + 2 * REACH)
        taps = F.unfold(padded[:, :, wide], WINDOW).unflatten(1, (-1, WINDOW**2))
        known = taps[:, :count] - features[:, :, strip].flatten(2)[:, :, None]
        shape = (len(image), -1, *known.shape[2:])
        x = (
            torch.cat([torch.ones_like(known[:, :1]), position.expand(shape), known], dim=1)
            .permute(0, 3, 2, 1)
            .double()
        )
        y = taps[:, count:].permute(0, 3, 2, 1).double()
        weight = torch.exp(-distances[:, :, strip].flatten(2) / bandwidth**2).mT[..., None].double()
        weighted = (weight * x).mT
        moments = weighted @ x
        total = moments[..., :1, 0].clamp_(min=1)
        moments.diagonal(dim1=-2, dim2=-1)[..., 1:] += RIDGE * total
        fit = torch.cholesky_solve(weighted @ y, torch.linalg.cholesky(moments))
        predicted = torch.cat([weight * (x @ fit), weight], dim=-1).permute(0, 3, 2, 1).flatten(1, 2)
        sums[:, :, wide] += F.fold(predicted.to(image), (wide.stop - wide.start, sums.shape[-1]), WINDOW)
    inside = sums[..., REACH:-REACH, REACH:-REACH]
    return inside[:, :3] / inside[:, 3:].clamp(min=1)


def chequered_halves(colour: Tensor, mesh_id: Tensor) -> Tensor:
    """Two images (B, 2, 3, H, W) of colour (B, 3, H, W): each has half of its pixels, and means of their neighbours."""
    beside = shifted(colour, 1)[:, :, 1::2]
    same = shifted(mesh_id + 1, 1)[:, :, 1::2] == mesh_id[:, :, None] + 1
    count = same.sum(dim=2)
    mean = torch.where(count > 0, torch.where(same, beside, 0).sum(dim=2) / count.clamp(min=1), colour)
    height, width = colour.shape[-2:]
    black = (torch.arange(height)[:, None] + torch.arange(width)).to(colour.device) % 2 == 0
    return torch.stack([torch.where(black, colour, mean), torch.where(black, mean, colour)], dim=1)


def spread(halves: Tensor) -> Tensor:
    """What two halves (B, 2, 3, H, W) tell of the variance of their mean, (B, 3, H, W)."""
    return (halves[:, 0] - halves[:, 1]).square() / 4


def first_pass(halves: Tensor, variance: Tensor, features: Tensor, surface: Tensor) -> Tensor:
    """The filtered halves (B, 2, 3, H, W), at each pixel by the better bandwidth (§5.2, §5.3)."""
    a, b = halves.unbind(dim=1)
    to_a, to_b = (patch_distances(half, 2 * variance, surface, PATCH) for half in (a, b))
    smoothing = patch_distances(halves.mean(dim=1), variance, surface, SMALL_PATCH)
    filtered = []
    errors = []
    for bandwidth in BANDWIDTHS:
        smooth = torch.stack([regress(a, features, to_b, bandwidth), regress(b, features, to_a, bandwidth)], dim=1)
        error = (smooth - halves.flip(1)).square().mean(dim=1) - 2 * variance - spread(smooth)
        errors.append(nl_means(error.mean(dim=1, keepdim=True), smoothing, 1.0))
        filtered.append(smooth)
    chosen = nl_means((errors[1] < errors[0]).to(a), smoothing, 1.0)
    return torch.lerp(filtered[0], filtered[1], chosen[:, None])


def nfor(halves: Tensor, variance: Tensor, features: Tensor, surface: Tensor) -> Tensor:
    """The denoised image (B, 3, H, W) of two halves (B, 2, 3, H, W) whose noise is independent.

    `variance` (B, 3, H, W) is that of the noise in their mean, `features` are (B, F, H, W), free of noise, in [-1, 1].
    Pixels that show no `surface` (B, 1, H, W) take part in nothing and come out as 0.
    """
    filtered = first_pass(halves, variance, features, surface)
    mean = filtered.mean(dim=1)
    return regress(mean, features, patch_distances(mean, spread(filtered), surface, PATCH), 1.0)


def features_of(frame: Frame) -> Tensor:
    """What fits are linear in, (B, 7, H, W) in [-1, 1]."""
    furthest = frame.depth.amax((2, 3), keepdim=True).clamp(min=LEAST_DIVISOR)
    return torch.cat([frame.normal.clamp(-1, 1), frame.albedo.clamp(0, 1), (frame.depth / furthest).clamp(0, 1)], dim=1)


class NFOR(Denoiser):
    """Filters each frame by itself, in seconds: a yardstick of quality."""

    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id")
    refuses = CLASSICAL
    offline = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        colour = frame.irradiance(self.signal).clamp(-LARGEST_FITTED, LARGEST_FITTED)
        halves = chequered_halves(colour, frame.mesh_id)
        _, variance, _ = mesh_means(spread(halves), frame.mesh_id)
        surface = (frame.depth > 0).to(colour)
        denoised = nfor(halves, variance, features_of(frame), surface).clamp(min=0)
        return frame.remodulate(denoised, self.signal), State(frame.moment)
