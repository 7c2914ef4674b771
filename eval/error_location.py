"""`onespp eval --where`: shares of the squared error by place, roughness, brightness and scale.

Errors are those of displayed images. Their square is the product of the differences to both buffers of the reference,
(x - A)(x - B), whose mean is the squared error without noise of the reference, where that is too weak for clipping and
gamma to bias A and B.
"""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import torch
from tabulate import tabulate
from torch import Tensor
from torch.nn import functional as F

from datasets.clip import Clip, Dataset
from datasets.frame import Frame, Signal, to_tensor
from datasets.tonemap import display
from eval.clip_run import play
from eval.selection import evaluated
from models.operators import finite, image_luminance
from models.spec import DenoiserSpec

PLACE_CHANNELS = ("depth", "normal", "mesh_id", "roughness")
CREASE_COSINE = 0.94  # between normals of adjacent pixels, 20 degrees
SMOOTH_ALPHA, ROUGH_ALPHA = 0.1, 0.3  # GGX alpha
DARK_BELOW, BRIGHT_FROM = 0.25, 0.75  # displayed luminance
ERROR_SCALES = (1, 4, 16)  # px

Shares = dict[tuple[str, str], Tensor]  # by (question, answer)


def beside(differs: Tensor, dim: int) -> Tensor:
    """The pixels (1, 1, H, W) on either side of adjacent ones that differ, along `dim`."""
    before, after = ((1, 0), (0, 1)) if dim == -1 else ((0, 0, 1, 0), (0, 0, 0, 1))
    return F.pad(differs, before) | F.pad(differs, after)


def places(frame: Frame, reference: Tensor) -> Shares:
    """Masks (1, 1, H, W) of a frame's pixels; `reference` (1, 3, H, W) is as displayed."""
    edge = torch.zeros_like(frame.mesh_id, dtype=torch.bool)
    crease = torch.zeros_like(edge)
    for dim in (-1, -2):
        length = edge.shape[dim] - 1
        a, b = (frame.normal.narrow(dim, start, length) for start in (0, 1))
        edge |= beside(frame.mesh_id.diff(dim=dim) != 0, dim)
        crease |= beside((a * b).sum(dim=1, keepdim=True) < CREASE_COSINE, dim)
    crease &= ~edge
    surface = frame.depth > 0
    alpha, y = frame.roughness, image_luminance(reference)
    return {
        ("place", "mesh edges"): edge,
        ("place", "creases"): crease & surface,
        ("place", "inside"): ~edge & ~(crease & surface),
        ("roughness", f"α ≤ {SMOOTH_ALPHA}"): surface & (alpha <= SMOOTH_ALPHA),
        ("roughness", f"to {ROUGH_ALPHA}"): surface & (alpha > SMOOTH_ALPHA) & (alpha <= ROUGH_ALPHA),
        ("roughness", "rougher"): surface & (alpha > ROUGH_ALPHA),
        ("roughness", "background"): ~surface,
        ("displayed", f"below {DARK_BELOW}"): y < DARK_BELOW,
        ("displayed", f"to {BRIGHT_FROM}"): (y >= DARK_BELOW) & (y < BRIGHT_FROM),
        ("displayed", "brighter"): y >= BRIGHT_FROM,
    }


def by_scale(error_a: Tensor, error_b: Tensor) -> Shares:
    """Sums of the squared error (1, 3, H, W) of details smaller than 4 and 16 pixels, and of the rest."""
    height, width = (side - side % ERROR_SCALES[-1] or side for side in error_a.shape[-2:])
    sums = []
    for scale in ERROR_SCALES:
        block = min(scale, height), min(scale, width)
        a, b = (F.avg_pool2d(error[..., :height, :width], block) for error in (error_a, error_b))
        sums.append((a * b).sum() * (block[0] * block[1]))
    fine, middle, coarse = sums
    names = (f"below {ERROR_SCALES[1]} px", f"to {ERROR_SCALES[2]} px", "larger")
    return {("scale", name): sum for name, sum in zip(names, (fine - middle, middle - coarse, coarse), strict=True)}


def squared_errors(output: Tensor, buffers: Tensor, masks: Shares) -> Shares:
    """Sums of the squared error of a displayed image (1, 3, H, W), by place and by scale; `buffers` (2, 3, H, W)."""
    a, b = (output - buffer for buffer in buffers.split(1))
    product = (a * b).sum(dim=1, keepdim=True)
    return {key: product[mask].sum() for key, mask in masks.items()} | by_scale(a, b)


def normalised(sums: Shares) -> Shares:
    """Sums over the total of their question; 0 where there is no error at all."""
    totals = {question: sum(v for key, v in sums.items() if key[0] == question) for question, _ in sums}
    return {key: value / totals[key[0]] if totals[key[0]] else torch.zeros(()) for key, value in sums.items()}


@torch.no_grad()
def error_shares(clip: Clip, specs: Sequence[DenoiserSpec]) -> dict[str, Shares]:
    """Shares of the pixels, as "pixels", and of each denoiser's squared error, in the judged frames of a clip."""
    denoisers = {spec.name: spec.build() for spec in specs}
    signals: set[Signal] = {"total", *(denoiser.signal for denoiser in denoisers.values())}
    sums: dict[str, Shares] = {name: defaultdict(lambda: torch.zeros(())) for name in ("pixels", *denoisers)}
    for index, frame, outputs in play(clip, [*denoisers.values()], PLACE_CHANNELS):
        if index not in clip.judged:
            continue
        references = {signal: to_tensor(clip.reference(index, signal), has_buffers=True)[0] for signal in signals}
        buffers = {signal: display(pair, clip.exposure).double() for signal, pair in references.items()}
        masks = places(frame, buffers["total"].mean(dim=0, keepdim=True))
        for (name, denoiser), output in zip(denoisers.items(), outputs, strict=True):
            shown = display(finite(output), clip.exposure).double()
            for key, error in squared_errors(shown, buffers[denoiser.signal], masks).items():
                sums[name][key] = sums[name][key] + error
        for key, mask in masks.items():
            sums["pixels"][key] = sums["pixels"][key] + mask.sum()
    return {name: normalised(shares) for name, shares in sums.items()}


def where(
    data: Sequence[Path], runs: Path, budget: str, names: Sequence[str], device: str = "cpu", first_hits: bool = False
) -> str:
    """A table for each test clip. Raises BadInput as `onespp eval` does."""
    clips = [clip for path in data for clip in Dataset(path).clips("test", first_hits)]
    specs = evaluated(names, runs, budget, device, clips)
    tables = []
    for clip in clips:
        shares = error_shares(clip, specs)
        keys = dict.fromkeys(key for each in shares.values() for key in each)
        columns = shares.values()
        lines = [
            [*key, *(f"{100 * float(each[key]):.0f} %" if key in each else "" for each in columns)] for key in keys
        ]
        tables.append(f"{clip.scene}/{clip.name}\n" + tabulate(lines, ["", "", *shares], disable_numparse=True))
    return "\n\n".join(tables)
