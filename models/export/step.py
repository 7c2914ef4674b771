"""What an exported denoiser is: one frame and its state in, radiance and the next state out, all plain tensors."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from datasets.frame import Frame

Warp = Literal["inside", "outside"]
Tensors = Mapping[str, Tensor]

HEIGHT = "height"
WIDTH = "width"
MESHES = "meshes_and_1"


@dataclass(frozen=True)
class Port:
    """A tensor that goes into a step or comes out of it.

    Attributes:
        shape: numbers, and names of sizes that may differ from call to call.
        meaning: in words, with its unit.
    """

    name: str
    shape: tuple[int | str, ...]
    meaning: str
    dtype: torch.dtype = torch.float32

    def zeros(self, sizes: Mapping[str, int]) -> Tensor:
        """A tensor of this shape, for named `sizes`."""
        return torch.zeros([size if isinstance(size, int) else sizes[size] for size in self.shape], dtype=self.dtype)


def image(name: str, channels: int, meaning: str, dtype: torch.dtype = torch.float32) -> Port:
    """A port for images (1, channels, H, W)."""
    return Port(name, (1, channels, HEIGHT, WIDTH), meaning, dtype)


@dataclass(frozen=True)
class Carried:
    """An input that the frame before provides: zeros before the first frame and after a cut.

    Attributes:
        source: the output, or the input of the frame before, that it is.
        warped: whether the caller has to move it along with the surfaces first, 0 where these were not seen before.
    """

    port: Port
    source: str
    warped: bool = False


class Step(nn.Module):
    """One frame of a denoiser (B = 1) as a function of tensors by name.

    Attributes:
        images: the inputs that each frame brings.
        carried: the inputs that are state.
        outputs: the first is the radiance.
    """

    images: tuple[Port, ...]
    carried: tuple[Carried, ...]
    outputs: tuple[Port, ...]
    warps: ClassVar[tuple[Warp, ...]] = ("inside", "outside")

    @property
    def inputs(self) -> tuple[Port, ...]:
        return *self.images, *(each.port for each in self.carried)

    def feeds(self, frame: Frame) -> dict[str, Tensor]:
        """What `frame` (B = 1) brings for `images`, by name."""
        raise NotImplementedError

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """The outputs, by name, of all inputs by name."""
        raise NotImplementedError

    def initial(self, frame: Frame) -> dict[str, Tensor]:
        """The state before a sequence of frames of the size of this one."""
        height, width = frame.size
        return {each.port.name: each.port.zeros({HEIGHT: height, WIDTH: width}) for each in self.carried}

    def state(self, inputs: Tensors, outputs: Tensors) -> dict[str, Tensor]:
        """The state after a frame, not yet warped."""
        known = {**inputs, **outputs}
        return {each.port.name: known[each.source] for each in self.carried}
