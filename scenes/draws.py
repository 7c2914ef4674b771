"""Random draws that many scenes share.

A scene is decided by the order of its draws: another order makes other data sets.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Rng = np.random.Generator
Option = TypeVar("Option")


def one_of(rng: Rng, options: Sequence[Option]) -> Option:
    """One of the options, each as likely as it is often among them."""
    return options[int(rng.integers(len(options)))]


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A number from `low` to `high`, both above 0, whose logarithm is uniformly distributed."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))
