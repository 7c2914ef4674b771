"""One frame of a denoiser beside its reference: the arguments of every metric."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from torch import Tensor

from datasets.tonemap import display
from models.operators import finite, image_luminance


class Luminances(NamedTuple):
    """Display luminance (1 or 2, 1, H, W) of one frame, from which temporal metrics are computed."""

    output: Tensor
    reference: Tensor
    buffers: Tensor


class Previous(NamedTuple):
    """What temporal metrics need of the frame before."""

    luminances: Luminances
    error: Tensor  # of the displayed output, (1, 3, H, W)
    reference_buffers: Tensor


def half_difference(buffers: Tensor) -> Tensor:
    """(A - B) / 2 of two images (2, 3, H, W)."""
    a, b = buffers.split(1)
    return (a - b) / 2


@dataclass(frozen=True)
class Comparison:
    """A denoised frame, its reference and the previous frame. Images are float64."""

    denoised: Tensor  # radiance (1, 3, H, W). A pixel that is not finite counts as 0.
    reference_buffers: Tensor  # two independent sample buffers A and B (2, 3, H, W) of the reference radiance
    exposure: float  # the clip's
    # the pixels (1, 1, H, W) that were hidden in the previous frame; None where unknown
    disoccluded: Tensor | None = None
    before: Previous | None = None  # None on the first frame
    still: bool = False  # whether nothing moves in the clip
    motion: Tensor | None = None  # from a pixel to where its surface was in the previous frame, (1, 2, H, W) in px
    one_reference: bool = False  # whether both buffers are the one image that there is: its noise is unknown

    @cached_property
    def output(self) -> Tensor:
        return finite(self.denoised).double()

    @cached_property
    def buffers(self) -> Tensor:
        return self.reference_buffers.double()

    @cached_property
    def reference(self) -> Tensor:
        """The mean of both buffers, (1, 3, H, W)."""
        return self.buffers.mean(dim=0, keepdim=True)

    @cached_property
    def displayed(self) -> Tensor:
        """The output after exposure and tone mapping, in [0, 1]."""
        return display(self.output, self.exposure)

    @cached_property
    def displayed_reference(self) -> Tensor:
        return display(self.reference, self.exposure)

    @cached_property
    def displayed_buffers(self) -> Tensor:
        return display(self.buffers, self.exposure)

    @cached_property
    def displayed_noise(self) -> Tensor:
        """(A - B) / 2 of the displayed buffers, (1, 3, H, W): distributed as the error of the reference."""
        return half_difference(self.displayed_buffers)

    @cached_property
    def noise(self) -> Tensor:
        """(A - B) / 2 in exposed radiance, (3, H, W)."""
        return self.exposure * (self.buffers[0] - self.buffers[1]) / 2

    @cached_property
    def error(self) -> Tensor:
        """That of the displayed output, (1, 3, H, W)."""
        return self.displayed - self.displayed_reference

    @cached_property
    def mse(self) -> float:
        """Mean squared error of the displayed output."""
        return self.error.square().mean().item()

    @cached_property
    def noise_mse(self) -> float:
        """The noise floor of `mse`."""
        return self.displayed_noise.square().mean().item()

    @cached_property
    def luminances(self) -> Luminances:
        images = (self.displayed, self.displayed_reference, self.displayed_buffers)
        return Luminances(*(image_luminance(image) for image in images))

    @cached_property
    def change(self) -> Luminances | None:
        """Change of the luminances since the previous frame."""
        if self.before is None:
            return None
        return Luminances(*(now - before for now, before in zip(self.luminances, self.before.luminances, strict=True)))

    @cached_property
    def displayed_noise_before(self) -> Tensor | None:
        """`displayed_noise` of the previous frame; None on the first one."""
        return self.before and half_difference(display(self.before.reference_buffers.double(), self.exposure))

    def as_previous(self) -> Previous:
        """What the next frame's comparison needs of this one."""
        return Previous(self.luminances, self.error, self.reference_buffers)
