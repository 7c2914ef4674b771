"""WSKP (models/networks/wskp.py) as a step: accumulation, network and shared kernels in one graph."""

import torch
from torch import Tensor, nn

from models.compiled.accumulation import MIN_ALPHA
from models.compiled.features import GAMMA
from models.export.box_windows import BoxWindows
from models.export.recurrent import RecurrentStep, demodulation
from models.export.scale import Scale, updated_scale
from models.export.step import Warp, image
from models.networks.repvgg import RepVGGBlock
from models.networks.wskp import WSKP

READS = ("noisy", "emission", "albedo", "normal", "depth")
HISTORY = image("history", 4, "accumulated irradiance, linear RGB, and its length in frames")


def plain_convolutions(network: nn.Module) -> nn.Module:
    """The merged network with plain convolutions: our pairs of pixels are for our processors."""
    for block in network.modules():
        if isinstance(block, RepVGGBlock) and block.merged is not None:
            outputs, inputs, size, _ = block.merged.weight.shape
            plain = nn.Conv2d(inputs, outputs, size, padding=size // 2, dtype=block.merged.weight.dtype)
            plain.load_state_dict(block.merged.state_dict())
            block.merged = plain
    return network.requires_grad_(False)


class WSKPStep(RecurrentStep):
    """wskp3 or wskp6, prepared for inference, which must not be used any more."""

    def __init__(self, denoiser: WSKP, warp: Warp):
        super().__init__(READS, HISTORY, warp)
        self.precision = denoiser.precision
        self.seen = tuple(denoiser.inputs)
        self.network = plain_convolutions(denoiser.network)
        self.fusion = BoxWindows(denoiser.windows)

    def features(self, x: dict[str, Tensor], radiance: Tensor, scale: Scale) -> Tensor:
        """models.networks.features.network_features of accumulated `radiance`."""
        features = {
            "colour": (radiance * scale.exposure).clamp(0, 1) ** (1 / GAMMA),
            "albedo": x["albedo"],
            "normal": x["normal"] / 2 + 0.5,
            "depth": scale.normalised_depth(x["depth"]),
        }
        return torch.cat([features[name] for name in self.seen], dim=1)

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        x = tensors
        noisy, divisor, surface = demodulation(x)
        past, frames = self.past(x).split([3, 1], dim=1)
        length = frames + 1
        # Without a history its length is 0: the weight of the newest frame is 1.
        irradiance = past + (1 / length).clamp(min=MIN_ALPHA) * (noisy - past)
        radiance = irradiance * divisor
        state, scale = updated_scale(x["scale"], radiance, x["depth"])
        predicted = self.network(self.features(x, radiance, scale).to(self.precision)).to(radiance)
        importance, mixture = predicted.chunk(2, dim=1)
        filtered = self.fusion(irradiance, importance, mixture, surface)
        return {
            "radiance": filtered * divisor * surface + x["emission"],
            "new_history": torch.cat([irradiance, length], dim=1),
            "new_scale": state,
        }
