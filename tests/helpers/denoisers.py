"""Denoisers as parameters of tests."""

from collections.abc import Iterable

import pytest

# They share the code of others: what holds for them all is shown for these by make test-all.
VARIANTS = ("oidn-balanced", "oidn-fast", "oidn-irradiance", "wskp-mr", "kp", "mr-kp", "ntd-a", "ntd-b", "ntd-mean")


def each(names: Iterable[str], *long: str):
    """The names; VARIANTS and those that take `long` are slow."""
    return [pytest.param(name, marks=[pytest.mark.slow] * (name in (*VARIANTS, *long))) for name in names]
