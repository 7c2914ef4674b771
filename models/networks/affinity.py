"""A filter whose weights compare learned features of pixels: one level of an à-trous transform (Isik et al. 2021)."""

from typing import Any, cast

import torch
from torch import Tensor

from models import compiled
from models.compiled import affinity as kernels
from models.compiled.affinity import MIN_LOGIT
from models.filters.neighbours import taps_3x3
from models.operators import MIN_DIVISOR


def plain_level(
    image: Tensor, features: Tensor, sharpness: Tensor, own: Tensor, importance: Tensor, surface: Tensor, step: int
) -> Tensor:
    """See affinity_level: the way that PyTorch takes."""
    count = features.shape[1]
    taps = taps_3x3(torch.cat([features, importance, surface, image], dim=1), step)
    distance = (taps[:, :count] - features[:, :, None]).square().sum(dim=1)
    exponent = (taps[:, count] - sharpness * distance).clamp(min=MIN_LOGIT)
    weight = torch.exp(torch.cat([exponent[:, :4], own, exponent[:, 5:]], dim=1)) * taps[:, count + 1]
    total = (taps[:, count + 2 :] * weight[:, None]).sum(dim=2)
    return torch.where(surface > 0, total / weight.sum(dim=1, keepdim=True).clamp(min=MIN_DIVISOR), 0)


class AffinityLevel(torch.autograd.Function):
    """Both directions by kernels for the processor."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        """The arguments are those of affinity_level."""
        *given, surface, step = arguments
        out, total = kernels.filter_level(*arguments)
        ctx.step = step
        ctx.save_for_backward(*given, surface, out, total)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *given, surface, out, total = ctx.saved_tensors
        return *kernels.pull_level(gradients[0], given, surface, out, total, ctx.step), None, None


def affinity_level(
    image: Tensor, features: Tensor, sharpness: Tensor, own: Tensor, importance: Tensor, surface: Tensor, step: int
) -> Tensor:
    """A convex mean over 3 x 3 taps `step` pixels apart (Isik et al. 2021, Eq. 4, with two weights more).

    The weight of tap q for pixel p is exp(importance_q - sharpness_p |f_p - f_q|²), that of p itself exp(own_p). Only
    pixels that show a surface count; the others become 0.
    image (B, 3, H, W); features (B, F, H, W), F a multiple of 4; sharpness >= 0, own, importance and surface (1 or 0)
    (B, 1, H, W). own and importance lie in [-10, 10], so that no sum overflows.
    """
    level = AffinityLevel.apply if compiled.usable(image) else plain_level
    return cast(Tensor, level(image, features, sharpness, own, importance, surface, step))
