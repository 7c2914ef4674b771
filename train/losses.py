"""Losses, named after their papers. Each is a module around the network it trains, so that one loop serves all."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.sequences import Batch
from models.denoiser import Denoiser, State
from models.rae import RAE


class SequenceLoss(nn.Module):
    """Runs a network over a sequence and returns the loss to back-propagate through time.

    forward(batch) returns the loss (scalar) and its parts by name (scalars, detached), for display.
    """

    denoiser: Denoiser

    def forward(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        raise NotImplementedError


def laplacian_of_gaussian(sigma: float = 1.5, size: int = 15) -> Tensor:
    """The kernel (size, size) of HFEN (Ravishankar and Bresler 2011): a sampled LoG, shifted to sum to zero."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    gaussian = torch.exp(-r2 / (2 * sigma**2))
    kernel = gaussian / gaussian.sum() * (r2 - 2 * sigma**2) / sigma**4
    return kernel - kernel.mean()


class RAELoss(SequenceLoss):
    """0.8 spatial L1 + 0.1 HFEN + 0.1 temporal L1, later frames weighted more (RAE §4.4).

    All in the space of the network: raw output p against (gain · exposure · irradiance)^0.2 of the reference.
    """

    spatial, gradient, temporal = 0.8, 0.1, 0.1
    frame_weights = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)
    kernel: Tensor

    def __init__(self, denoiser: RAE):
        super().__init__()
        self.denoiser: RAE = denoiser
        self.register_buffer("kernel", laplacian_of_gaussian().float().repeat(3, 1, 1, 1), persistent=False)

    def edges(self, x: Tensor) -> Tensor:
        """LoG of each of the three channels, borders replicated, in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            margin = self.kernel.shape[-1] // 2
            return F.conv2d(F.pad(x, (margin,) * 4, mode="replicate"), self.kernel, groups=3)

    def forward(self, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        signal = self.denoiser.signal
        parts = {name: batch.frames[0].albedo.new_zeros(()) for name in ("spatial", "gradient", "temporal")}
        state: State | None = None
        errors: list[Tensor] = []
        for frame, weight in zip(batch.frames, self.frame_weights, strict=True):
            p, state = self.denoiser.predict(frame, state)
            error = p - self.denoiser.compress(frame.reference_irradiance(signal), state.scale, frame)
            parts["spatial"] = parts["spatial"] + weight * error.abs().mean()
            parts["gradient"] = parts["gradient"] + weight * self.edges(error).abs().mean()
            if errors:  # |dP/dt - dT/dt| is the change of the error
                parts["temporal"] = parts["temporal"] + weight * (error - errors[-1]).abs().mean()
            errors.append(error)
        loss = self.spatial * parts["spatial"] + self.gradient * parts["gradient"] + self.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}


LOSSES: dict[str, Callable[..., SequenceLoss]] = {"rae": RAELoss}


def loss_for(denoiser: Denoiser, name: str) -> SequenceLoss:
    """The loss that the paper of denoiser `name` trains it with."""
    return LOSSES[name](denoiser)
