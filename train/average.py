"""The exponential average of a network's weights: it is judged and kept in place of weights that still jitter."""

import torch
from torch import nn
from torch.optim.swa_utils import get_ema_multi_avg_fn


def decay_after(updates: int, span: float) -> float:
    """The weight of the average so far, when the weights after update number `updates`, from 1, join it.

    1 - 1 / `span` in the long run, the mean of about the last `span` updates; less at first, lest the average keep
    the weights that the training began with.
    """
    return min(1 - 1 / max(span, 1), (1 + updates) / (10 + updates))


@torch.no_grad()
def join_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Move the weights of `average` to those of `network` by 1 - `decay` of the way."""
    get_ema_multi_avg_fn(decay)(list(average.parameters()), list(network.parameters()), None)
