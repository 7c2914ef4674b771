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

NO_FLOAT16 = {torch.float16: "on processors float32 and bfloat16 are faster"}  # of networks

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

    Frames, states' images and outputs are always float32.
    """

    reads: tuple[str, ...]  # channels it needs; nothing else is loaded, rendered or stored for it
    signal: Signal = "total"  # the light that it returns
    refuses: Mapping[torch.dtype, str] = MappingProxyType({})  # precisions that it does not compute in, with the reason
    made_from: str = "ours"  # what it follows, for tables: others' papers, their authors' code, accounts of either
    is_network: bool = False  # whether it needs trained weights
    offline: bool = False  # whether a frame takes seconds: it runs only where it is named, not in runs of all
    convex: bool = False  # whether it returns weighted means of irradiance since the last reset, with weights >= 0
    separates_lights: bool = False  # whether it filters direct and indirect light apart
    filters_emission: bool = False  # whether emission is a part of what it filters; else it is added back untouched
    blends_layers: bool = False  # whether it takes glass in one layer, with guides blended from both, instead of twice
    has_kernels: bool = True  # whether compiled kernels do a part of its work
    baseline_for: tuple[Signal, ...] = ()  # signals whose denoisers evaluations, cards and trade-offs compare with it
    evaluated_with: tuple[str, ...] = ()  # suffixes with which `onespp eval` runs it beside the denoiser itself
    inputs: Mapping[str, int] = MappingProxyType({})  # of its network in order, and how many channels each has
    # Channels, by the names of inputs, that its network can do without where they do not vary; its input for a value.
    dispensable: ClassVar[Mapping[str, Callable[[Tensor], Tensor]]] = {}
    first_layer: str  # the path of the convolution, or of the list of those, that such channels are dropped from
    precision: torch.dtype = torch.float32  # what its network computes in, see `prepare`
    device: str = "cpu"  # or "cuda", where it was moved to: frames have to be there, and its output is

    def __init__(self, *, signal: Signal | None = None):
        """`signal` is the class's unless another one is named."""
        super().__init__()
        self.signal = signal or type(self).signal
        self.constants: dict[str, list[float]] = {}  # channels that it does without, with the value each has everywhere

    def unavailable(self) -> str | None:
        """Why it cannot run on this machine, with what to install; None where it can."""
        return None

    def __call__(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """`forward`, with NaN and infinities replaced by 0. Raises BadInput where one of `constants` varies."""
        for name, value in self.constants.items():
            channel = frame.channel(name)
            if ((channel - channel.new_tensor(value)[:, None, None]).abs() > CONSTANT_TOLERANCE).any():
                raise BadInput(
                    f"{frame.source}: {name} is not {value} everywhere, for which the weights of "
                    f"{type(self).__name__} are specialised: use general weights"
                )
        return self.run(frame.finite(), state)

    def run(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """`forward`, for each layer of glass apart, or for both as one where light comes in parts."""
        if not frame.has_layers or self.blends_layers or frame.parts is not None:
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
        first = self.get_submodule(self.first_layer)
        return cast(Sequence[nn.Conv2d], first if isinstance(first, nn.ModuleList) else [first])

    def specialise(self, constants: Mapping[str, Sequence[float]]) -> None:
        """Remove the inputs of `constants` from the network's first convolutions and add their effect to the biases.

        `constants` maps channels to the value that each has in every pixel of every frame; those that the network needs
        all the same stay. The output is equal up to rounding, except near the border, where convolutions see zeros.
        """
        for name in [name for name in self.inputs if name in self.dispensable and name in constants]:
            names = list(self.inputs)
            first = sum(self.inputs[other] for other in names[: names.index(name)])
            for layer in self.first_layers():
                drop_inputs(layer, first, self.dispensable[name](torch.tensor(constants[name], dtype=torch.float32)))
            self.inputs = {other: count for other, count in self.inputs.items() if other != name}
            self.constants[name] = list(constants[name])

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        """Switch to inference for good. Raises BadInput for a precision that it refuses."""
        if precision in self.refuses:
            raise BadInput(f"{type(self).__name__} does not compute in {precision}: {self.refuses[precision]}")
        self.eval()
        self.requires_grad_(False)
        self.to(precision)
        self.precision = precision

    def c_digest(self) -> str | None:
        """The digest of the C code that can do its work here, None without any; the first call may compile it."""
        return None

    def use_c(self) -> None:
        """Let C code do the work if it can, in inference on the CPU, with the weights there are."""

    def parameter_count(self) -> int:
        return sum(parameter.numel() for parameter in self.parameters())
