"""Random draws. Their order determines a scene: another order makes other datasets."""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

Rng = np.random.Generator
Option = TypeVar("Option")


def one_of(rng: Rng, options: Sequence[Option]) -> Option:
    return options[int(rng.integers(len(options)))]


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A number from `low` to `high`, both positive, with a uniformly distributed logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def uniforms(rng: Rng, *ranges: tuple[float, float]) -> list[float]:
    """A number from each of the ranges (low, high)."""
    return [rng.uniform(low, high) for low, high in ranges]
