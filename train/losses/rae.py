"""The loss of RAE."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from models.denoiser import Denoiser, State
from models.networks.rae import RAE
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.sequences import Batch


def laplacian_of_gaussian(sigma: float = 1.5, size: int = 15) -> Tensor:
    """The kernel (size, size) of HFEN (Ravishankar and Bresler 2011): a sampled LoG, shifted to sum to zero."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    gaussian = torch.exp(-r2 / (2 * sigma**2))
    kernel = gaussian / gaussian.sum() * (r2 - 2 * sigma**2) / sigma**4
    return kernel - kernel.mean()


@dataclass(frozen=True)
class RAETerms(LossTerms):
    """Weights of the loss of RAE §4.4."""

    spatial: float = 0.8  # w_s
    gradient: float = 0.1  # w_g
    temporal: float = 0.1  # w_t
    frames: tuple[float, ...] = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)  # of a sequence, a Gaussian

    def around(self, denoiser: Denoiser) -> "RAELoss":
        assert isinstance(denoiser, RAE)
        return RAELoss(denoiser, self)


class RAELoss(NetworkLoss):
    """0.8 spatial L1 + 0.1 HFEN + 0.1 temporal L1, later frames weighted more (RAE §4.4).

    All in the space of the network: raw output p against (gain · exposure · irradiance)^0.2 of the reference.

    The paper's weights are for terms of about one scale, and it does not say which scale its HFEN has. Here the kernel
    has the norm 1: of errors that differ from pixel to pixel like white noise, HFEN is then as large as L1.
    """

    kernel: Tensor

    def __init__(self, denoiser: RAE, terms: RAETerms | None = None):
        super().__init__()
        self.denoiser: RAE = denoiser
        self.terms = terms or RAETerms()
        kernel = laplacian_of_gaussian()
        self.register_buffer("kernel", (kernel / kernel.norm()).float().repeat(3, 1, 1, 1), persistent=False)

    def edges(self, x: Tensor) -> Tensor:
        """LoG, of norm 1, of each of the three channels of x (B, 3, H, W), borders replicated, in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            margin = self.kernel.shape[-1] // 2
            return F.conv2d(F.pad(x, (margin,) * 4, mode="replicate"), self.kernel, groups=3)

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        terms = self.terms
        parts = {name: batch.frames[0].albedo.new_zeros(()) for name in ("spatial", "gradient", "temporal")}
        state: State | None = None
        before: Tensor | None = None  # the error of the frame before
        for frame, weight in zip(batch.frames, terms.frames, strict=True):
            p, state = self.denoiser.predict(frame, state)
            target = self.denoiser.compress(self.denoiser.target(frame), state.scale, frame)
            error = torch.where(frame.depth > 0, p - target, 0)
            errors = {"spatial": error, "gradient": self.edges(error)}
            if before is not None:  # |dP/dt - dT/dt| is the change of the error
                errors["temporal"] = error - before
            for name, each in errors.items():
                parts[name] = parts[name] + weight * surface_mean(each.abs(), frame.depth)
            before = error
        weights = {"spatial": terms.spatial, "gradient": terms.gradient, "temporal": terms.temporal}
        loss = torch.stack([weights[name] * part for name, part in parts.items()]).sum()
        return loss, {name: part.detach() for name, part in parts.items()}
