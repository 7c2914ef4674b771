"""The loss of `one`: each frame's error as displayed, at several scales, and how that changes from frame to frame."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.sequences import Batch
from models.denoiser import Denoiser, State
from models.one import One
from models.parameters import GAMMA
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean

DARKEST = 1e-4  # exposed radiance, below which the curve is no steeper


def tone(radiance: Tensor) -> Tensor:
    """Exposed radiance as a display shows it, about in [0, 1]; what is brighter than white goes on as its logarithm."""
    shown = (radiance.clamp(0, 1) + DARKEST) ** (1 / GAMMA)
    return shown + torch.log(radiance.clamp(min=1)) / GAMMA


def shrunk(radiance: Tensor, surface: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """The means over the surfaces in blocks of scale x scale pixels (B, 3, h, w), and where there are any."""
    if scale == 1:
        return radiance, surface
    share = F.avg_pool2d(surface, scale, ceil_mode=True)
    mean = F.avg_pool2d(radiance * surface, scale, ceil_mode=True)
    return mean / share.clamp(min=1e-6), share


@dataclass(frozen=True)
class OneTerms(LossTerms):
    """Weights of its parts, and the scales in pixels.

    A network that is only compared pixel by pixel to noisy references learns their median, which is too dark where
    light is rare. Means over blocks have hardly any noise left: they keep the energy, and they are where blotches show.
    """

    temporal: float = 0.25
    scales: tuple[int, ...] = (1, 4, 16)

    def around(self, denoiser: Denoiser) -> "OneLoss":
        assert isinstance(denoiser, One)
        return OneLoss(denoiser, self)


class OneLoss(NetworkLoss):
    """L1 of what is displayed: of each scale, and of changes. Radiance is scaled by the network's own exposure."""

    def __init__(self, denoiser: One, terms: OneTerms | None = None):
        super().__init__()
        self.denoiser: One = denoiser
        self.terms = terms or OneTerms()

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        denoiser = self.denoiser
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        state: State | None = None
        before: Tensor | None = None  # output minus target of the last frame, as displayed
        for frame in batch.frames:
            irradiance, state = denoiser.predict(frame, state)
            exposure = state.scale.exposure() * frame.gain * frame.divisor
            surface = (frame.depth > 0).to(irradiance)
            output = exposure * irradiance
            target = exposure * frame.reference_irradiance(denoiser.signal)
            for scale in self.terms.scales:
                small, share = shrunk(output, surface, scale)
                error = tone(small) - tone(shrunk(target, surface, scale)[0])
                spatial.append(surface_mean(error.abs(), share))
            error = tone(output) - tone(target)
            if before is not None:
                temporal.append(surface_mean((error - before).abs(), frame.depth))
            before = error
        parts = {"spatial": torch.stack(spatial).mean() * len(self.terms.scales)}
        parts["temporal"] = torch.stack(temporal).mean() if temporal else torch.zeros(())
        loss = parts["spatial"] + self.terms.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}
