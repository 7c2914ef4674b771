"""The loss of RAE."""

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor
from torch.nn import functional as F

from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, predictions, surface_mean
from train.protocols import CompressingNetwork


def laplacian_of_gaussian(sigma: float = 1.5, size: int = 15) -> Tensor:
    """The kernel (size, size) of HFEN (Ravishankar and Bresler 2011): a sampled LoG, shifted to sum to zero."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    gaussian = torch.exp(-r2 / (2 * sigma**2))
    kernel = gaussian / gaussian.sum() * (r2 - 2 * sigma**2) / sigma**4
    return kernel - kernel.mean()


@cache
def edge_kernel(device: torch.device) -> Tensor:
    """LoG of norm 1, for a convolution of three channels each by itself, (3, 1, 15, 15)."""
    kernel = laplacian_of_gaussian()
    return (kernel / kernel.norm()).float().repeat(3, 1, 1, 1).to(device)


def edges(x: Tensor) -> Tensor:
    """LoG, of norm 1, of each of the three channels of x (B, 3, H, W), borders replicated.

    In full precision: on CPUs, depthwise convolutions of 15 x 15 in bfloat16 take seconds.
    """
    with torch.autocast(x.device.type, enabled=False):
        kernel = edge_kernel(x.device)
        margin = kernel.shape[-1] // 2
        return F.conv2d(F.pad(x, (margin,) * 4, mode="replicate"), kernel, groups=3)


@dataclass(frozen=True)
class RAELoss(Loss):
    """0.8 spatial L1 + 0.1 HFEN + 0.1 temporal L1, later frames weighted more (RAE §4.4).

    All in the space of the network: raw output p against (gain · exposure · irradiance)^0.2 of the reference.

    The paper's weights are for terms of about one scale, and it does not say which scale its HFEN has. Here the kernel
    has the norm 1: of errors that differ from pixel to pixel like white noise, HFEN is then as large as L1.
    """

    spatial: float = 0.8  # w_s
    gradient: float = 0.1  # w_g
    temporal: float = 0.1  # w_t
    frames: tuple[float, ...] = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)  # of a sequence, a Gaussian

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        assert isinstance(network, CompressingNetwork)
        parts: Parts = {}
        before: Tensor | None = None  # the error of the frame before
        for (frame, p, scale), weight in zip(predictions(network, batch), self.frames, strict=True):
            target = network.compress(frame.reference_irradiance(network.signal), scale, frame)
            error = torch.where(frame.depth > 0, p - target, 0)
            errors = {"spatial": error, "gradient": edges(error)}
            if before is not None:  # |dP/dt - dT/dt| is the change of the error
                errors["temporal"] = error - before
            for name, each in errors.items():
                parts[name] = parts.get(name, error.new_zeros(())) + weight * surface_mean(each.abs(), frame.depth)
            before = error
        weights = {"spatial": self.spatial, "gradient": self.gradient, "temporal": self.temporal}
        return torch.stack([weights[name] * part for name, part in parts.items()]).sum(), parts
