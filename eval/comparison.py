"""One frame of a denoiser beside its reference: all that a metric is a function of."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from torch import Tensor

from datasets.tonemap import display
from models.operators import finite, image_luminance


class Luminances(NamedTuple):
    """Display luminance (1 or 2, 1, H, W) of one frame: what change over time is measured by."""

    output: Tensor
    reference: Tensor
    halves: Tensor


@dataclass(frozen=True)
class Comparison:
    """A denoised frame, its reference and the frame before it. Images are float64.

    Attributes:
        denoised: radiance (1, 3, H, W). A pixel that is not finite counts as 0.
        reference_halves: the two independent halves (2, 3, H, W) of the reference radiance.
        exposure: the clip's.
        disoccluded: the pixels (1, 1, H, W) that have just come into view; None where that is not known.
        before: luminances of the frame before; None on the first one.
        still: whether nothing moves in the clip.
    """

    denoised: Tensor
    reference_halves: Tensor
    exposure: float
    disoccluded: Tensor | None = None
    before: Luminances | None = None
    still: bool = False

    @cached_property
    def output(self) -> Tensor:
        return finite(self.denoised).double()

    @cached_property
    def halves(self) -> Tensor:
        return self.reference_halves.double()

    @cached_property
    def reference(self) -> Tensor:
        """The mean of the halves, (1, 3, H, W)."""
        return self.halves.mean(dim=0, keepdim=True)

    @cached_property
    def shown(self) -> Tensor:
        """The output as displayed."""
        return display(self.output, self.exposure)

    @cached_property
    def shown_reference(self) -> Tensor:
        return display(self.reference, self.exposure)

    @cached_property
    def shown_halves(self) -> Tensor:
        return display(self.halves, self.exposure)

    @cached_property
    def shown_noise(self) -> Tensor:
        """(A - B) / 2 of the halves as displayed, (1, 3, H, W): as far off zero as the reference is off the truth."""
        a, b = self.shown_halves.split(1)
        return (a - b) / 2

    @cached_property
    def noise(self) -> Tensor:
        """The same of exposed radiance, (3, H, W)."""
        return self.exposure * (self.halves[0] - self.halves[1]) / 2

    @cached_property
    def mse(self) -> float:
        """As displayed."""
        return (self.shown - self.shown_reference).square().mean().item()

    @cached_property
    def noise_mse(self) -> float:
        """The noise floor of `mse`."""
        return self.shown_noise.square().mean().item()

    @cached_property
    def luminances(self) -> Luminances:
        return Luminances(*(image_luminance(image) for image in (self.shown, self.shown_reference, self.shown_halves)))

    @cached_property
    def change(self) -> Luminances | None:
        """Change of the luminances since the frame before."""
        if self.before is None:
            return None
        return Luminances(*(now - before for now, before in zip(self.luminances, self.before, strict=True)))
