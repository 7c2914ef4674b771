"""The loss of WSKP."""

from dataclasses import dataclass

from torch import Tensor

from models.denoiser import Denoiser
from models.networks.wskp import KernelPredictor
from train.crops import Crops
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean


def smape(x: Tensor, reference: Tensor, epsilon: float) -> Tensor:
    """|x - r| / (|x| + |r| + epsilon) of every pixel and channel (WSKP Eq. 6), in [0, 1)."""
    return (x - reference).abs() / (x.abs() + reference.abs() + epsilon)


def exposed_images(denoiser: KernelPredictor, crops: Crops) -> tuple[Tensor, Tensor]:
    """What a network makes of accumulated crops and the reference, as exposed radiance, emission included."""
    signal = denoiser.signal
    frame = crops.frame
    filtered, _ = denoiser.filter(frame, crops.irradiance, crops.scale)
    exposure = crops.scale.exposure()
    output, reference = (frame.remodulate(image, signal) for image in (filtered, frame.reference_irradiance(signal)))
    return exposure * output, exposure * reference


@dataclass(frozen=True)
class SMAPETerms(LossTerms):
    """The loss of WSKP §5.2, Eq. 6."""

    epsilon: float = 0.01

    def around(self, denoiser: Denoiser) -> "SMAPELoss":
        assert isinstance(denoiser, KernelPredictor)
        return SMAPELoss(denoiser, self)


class SMAPELoss(NetworkLoss):
    """SMAPE of HDR radiance (WSKP §5.2), emission included.

    Radiance is scaled by the causal exposure, so that epsilon means the same in whatever units a scene is lit.
    """

    def __init__(self, denoiser: KernelPredictor, terms: SMAPETerms | None = None):
        super().__init__()
        self.denoiser: KernelPredictor = denoiser
        self.terms = terms or SMAPETerms()

    def forward(self, batch: Crops) -> tuple[Tensor, Parts]:
        output, reference = exposed_images(self.denoiser, batch)
        return surface_mean(smape(output, reference, self.terms.epsilon), batch.frame.depth), {}
