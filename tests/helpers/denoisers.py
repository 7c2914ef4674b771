"""Denoisers as parameters of tests."""

from collections.abc import Iterable

import pytest

# What holds for all denoisers is shown by make test-all for those that share the code of others, and for the slowest.
RARELY = ("nfor", "oidn-balanced", "oidn-fast", "oidn-irradiance")
RARELY += ("wskp-mr", "kp", "mr-kp", "ntd-a", "ntd-b", "ntd-mean")


def each(names: Iterable[str], *long: str):
    """The names; those tested RARELY and those that take `long` are slow."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in (*RARELY, *long))) for name in names]
