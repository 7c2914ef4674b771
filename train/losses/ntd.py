"""The loss of NTD."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import disoccluded
from datasets.sequences import Batch
from models.denoiser import Denoiser, State
from models.ntd import NTD
from train.losses.network_loss import LossTerms, NetworkLoss, Parts


@dataclass(frozen=True)
class NTDTerms(LossTerms):
    """The three equal parts of the loss of NTD §5, Eq. 6."""

    spatial: float = 1.0  # L_spat
    temporal: float = 1.0  # L_temp
    occlusion: float = 1.0  # L_occ
    masks: tuple[float, ...] = (1.0, 0.8, 0.6)  # w^0, w^1, w^2 of §4.4
    occlusion_start: float = 0.5  # of the epochs: L_occ joins for the last 100 of 200

    def around(self, denoiser: Denoiser) -> "NTDLoss":
        assert isinstance(denoiser, NTD)
        return NTDLoss(denoiser, self)


class NTDLoss(NetworkLoss):
    """Spatial L1 + temporal L1 + motion occlusion L1 (NTD Eq. 5, 6), means over frames, in the space of `compress`.

    The occlusion loss joins for the last part of the training, but always counts in validation, so that the best
    weights of all of it are comparable.
    """

    def __init__(self, denoiser: NTD, terms: NTDTerms | None = None):
        super().__init__()
        self.denoiser: NTD = denoiser
        self.terms = terms or NTDTerms()

    def masks(self, hidden: list[Tensor]) -> Tensor:
        """Sum of w^k M_{i-k} over k (Eq. 5), (B, 1, H, W).

        `hidden` has the masks M (B, 1, H, W) up to this frame's, the newest last. Frames before the first count as
        this one (§4.4).
        """
        return torch.stack(
            [w * hidden[-1 - k if k < len(hidden) else -1].float() for k, w in enumerate(self.terms.masks)]
        ).sum(dim=0)

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        terms = self.terms
        denoiser = self.denoiser
        hidden: list[Tensor] = []
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        occlusion: list[Tensor] = []
        state: State | None = None
        before: Tensor | None = None  # the error of the frame before
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
