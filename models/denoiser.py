"""The one interface of everything that denoises."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, TypeVar, cast

import torch
from torch import Tensor, nn

from datasets.channels import SECOND
from datasets.frame import Frame, Moment, Signal
from errors import BadInput
from models.layers import blended, composed, main_layer, second_layer, second_share


@dataclass(frozen=True)
class State:
    """What a denoiser carries from frame to frame; each has its own subclass."""

    moment: Moment  # of the frame that it follows

    def pictures(self) -> dict[str, Tensor]:
        """Images for debugging, by name with units: (B, 1 or 3, H, W)."""
        return {}


@dataclass(frozen=True)
class LayeredState(State):
    """The states of both layers of glass."""

    main: State
    second: State

    def pictures(self) -> dict[str, Tensor]:
        return self.main.pictures()


# Why filters without a network compute in float32 only.
CLASSICAL = {dtype: "it has no network, and its sums need float32" for dtype in (torch.bfloat16, torch.float16)}

CONSTANT_TOLERANCE = 1e-3  # of a channel that counts as constant: more than float16 rounds

S = TypeVar("S", bound=State)


def matching_state(state: State | None, kind: type[S], frame: Frame) -> S | None:
    """The state if it is of `kind` and the frame follows it, else None."""
    return state if isinstance(state, kind) and frame.follows(state.moment) else None


@torch.no_grad()
def drop_inputs(layer: nn.Conv2d, first: int, values: Tensor) -> None:
    """Remove the inputs from `first` on, which always have these `values`, from a convolution."""
    last = first + len(values)
    assert layer.bias is not None
    layer.bias += layer.weight[:, first:last].sum(dim=(2, 3)) @ values
    kept = torch.cat([layer.weight[:, :first], layer.weight[:, last:]], dim=1)
    layer.weight = nn.Parameter(kept.contiguous(memory_format=torch.channels_last))  # as the images are
    layer.in_channels -= len(values)


class Denoiser(nn.Module):
    """One frame in, linear HDR radiance out.

    Facts of a denoiser are attributes of its class; wrappers (models/wrappers) take over those of the wrapped denoiser.
    `registry.prototype` returns an instance without weights to read them from.

    Attributes:
        reads: channels it needs; nothing else is loaded, rendered or stored for it.
        signal: what it returns: "total" or "indirect" light.
        refuses: precisions that it does not compute in, with the reason.
        made_from: what its implementation follows, for tables: others' papers, their authors' code, accounts of either.
        is_network: whether it needs trained weights.
        offline: whether a frame takes seconds: commands that run all denoisers run it only where it is named.
        convex: whether output irradiance is a weighted mean of irradiance since the last reset, with weights >= 0.
        separates_lights: whether it filters direct and indirect light apart.
        filters_emission: whether emission is a part of what it filters, which it otherwise adds back untouched.
        blends_layers: whether it takes glass in one layer, with guides blended from both, instead of twice.
        has_kernels: whether compiled kernels do a part of its work.
        baseline_for: the signals whose denoisers are compared with it, in evaluations, cards and trade-offs.
        evaluated_with: suffixes with which `onespp eval` runs it beside the denoiser itself.
        dispensable: channels that its network can do without where they do not vary, and its input for a value.
        inputs: the inputs of its network in order, and how many channels each has; channels by their names.
        constants: channels that it does without, see `specialise`, and the value that each has everywhere.
        precision: what its network computes in, see `prepare`. Frames, states' images and outputs are always float32.
        device: "cpu" or "cuda", where it was moved to: frames have to be there, and its output is.
    """

    reads: tuple[str, ...]
    signal: Signal = "total"
    refuses: Mapping[torch.dtype, str] = MappingProxyType({})
    made_from: str = "paper"
    is_network: bool = False
    offline: bool = False
    convex: bool = False
    separates_lights: bool = False
    filters_emission: bool = False
    blends_layers: bool = False
    has_kernels: bool = True
    baseline_for: tuple[Signal, ...] = ()
    evaluated_with: tuple[str, ...] = ()
    dispensable: ClassVar[Mapping[str, Callable[[Tensor], Tensor]]] = {}
    precision: torch.dtype = torch.float32
    device: str = "cpu"

    def __init__(self, *, signal: Signal | None = None):
        """`signal` is the class's unless another one is named."""
        super().__init__()
        self.signal = signal or type(self).signal
        self.inputs: dict[str, int] = {}
        self.constants: dict[str, list[float]] = {}

    def unavailable(self) -> str | None:
        """Why it cannot run on this machine, with what to install; None where it can."""
        return None

    def __call__(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """`forward`, with NaN and infinities replaced by 0. Raises BadInput where one of `constants` varies."""
        self.check_constants(frame)
        return self.run(frame.finite(), state)

    def run(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """`forward`, for each layer of glass apart."""
        if not frame.has_layers or self.blends_layers:
            one_layer = blended(frame) if frame.has_layers else frame
            return cast(tuple[Tensor, State], super().__call__(one_layer, state))
        before = matching_state(state, LayeredState, frame)
        share = second_share(frame)
        main, main_state = super().__call__(main_layer(frame, share), before.main if before else None)
        second = second_layer(frame, share)
        light, second_state = super().__call__(second, before.second if before else None)
        emission = frame.emission if self.signal == "total" else torch.zeros_like(main)
        output = composed(main, light / second.divisor, share, frame.channel(SECOND["albedo"]), emission)
        return output, LayeredState(frame.moment, main_state, second_state)

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """Radiance (B, 3, H, W) of `signal`, non-negative, and the state for the next frame.

        `state` is None on the first frame of a sequence; one that the frame does not follow is discarded.
        """
        raise NotImplementedError

    def exposed(self, prediction: Tensor, exposure: Tensor) -> Tensor:
        """Irradiance times exposure, for losses, of what a network predicts: see train.protocols."""
        return exposure * prediction

    def first_layers(self) -> Sequence[nn.Conv2d]:
        """The convolutions that read `inputs`."""
        raise NotImplementedError

    def specialise(self, constants: Mapping[str, Sequence[float]]) -> None:
        """Remove the inputs of `constants` from the network's first convolutions and add their effect to the biases.

        `constants` maps channels to the value that each has in every pixel of every frame; those that the network needs
        all the same stay. The output is equal up to rounding, except near the border, where convolutions see zeros.
        """
        for name in [name for name in self.inputs if name in self.dispensable and name in constants]:
            names = list(self.inputs)
            first = sum(self.inputs[other] for other in names[: names.index(name)])
            for layer in self.first_layers():
                drop_inputs(layer, first, self.dispensable[name](torch.tensor(constants[name])))
            del self.inputs[name]
            self.constants[name] = list(constants[name])

    def check_constants(self, frame: Frame) -> None:
        """Raise BadInput where a channel that the network was specialised to varies."""
        for name, value in self.constants.items():
            channel = frame.channel(name)
            wanted = channel.new_tensor(value)[:, None, None]
            if ((channel - wanted).abs() > CONSTANT_TOLERANCE).any():
                raise BadInput(
                    f"{frame.source}: {name} is not {value} everywhere, for which the weights of "
                    f"{type(self).__name__} are specialised: use general weights"
                )

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        """Switch to inference for good. Raises BadInput for a precision that it refuses."""
        if precision in self.refuses:
            raise BadInput(f"{type(self).__name__} does not compute in {precision}: {self.refuses[precision]}")
        self.eval()
        self.requires_grad_(False)
        self.to(precision)
        self.precision = precision

    def parameter_count(self) -> int:
        return sum(parameter.numel() for parameter in self.parameters())
