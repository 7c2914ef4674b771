"""Losses, named after their papers. Each is a module around the network it trains, so that one loop serves all."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import disoccluded
from datasets.sequences import Batch
from models.denoiser import Denoiser, State
from models.ntd import NTD
from models.rae import RAE
from models.wskp import KernelPredictor
from train.accumulated import Crops
from train.recipes import NTDTerms, RAETerms, Recipe, SMAPETerms

Parts = dict[str, Tensor]  # of a loss by name: scalars, detached, to display


class NetworkLoss(nn.Module):
    """Runs a network over a batch and returns the loss to back-propagate, through time where there are sequences.

    forward(batch) returns the loss (scalar) and its parts. `progress` is how far the training has come, 0 to 1.
    """

    denoiser: Denoiser
    progress: float = 0.0

    def forward(self, batch: Any) -> tuple[Tensor, Parts]:
        raise NotImplementedError


def laplacian_of_gaussian(sigma: float = 1.5, size: int = 15) -> Tensor:
    """The kernel (size, size) of HFEN (Ravishankar and Bresler 2011): a sampled LoG, shifted to sum to zero."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    gaussian = torch.exp(-r2 / (2 * sigma**2))
    kernel = gaussian / gaussian.sum() * (r2 - 2 * sigma**2) / sigma**4
    return kernel - kernel.mean()


class RAELoss(NetworkLoss):
    """0.8 spatial L1 + 0.1 HFEN + 0.1 temporal L1, later frames weighted more (RAE §4.4).

    All in the space of the network: raw output p against (gain · exposure · irradiance)^0.2 of the reference.
    """

    kernel: Tensor

    def __init__(self, denoiser: RAE, terms: RAETerms | None = None):
        super().__init__()
        self.denoiser: RAE = denoiser
        self.terms = terms or RAETerms()
        self.register_buffer("kernel", laplacian_of_gaussian().float().repeat(3, 1, 1, 1), persistent=False)

    def edges(self, x: Tensor) -> Tensor:
        """LoG of each of the three channels, borders replicated, in full precision."""
        with torch.autocast(x.device.type, enabled=False):
            margin = self.kernel.shape[-1] // 2
            return F.conv2d(F.pad(x, (margin,) * 4, mode="replicate"), self.kernel, groups=3)

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        terms = self.terms
        parts = {name: batch.frames[0].albedo.new_zeros(()) for name in ("spatial", "gradient", "temporal")}
        state: State | None = None
        errors: list[Tensor] = []
        for frame, weight in zip(batch.frames, terms.frames, strict=True):
            p, state = self.denoiser.predict(frame, state)
            error = p - self.denoiser.compress(self.denoiser.target(frame), state.scale, frame)
            parts["spatial"] = parts["spatial"] + weight * error.abs().mean()
            parts["gradient"] = parts["gradient"] + weight * self.edges(error).abs().mean()
            if errors:  # |dP/dt - dT/dt| is the change of the error
                parts["temporal"] = parts["temporal"] + weight * (error - errors[-1]).abs().mean()
            errors.append(error)
        weights = {"spatial": terms.spatial, "gradient": terms.gradient, "temporal": terms.temporal}
        loss = torch.stack([weights[name] * part for name, part in parts.items()]).sum()
        return loss, {name: part.detach() for name, part in parts.items()}


def smape(x: Tensor, reference: Tensor, epsilon: float) -> Tensor:
    """Mean of |x - r| / (|x| + |r| + epsilon) over all pixels and channels (WSKP Eq. 6), in [0, 1)."""
    return ((x - reference).abs() / (x.abs() + reference.abs() + epsilon)).mean()


class SMAPELoss(NetworkLoss):
    """SMAPE of HDR radiance (WSKP §5.2), emission included.

    Radiance is scaled by the causal exposure, so that epsilon means the same in whatever units a scene is lit.
    """

    def __init__(self, denoiser: KernelPredictor, terms: SMAPETerms | None = None):
        super().__init__()
        self.denoiser: KernelPredictor = denoiser
        self.terms = terms or SMAPETerms()

    def forward(self, batch: Crops) -> tuple[Tensor, Parts]:
        signal, frame = self.denoiser.signal, batch.frame
        filtered, _ = self.denoiser.filter(frame, batch.irradiance, batch.scale)
        exposure = batch.scale.exposure()
        images = (filtered, frame.reference_irradiance(signal))
        output, reference = (exposure * frame.remodulate(image, signal) for image in images)
        return smape(output, reference, self.terms.epsilon), {}


class NTDLoss(NetworkLoss):
    """Spatial L1 + temporal L1 + motion occlusion L1 (NTD Eq. 5, 6), means over frames, in the space of `compress`.

    The occlusion loss joins for the last part of the training, but always counts in validation, so that the best
    weights of all of it are comparable.
    """

    def __init__(self, denoiser: NTD, terms: NTDTerms | None = None):
        super().__init__()
        self.denoiser: NTD = denoiser
        self.terms = terms or NTDTerms()

    def masks(self, motions: list[Tensor]) -> Tensor:
        """Sum of w^k M_{i-k} over k (Eq. 5), (B, 1, H, W), of the masks up to this frame's, the newest last.

        Frames before the first count as this one (§4.4).
        """
        return torch.stack(
            [w * motions[-1 - k if k < len(motions) else -1].float() for k, w in enumerate(self.terms.masks)]
        ).sum(dim=0)

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        terms, denoiser = self.terms, self.denoiser
        hidden: list[Tensor] = []
        spatial, temporal, occlusion = [], [], []
        state: State | None = None
        before: Tensor | None = None
        for frame in batch.frames:
            irradiance, state = denoiser.predict(frame, state)
            images = (irradiance, frame.reference_irradiance(denoiser.signal))
            output, target = (denoiser.compress(image, state.scale, frame) for image in images)
            error = output - target
            spatial.append(error.abs().mean())
            if before is not None:
                temporal.append((error - before).abs().mean())
            before = error
            if terms.occlusion:
                hidden.append(disoccluded(frame.motion, frame.dual_motion))
                occlusion.append((error.abs() * self.masks(hidden)).mean())
        parts = {
            name: torch.stack(values).mean() if values else error.new_zeros(())
            for name, values in (("spatial", spatial), ("temporal", temporal), ("occlusion", occlusion))
        }
        starts = not self.training or self.progress >= terms.occlusion_start
        weights = {"spatial": terms.spatial, "temporal": terms.temporal, "occlusion": terms.occlusion * starts}
        loss = torch.stack([weights[name] * part for name, part in parts.items() if weights[name]]).sum()
        return loss, {name: part.detach() for name, part in parts.items()}


LOSSES: dict[type, Any] = {RAETerms: RAELoss, SMAPETerms: SMAPELoss, NTDTerms: NTDLoss}


def loss_for(denoiser: Denoiser, recipe: Recipe) -> NetworkLoss:
    """The loss of a recipe around the network that it trains."""
    return LOSSES[type(recipe.loss)](denoiser, recipe.loss)
