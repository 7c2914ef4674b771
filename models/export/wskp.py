"""WSKP (models/networks/wskp.py) as a step: accumulation, network and shared kernels in one graph.

The box sums of all windows (models/networks/fusion.py) are two convolutions.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.compiled.accumulation import MIN_ALPHA
from models.compiled.exponential import MIN_EXPONENT
from models.compiled.features import GAMMA
from models.compiled.fusion import OUTSIDE_LOGIT, SAFE_RANGE, WINDOWS
from models.export.history import Scale, updated_scale
from models.export.step import Step, Warp, demodulation, image
from models.networks.repvgg import RepVGGBlock
from models.networks.wskp import WSKP, scaled_normal
from models.operators import MIN_DIVISOR

SUMMED = 4  # channels of each window's sums: weighted red, green and blue, and the weights


def in_windows(windows: Sequence[int]) -> Tensor:
    """Whether a tap lies in a window, (M, k), k the largest of M windows. Computed, for branches hold no constants."""
    largest = max(windows)
    offset = torch.arange(largest) - largest // 2
    return torch.stack([offset.abs() <= window // 2 for window in windows])


def box_sums_by_maximum(logits: Tensor, values: Sequence[Tensor], windows: Sequence[int]) -> Tensor:
    """Box sums (M, C, H, W) relative to the largest of the logits (M, 1, H, W) in every window.

    `values` are C images (1, 1, H, W), 0 where the logits are OUTSIDE_LOGIT. Columns are summed, then rows of these.
    """
    inside = in_windows(windows)[..., None, None]
    largest = max(windows)
    margin = largest // 2
    column = torch.eye(largest)[:, None, :, None]  # the neighbours of a pixel become its channels
    for kernel, (y, x) in ((column, (margin, 0)), (column.transpose(2, 3), (0, margin))):
        entries = F.conv2d(F.pad(logits, (x, x, y, y), value=OUTSIDE_LOGIT), kernel)
        entries = torch.where(inside, entries, OUTSIDE_LOGIT)
        logits = entries.amax(dim=1, keepdim=True)
        weights = torch.exp((entries - logits).clamp(min=MIN_EXPONENT)) * (entries > OUTSIDE_LOGIT)
        values = [(weights * F.conv2d(each, kernel, padding=(y, x))).sum(dim=1, keepdim=True) for each in values]
    return torch.cat(list(values), dim=1)


class BoxWindows(nn.Module):
    """models.networks.fusion.fuse for B = 1, exact for any finite logits.

    Logits spanning at most SAFE_RANGE, as those of trained networks do, are shifted as a whole. Others take a slower
    branch, which needs the memory of some hundred images.
    """

    def __init__(self, windows: Sequence[int]):
        super().__init__()
        self.windows = tuple(windows)

    def forward(self, irradiance: Tensor, importance: Tensor, mixture: Tensor, surface: Tensor) -> Tensor:
        """Filtered irradiance (1, 3, H, W). `surface` (1, 1, H, W) is 1 for pixels that count, else 0."""
        margin = max(self.windows) // 2
        groups = SUMMED * len(self.windows)
        height, width = irradiance.shape[-2:]
        values = torch.cat([irradiance * surface, surface], dim=1)
        high = importance.amax(dim=(2, 3), keepdim=True)
        low = importance.amin(dim=(2, 3), keepdim=True)

        def shifted(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
            weights = torch.exp(importance - (high + low) / 2)
            products = (weights[:, :, None] * values[:, None]).flatten(1, 2)
            # Columns of ones in zeros, (SUMMED M, 1, k, 1): each channel's own box.
            boxes = in_windows(self.windows).float()[:, None].expand(-1, SUMMED, -1).flatten(0, 1)
            columns = boxes[:, None, :, None]
            sums = F.conv2d(products, columns, padding=(margin, 0), groups=groups)
            return F.conv2d(sums, columns.transpose(2, 3), padding=(0, margin), groups=groups)

        def by_maximum(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
            logits = torch.where(surface > 0, importance, OUTSIDE_LOGIT).transpose(0, 1)
            return box_sums_by_maximum(logits, values.split(1, dim=1), self.windows).flatten(0, 1)[None]

        within_range = (high - low).max() <= SAFE_RANGE
        sums = torch.cond(within_range, shifted, by_maximum, (importance, values, surface, high, low))
        sums = sums.view(1, len(self.windows), SUMMED, height, width)
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
    history = image("history", 4, None, "accumulated irradiance, linear RGB, and its length in frames")

    def __init__(self, denoiser: WSKP, warp: Warp):
        super().__init__(denoiser, warp)
        self.features = tuple(denoiser.inputs)
        self.network = plain_convolutions(denoiser.network)
        self.fusion = BoxWindows(WINDOWS)

    def network_features(self, x: dict[str, Tensor], radiance: Tensor, scale: Scale) -> Tensor:
        """models.networks.wskp.network_features of accumulated `radiance`."""
        features = {
            "colour": (radiance * scale.exposure).clamp(0, 1) ** (1 / GAMMA),
            "albedo": x["albedo"],
            "normal": scaled_normal(x["normal"]),
            "depth": scale.normalised_depth(x["depth"]),
        }
        return torch.cat([features[name] for name in self.features], dim=1)

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        x = tensors
        noisy, divisor, surface = demodulation(x)
        history, frames = self.reprojected_history(x).split([3, 1], dim=1)
        length = frames + 1
        # Without a history its length is 0: the weight of the newest frame is 1.
        irradiance = history + (1 / length).clamp(min=MIN_ALPHA) * (noisy - history)
        radiance = irradiance * divisor
        state, scale = updated_scale(x["scale"], radiance, x["depth"])
        predicted = self.network(self.network_features(x, radiance, scale).to(self.precision)).to(radiance)
        importance, mixture = predicted.chunk(2, dim=1)
        filtered = self.fusion(irradiance, importance, mixture, surface)
        return {
            "radiance": filtered * divisor * surface + x["emission"],
            "new_history": torch.cat([irradiance, length], dim=1),
            "new_scale": state,
        }
