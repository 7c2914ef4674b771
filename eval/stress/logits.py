"""The logits of kernel predictors, and how to scale them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn

from eval.bench.timed import network_of
from models.denoiser import Denoiser

MIN_LOGIT_SCALE = 1e-30  # divisor of logits that are all 0


def last_layers(denoiser: Denoiser) -> list[nn.Module]:
    """The layers of a kernel predictor whose outputs are its logits; empty for other denoisers."""
    network = network_of(denoiser)
    if isinstance(network, nn.Sequential):
        return [network[-1]]
    return list(getattr(network, "heads", ()))


@contextmanager
def largest_logits(denoiser: Denoiser, size: float | None) -> Iterator[None]:
    """Scale the logits so that the largest of each frame is `size`, unless that is None."""
    if size is None:
        yield
        return

    def scale(layer: nn.Module, inputs: Any, output: Tensor) -> Tensor:
        logits = output.float()  # the factor may overflow half precision
        return (logits * (size / logits.abs().max().clamp(min=MIN_LOGIT_SCALE))).to(output.dtype)

    hooks = [layer.register_forward_hook(scale) for layer in last_layers(denoiser)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()
