"""NFOR: nonlinearly weighted first-order regression (Bitterli et al. 2016).

Two images of half of the samples each, A and B, are filtered alike. In a window around every pixel, A's colours are
fitted by a function that is linear in features, with NL-means weights computed on B; the output is the weighted mean of
all fits whose windows contain the pixel (§5.2). This is done with two bandwidths; the difference between the filtered A
and B estimates which of them has the smaller error at a pixel (§5.3). The mean of both filtered images is fitted once
more (§5.4).

Where the paper leaves it open, we choose:

- Features are normal, albedo and depth, divided by the frame's largest depth; as in the authors' code, fits are linear
  in the position, too. Features are free of noise, so prefiltering them (§5.1, §5.4) would change nothing and is left
  out.
- It filters irradiance. The paper filters radiance; but the buffers of a frame of one sample per pixel take samples
  from neighbours, which have another albedo.
- Those buffers are a checkerboard's: each has the samples of its squares, and in the others the mean of the four
  adjacent samples of the same mesh. So no sample is in both, except where a mesh has no pixel beside this one.
- The variance of the noise is the squared difference of A and B over 4, averaged over 9 x 9 pixels of the same mesh.
- The distance of patches is the mean of that of their pixels, over colours and over where both show surfaces.
- The bandwidths' errors are means over colours, so that one choice is made for all three.
- A ridge term regularises fits where features do not vary: far below their usual variance, above float16's rounding.
- Negative results of extrapolation are clamped to 0.
"""

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models.denoiser import CLASSICAL, Denoiser, State
from models.filters.neighbours import mesh_means, taps_3x3, taps_on_mesh
from models.operators import MIN_DIVISOR

REACH = 9  # R, px: windows of 19 x 19
WINDOW_SIDE = 2 * REACH + 1
MAX_PIXEL_DISTANCE = 1e4  # of two pixels; weights are 0 long before
MAX_DISTANCE = 1e30  # of patches: from what is no surface
MIN_SQUARED_NOISE = 1e-20  # of squared differences of colours, where there is no noise
RIDGE = 1e-5  # of the sum of weights, in squared units of features
MAX_FITTED = 1e13  # irradiance; fits extrapolate it, and squares of that must stay finite
BANDWIDTHS = (0.5, 1.0)  # k, of the first pass
PATCH_RADIUS = 3  # F, px: patches of 7 x 7
SMALL_PATCH_RADIUS = 1  # where errors and choices are smoothed
FITTED_PIXELS = 256  # fitted at once, as whole rows: all taps of all features are gathered


def window_rows(image: Tensor) -> Iterator[Tensor]:
    """The taps of all pixels' windows, row by row: (B, WINDOW_SIDE, C, H, W); 0 outside the image (B, C, H, W)."""
    padded = F.pad(image, (REACH,) * 4)
    for dy in range(WINDOW_SIDE):
        yield padded[..., dy : dy + image.shape[-2], :].unfold(-1, WINDOW_SIDE, 1).movedim(-1, 1)


def box_means(image: Tensor, side: int) -> Tensor:
    """Means of (..., H, W) over windows of side², of which what is outside the image counts as 0."""
    along = F.avg_pool2d(image.flatten(0, -3), (1, side), stride=1, padding=(0, side // 2))
    return F.avg_pool2d(along, (side, 1), stride=1, padding=(side // 2, 0)).view_as(image)


def patch_distances(guide: Tensor, variance: Tensor, surface: Tensor, radius: int) -> Tensor:
    """Distances (B, WINDOW², H, W) >= 0, in units of noise, of the patch around every pixel to those around its taps.

    `variance` is that of the noise in `guide`, both (B, 3, H, W). A pixel that shows no `surface` (B, 1, H, W) is
    MAX_DISTANCE from all others. As by Rousselle et al. 2013, whose k comes with the weights: exp(-distance / k²).
    """
    side = 2 * radius + 1
    rows = []
    for taps in window_rows(torch.cat([guide, variance, surface], dim=1)):
        there, noise, surface_there = taps.split([3, 3, 1], dim=2)
        off = (guide[:, None] - there).square() - (variance[:, None] + torch.minimum(variance[:, None], noise))
        apart = (off / (MIN_SQUARED_NOISE + variance[:, None] + noise)).clamp(max=MAX_PIXEL_DISTANCE).mean(dim=2)
        both = surface * surface_there[:, :, 0]
        total, count = box_means(apart * both, side), box_means(both, side)
        rows.append(torch.where(both > 0, (total / count.clamp(min=side**-2)).clamp(min=0), MAX_DISTANCE))
    return torch.cat(rows, dim=1)


def nl_means(image: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """Means of the image (B, C, H, W) with weights exp(-distance / bandwidth²); 0 off surfaces."""
    weights = torch.exp(-distances / bandwidth**2)
    sums = torch.zeros_like(image)
    for weight, taps in zip(weights.split(WINDOW_SIDE, dim=1), window_rows(image), strict=True):
        sums += (weight[:, :, None] * taps).sum(dim=1)
    return sums / weights.sum(dim=1, keepdim=True).clamp(min=1)  # a pixel's weight for itself is 1


def regress(image: Tensor, features: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """Collaborative regression of the image (B, 3, H, W) on features (B, F, H, W) and position, weighted so."""
    height, width = image.shape[-2:]
    count = features.shape[1]
    steps = torch.linspace(-1, 1, WINDOW_SIDE).to(image)
    positions = torch.cartesian_prod(steps, steps).T
    padded = F.pad(torch.cat([features, image], dim=1), (REACH,) * 4)
    sums = torch.zeros_like(padded[:, :4])
    for rows in torch.arange(height).split(max(1, FITTED_PIXELS // width)):
        strip = slice(int(rows[0]), int(rows[-1]) + 1)
        wide = slice(strip.start, strip.stop + 2 * REACH)
        taps = F.unfold(padded[:, :, wide], WINDOW_SIDE).mT.unflatten(2, (-1, WINDOW_SIDE**2))  # (B, N, F + 3, taps)
        apart = taps[:, :, :count] - features[:, :, strip].flatten(2).mT[..., None]
        position = positions.expand(*apart.shape[:2], -1, -1)
        x = torch.cat([torch.ones_like(apart[:, :, :1]), position, apart], dim=2).double()
        weight = torch.exp(-distances[:, :, strip].flatten(2) / bandwidth**2).mT[:, :, None].double()
        weighted = weight * x
        moments = weighted @ x.mT
        moments.diagonal(dim1=-2, dim2=-1)[..., 1:] += RIDGE * moments[..., :1, 0].clamp_(min=1)
        fit = torch.cholesky_solve(weighted @ taps[:, :, count:].double().mT, torch.linalg.cholesky(moments))
        predicted = torch.cat([weight * (fit.mT @ x), weight], dim=2).flatten(2).mT
        sums[:, :, wide] += F.fold(predicted.to(image), (wide.stop - wide.start, sums.shape[-1]), WINDOW_SIDE)
    inside = sums[..., REACH:-REACH, REACH:-REACH]
    return inside[:, :3] / inside[:, 3:].clamp(min=1)


def checkerboard_buffers(colour: Tensor, mesh_id: Tensor) -> Tensor:
    """Sample buffers A and B (B, 2, 3, H, W): each has every other pixel of colour (B, 3, H, W), between them means."""
    beside = taps_3x3(colour, 1)[:, :, 1::2]
    same = taps_on_mesh(mesh_id, 1)[:, :, 1::2]
    count = same.sum(dim=2)
    mean = torch.where(count > 0, torch.where(same, beside, 0).sum(dim=2) / count.clamp(min=1), colour)
    height, width = colour.shape[-2:]
    black = (torch.arange(height)[:, None] + torch.arange(width)).to(colour.device) % 2 == 0
    return torch.stack([torch.where(black, colour, mean), torch.where(black, mean, colour)], dim=1)


def variance_of_mean(buffers: Tensor) -> Tensor:
    """Estimated variance (B, 3, H, W) of the mean of two independent buffers (B, 2, 3, H, W)."""
    return (buffers[:, 0] - buffers[:, 1]).square() / 4


def first_pass(buffers: Tensor, variance: Tensor, features: Tensor, surface: Tensor) -> Tensor:
    """The filtered buffers (B, 2, 3, H, W), at each pixel by the better bandwidth (§5.2, §5.3)."""
    a, b = buffers.unbind(dim=1)
    to_a, to_b = (patch_distances(buffer, 2 * variance, surface, PATCH_RADIUS) for buffer in (a, b))
    smoothing = patch_distances(buffers.mean(dim=1), variance, surface, SMALL_PATCH_RADIUS)
    filtered = []
    errors = []
    for bandwidth in BANDWIDTHS:
        smooth = torch.stack([regress(a, features, to_b, bandwidth), regress(b, features, to_a, bandwidth)], dim=1)
        error = (smooth - buffers.flip(1)).square().mean(dim=1) - 2 * variance - variance_of_mean(smooth)
        errors.append(nl_means(error.mean(dim=1, keepdim=True), smoothing, 1.0))
        filtered.append(smooth)
    chosen = nl_means((errors[1] < errors[0]).to(a), smoothing, 1.0)
    return torch.lerp(filtered[0], filtered[1], chosen[:, None])


def nfor(buffers: Tensor, variance: Tensor, features: Tensor, surface: Tensor) -> Tensor:
    """The denoised image (B, 3, H, W) of two sample buffers (B, 2, 3, H, W) whose noise is independent.

    `variance` (B, 3, H, W) is that of the noise in their mean, `features` are (B, F, H, W), free of noise, in [-1, 1].
    Pixels that show no `surface` (B, 1, H, W) are ignored, and 0 in the output.
    """
    filtered = first_pass(buffers, variance, features, surface)
    mean = filtered.mean(dim=1)
    return regress(mean, features, patch_distances(mean, variance_of_mean(filtered), surface, PATCH_RADIUS), 1.0)


def features_of(frame: Frame) -> Tensor:
    """Normal, albedo and relative depth, which fits are linear in: (B, 7, H, W) in [-1, 1]."""
    max_depth = frame.depth.amax((2, 3), keepdim=True).clamp(min=MIN_DIVISOR)
    depth = (frame.depth / max_depth).clamp(0, 1)
    return torch.cat([frame.normal.clamp(-1, 1), frame.albedo.clamp(0, 1), depth], dim=1)


class NFOR(Denoiser):
    """Filters each frame by itself, in seconds: a yardstick of quality."""

    made_from = "paper, code"
    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id")
    refuses = CLASSICAL
    offline = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        colour = frame.irradiance(self.signal).clamp(-MAX_FITTED, MAX_FITTED)
        buffers = checkerboard_buffers(colour, frame.mesh_id)
        _, variance, _ = mesh_means(variance_of_mean(buffers), frame.mesh_id)
        denoised = nfor(buffers, variance, features_of(frame), (frame.depth > 0).to(colour))
        return frame.remodulate(denoised.clamp(min=0), self.signal), State(frame.moment)
