"""The loss of NTD."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import disoccluded
from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, predictions, surface_mean
from train.protocols import CompressingNetwork

MIN_OCCLUDED = 1e-3  # share of a sequence's pixels: the mean over fewer would be noise, and is that share of them


def masked_mean(values: Tensor, masks: Tensor) -> Tensor:
    """Mean of `values` (B, 3 F, H, W) over the pixels where `masks` (B, F, H, W) is not 0; items count the same."""
    count = (masks > 0).sum(dim=(1, 2, 3)).clamp(min=MIN_OCCLUDED * masks[0].numel())
    return (values.sum(dim=(1, 2, 3)) / (3 * count)).mean()


@dataclass(frozen=True)
class NTDLoss(Loss):
    """Spatial L1 + temporal L1 + motion occlusion L1 (NTD Eq. 5, 6), means over frames, in the space of `compress`.

    "They are all L1 loss and have equal weight" (§5): the occlusion loss is the mean over the pixels of a sequence that
    the masks let through, few as they are. Over all pixels it would be near nothing beside the others.

    The occlusion loss joins for the last part of the training, but always counts in validation, so that the best
    weights of all of it are comparable.
    """

    spatial: float = 1.0  # L_spat
    temporal: float = 1.0  # L_temp
    occlusion: float = 1.0  # L_occ
    masks: tuple[float, ...] = (1.0, 0.8, 0.6)  # w^0, w^1, w^2 of §4.4
    occlusion_start: float = 0.5  # of the epochs: L_occ joins for the last 100 of 200

    def mask(self, hidden: list[Tensor]) -> Tensor:
        """Sum of w^k M_{i-k} over k (Eq. 5), (B, 1, H, W).

        `hidden` has the masks M (B, 1, H, W) up to this frame's, the newest last. Frames before the first count as
        this one (§4.4).
        """
        return torch.stack(
            [w * hidden[-1 - k if k < len(hidden) else -1].float() for k, w in enumerate(self.masks)]
        ).sum(dim=0)

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        assert isinstance(network, CompressingNetwork)
        hidden: list[Tensor] = []
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        occluded: list[Tensor] = []
        masks: list[Tensor] = []
        before: Tensor | None = None  # the error of the frame before
        for frame, irradiance, scale in predictions(network, batch):
            images = (irradiance, frame.reference_irradiance(network.signal))
            output, target = (network.compress(image, scale, frame) for image in images)
            error = torch.where(frame.depth > 0, output - target, 0)
            spatial.append(surface_mean(error.abs(), frame.depth))
            if before is not None:
                temporal.append(surface_mean((error - before).abs(), frame.depth))
            before = error
            if self.occlusion:
                hidden.append(disoccluded(frame.motion, frame.dual_motion))
                masks.append(self.mask(hidden))
                occluded.append(error.abs() * masks[-1])
        nothing = error.new_zeros(())
        parts = {
            "spatial": torch.stack(spatial).mean(),
            "temporal": torch.stack(temporal).mean() if temporal else nothing,
            "occlusion": masked_mean(torch.cat(occluded, dim=1), torch.cat(masks, dim=1)) if masks else nothing,
        }
        starts = progress >= self.occlusion_start
        weights = {"spatial": self.spatial, "temporal": self.temporal, "occlusion": self.occlusion * starts}
        return torch.stack([weights[name] * part for name, part in parts.items() if weights[name]]).sum(), parts
