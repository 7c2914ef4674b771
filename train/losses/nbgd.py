"""The loss of NBGD."""

from dataclasses import dataclass

from torch import Tensor

from models.denoiser import Denoiser
from models.networks.nbgd import NBGD
from train.crops import Crops
from train.losses.displayed import cut_tone
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.losses.wskp import exposed_images


@dataclass(frozen=True)
class NBGDTerms(LossTerms):
    """The loss of NBGD, which has no parameters."""

    def around(self, denoiser: Denoiser) -> "NBGDLoss":
        assert isinstance(denoiser, NBGD)
        return NBGDLoss(denoiser, self)


class NBGDLoss(NetworkLoss):
    """L1 of radiance as displayed, cut at white (Meng et al. 2020), emission included.

    Radiance has the causal exposure; the authors' renderings come exposed.
    """

    def __init__(self, denoiser: NBGD, terms: NBGDTerms | None = None):
        super().__init__()
        self.denoiser: NBGD = denoiser
        self.terms = terms or NBGDTerms()

    def forward(self, batch: Crops) -> tuple[Tensor, Parts]:
        output, reference = exposed_images(self.denoiser, batch)
        return surface_mean((cut_tone(output) - cut_tone(reference)).abs(), batch.frame.depth), {}
