"""RAE: the recurrent denoising autoencoder of Chaitanya et al. 2017."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models.denoiser import Denoiser, State, matching_state
from models.history.running_scale import RunningScale, running_scale
from models.operators import pad_to_multiple

POWER = 0.2  # §4.4: inputs and targets are raised to it before anything else
SLOPE = 0.1  # §5.3: leaky ReLU
MIN_SLOPE_AT = 0.01  # exposed irradiance, below which `raised` has no flatter slope
ENCODER = (32, 32, 43, 57, 76, 101, 101)  # widths: 4/3 after each subsampling (§5.1), but not 135 at the last
DECODER = ((76, 76), (57, 57), (43, 43), (32, 32), (128, 64))
RAE_INPUTS = {"colour": 3, "normal": 2, "depth": 1, "roughness": 1}  # of the network, and their channels (§3.2)


def conv(inputs: int, outputs: int) -> nn.Conv2d:
    """A 3 x 3 convolution with He initialisation for leaky ReLU (§5.3)."""
    layer = nn.Conv2d(inputs, outputs, 3, padding=1)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


def activate(x: Tensor) -> Tensor:
    return F.leaky_relu(x, SLOPE, inplace=True)


def raised(p: Tensor) -> Tensor:
    """max(p, 0)^5, exposed irradiance of the raw output p, with a gradient that does not vanish at p <= 0.

    Its slope is that of p^5, but never less than where p^5 = MIN_SLOPE_AT: darker than that, errors are not relative
    any more. A slope of another size, whatever the target, keeps the minimiser: a zero of the loss's gradient.
    """
    value = p.detach().clamp(min=0) ** (1 / POWER)
    slope = p.detach().clamp(min=MIN_SLOPE_AT**POWER) ** (1 / POWER - 1) / POWER
    return value + slope * (p - p.detach())


class RecurrentBlock(nn.Module):
    """h_i = O_i = C(C(C(I_i) ++ h_{i-1})) (§4.2), ++ concatenation."""

    def __init__(self, width: int):
        super().__init__()
        self.input, self.merge, self.output = conv(width, width), conv(2 * width, width), conv(width, width)

    def forward(self, x: Tensor, hidden: Tensor | None) -> Tensor:
        x = activate(self.input(x))
        hidden = torch.zeros_like(x) if hidden is None else hidden.to(x.dtype)
        return activate(self.output(activate(self.merge(torch.cat([x, hidden], dim=1)))))


class RecurrentAutoencoder(nn.Module):
    """The network of Fig. 2: images whose sides are multiples of 32 in, images of the same size out.

    36 convolutions: 7 in the encoder, 3 in each of 6 recurrent blocks, 10 in the decoder, one linear output layer.
    """

    def __init__(self, inputs: int):
        super().__init__()
        widths = ENCODER[1:]  # after the second convolution of full resolution, one width a resolution
        self.first = conv(inputs, ENCODER[0])
        self.encoder = nn.ModuleList(conv(a, b) for a, b in pairwise(ENCODER))
        self.recurrent = nn.ModuleList(RecurrentBlock(width) for width in widths)
        below = (widths[-1], *(out for _, out in DECODER))
        self.decoder = nn.ModuleList(
            nn.Sequential(conv(a + skip, middle), nn.LeakyReLU(SLOPE, inplace=True), conv(middle, out))
            for a, skip, (middle, out) in zip(below, widths[-2::-1], DECODER, strict=False)
        )
        self.output = conv(below[-1], 3)

    def forward(self, x: Tensor, hidden: Sequence[Tensor] | None) -> tuple[Tensor, tuple[Tensor, ...]]:
        """Output (B, 3, H, W) and the new hidden features, finest first."""
        features: list[Tensor] = []
        x = activate(self.first(x))
        for level, (encode, recur) in enumerate(zip(self.encoder, self.recurrent, strict=True)):
            if level:
                x = F.max_pool2d(x, 2)
            x = recur(activate(encode(x)), hidden[level] if hidden else None)
            features.append(x)
        for skip, decode in zip(features[-2::-1], self.decoder, strict=True):
            x = activate(decode(torch.cat([F.interpolate(x, scale_factor=2.0), skip], dim=1)))
        return self.output(x), tuple(features)


@dataclass(frozen=True)
class RAEState(State):
    """Hidden features, finest first, (B, w, H / 2^k, W / 2^k), and the running exposure and depth scale."""

    hidden: tuple[Tensor, ...]
    scale: RunningScale


class RAE(Denoiser):
    """Denoises irradiance from 7 channels: irradiance, view-space normal x and y, depth, roughness (§3.2)."""

    made_from = "paper"
    reads: tuple[str, ...] = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness")
    is_network = True
    has_kernels = False
    dispensable: ClassVar = {"roughness": nn.Identity()}
    inputs = RAE_INPUTS
    first_layer = "network.first"

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        network = RecurrentAutoencoder(sum(RAE_INPUTS.values()))
        self.network = network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, RAEState]:
        """The raw output p (B, 3, H, W), which estimates (gain · exposure · irradiance)^0.2, and the next state."""
        height, width = frame.size
        before = matching_state(state, RAEState, frame)
        irradiance = frame.irradiance(self.signal).clamp(min=0)
        scale = running_scale(irradiance * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        parts = {
            "colour": self.compress(irradiance, scale, frame),
            "normal": frame.view_normal()[:, :2],
            "depth": scale.normalised_depth(frame.depth),
            "roughness": frame.roughness,
        }
        x = pad_to_multiple(torch.cat([parts[name] for name in self.inputs], dim=1), 32)
        x = x.to(self.precision, memory_format=torch.channels_last)
        p, hidden = self.network(x, before.hidden if before else None)
        return p[..., :height, :width].to(irradiance.dtype), RAEState(frame.moment, hidden, scale)

    def exposed(self, prediction: Tensor, exposure: Tensor) -> Tensor:
        return raised(prediction)

    def compress(self, irradiance: Tensor, scale: RunningScale, frame: Frame) -> Tensor:
        """Irradiance (B, 3, H, W) into the network's space: (gain · exposure · irradiance)^0.2."""
        return (irradiance * scale.exposure() * frame.gain) ** POWER

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        p, state = self.predict(frame, state)
        irradiance = p.clamp(min=0) ** (1 / POWER) / (state.scale.exposure() * frame.gain)
        return frame.remodulate(irradiance, self.signal), state
