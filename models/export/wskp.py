"""WSKP (models/networks/wskp.py) as a step: accumulation, network and shared kernels in one graph.

The box sums of all windows (models/networks/fusion.py) are two convolutions.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.compiled.accumulation import MIN_ALPHA
from models.compiled.exponential import MIN_EXPONENT
from models.compiled.fusion import OUTSIDE_LOGIT, SAFE_RANGE, WINDOWS
from models.export.history import updated_scale
from models.export.step import Step, Warp, bounded, demodulation, image
from models.networks.repvgg import RepVGGBlock
from models.networks.wskp import WSKP, feature_images
from models.operators import MIN_DIVISOR

SUMMED = 4  # channels of each window's sums: weighted red, green and blue, and the weights
WINDOW_MARGIN = max(WINDOWS) // 2


def in_windows() -> Tensor:
    """Whether a tap lies in a window, (M, k), k the largest of M windows. Computed, for branches hold no constants."""
    offset = torch.arange(max(WINDOWS)) - WINDOW_MARGIN
    return torch.stack([offset.abs() <= window // 2 for window in WINDOWS])


def box_sums(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
    """Sums (1, SUMMED M, H, W) over each window, weighted by exp(importance - (high + low) / 2)."""
    weights = torch.exp(importance - (high + low) / 2)
    products = (weights[:, :, None] * values[:, None]).flatten(1, 2)
    # Columns of ones in zeros, (SUMMED M, 1, k, 1): each channel's own box.
    boxes = in_windows().float()[:, None].expand(-1, SUMMED, -1).flatten(0, 1)
    columns = boxes[:, None, :, None]
    sums = F.conv2d(products, columns, padding=(WINDOW_MARGIN, 0), groups=len(columns))
    return F.conv2d(sums, columns.transpose(2, 3), padding=(0, WINDOW_MARGIN), groups=len(columns))


def box_sums_by_maximum(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
    """Box sums (1, SUMMED M, H, W) relative to the largest importance in every window, off surfaces left out.

    `values` are 0 there. Columns are summed, then rows of these.
    """
    logits = torch.where(surface > 0, importance, OUTSIDE_LOGIT).transpose(0, 1)
    images: Sequence[Tensor] = values.split(1, dim=1)
    inside = in_windows()[..., None, None]
    column = torch.eye(max(WINDOWS))[:, None, :, None]  # the neighbours of a pixel become its channels
    for kernel, (y, x) in ((column, (WINDOW_MARGIN, 0)), (column.transpose(2, 3), (0, WINDOW_MARGIN))):
        entries = F.conv2d(F.pad(logits, (x, x, y, y), value=OUTSIDE_LOGIT), kernel)
        entries = torch.where(inside, entries, OUTSIDE_LOGIT)
        logits = entries.amax(dim=1, keepdim=True)
        weights = torch.exp((entries - logits).clamp(min=MIN_EXPONENT)) * (entries > OUTSIDE_LOGIT)
        images = [(weights * F.conv2d(each, kernel, padding=(y, x))).sum(dim=1, keepdim=True) for each in images]
    return torch.cat([*images], dim=1).flatten(0, 1)[None]


def fuse(irradiance: Tensor, importance: Tensor, mixture: Tensor, surface: Tensor) -> Tensor:
    """models.networks.fusion.fuse with all WINDOWS for B = 1, exact for any finite logits.

    `surface` (1, 1, H, W) is 1 for pixels that count, else 0. Logits spanning at most SAFE_RANGE, as those of trained
    networks do, are shifted as a whole. Others take a slower branch, which needs the memory of some hundred images.
    """
    values = torch.cat([irradiance * surface, surface], dim=1)
    high = importance.amax(dim=(2, 3), keepdim=True)
    low = importance.amin(dim=(2, 3), keepdim=True)
    within_range = (high - low).max() <= SAFE_RANGE
    sums = torch.cond(within_range, box_sums, box_sums_by_maximum, (importance, values, surface, high, low))
    sums = sums.unflatten(1, (len(WINDOWS), SUMMED))
    shares = torch.exp(mixture - mixture.amax(dim=1, keepdim=True))  # engines take softmax along channels slowly
    factors = shares[:, :, None] / sums[:, :, 3:].clamp(min=MIN_DIVISOR)
    return (factors * sums[:, :, :3]).sum(dim=1) / shares.sum(dim=1, keepdim=True)


def plain_convolutions(network: nn.Module) -> nn.Module:
    """The merged network with plain convolutions: pairs of pixels are fast on processors only."""
    for block in network.modules():
        if isinstance(block, RepVGGBlock) and block.merged is not None:
            outputs, inputs, size, _ = block.merged.weight.shape
            plain = nn.Conv2d(inputs, outputs, size, padding=size // 2, dtype=block.merged.weight.dtype)
            plain.load_state_dict(block.merged.state_dict())
            block.merged = plain
    return network.requires_grad_(False)


class WSKPStep(Step):
    """wskp3 or wskp6. The denoiser is prepared for inference and must not be used afterwards."""

    reads = ("noisy", "emission", "albedo", "normal", "depth")
    history = image("history", 4, "accumulated irradiance, linear RGB, and its length in frames")

    def __init__(self, denoiser: WSKP, warp: Warp):
        super().__init__(denoiser, warp)
        self.features = tuple(denoiser.inputs)
        self.network = plain_convolutions(denoiser.network)

    def forward(self, x: dict[str, Tensor]) -> dict[str, Tensor]:
        x = bounded(x)
        noisy, divisor, surface = demodulation(x)
        history, frames = self.reprojected_history(x).split([3, 1], dim=1)
        length = frames + 1
        # Without a history its length is 0: the weight of the newest frame is 1.
        irradiance = history + (1 / length).clamp(min=MIN_ALPHA) * (noisy - history)
        radiance = irradiance * divisor
        state, exposure, depth = updated_scale(x["scale"], radiance, x["depth"])
        features = feature_images(radiance * exposure, x["albedo"], x["normal"], depth, self.features)
        predicted = self.network(features.to(self.precision)).to(radiance)
        importance, mixture = predicted.chunk(2, dim=1)
        filtered = fuse(irradiance, importance, mixture, surface)
        return {
            "radiance": filtered * divisor * surface + x["emission"],
            "new_history": torch.cat([irradiance, length], dim=1),
            "new_scale": state,
        }
