"""Linear sRGB of what Mitsuba computes with, be it spectra, one colour or three."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

FIRST_NM, LAST_NM = 360.0, 830.0
STRATA = 8  # evaluations of a spectrum, of four wavelengths each


def is_scalar() -> bool:
    """Whether the variant handles one ray at a time."""
    return str(mi.variant()).startswith("scalar")


def to_rgb(value: Any, wavelengths: Any) -> Any:
    """The Color3f that a sample of light adds to a film."""
    value = mi.unpolarized_spectrum(value)
    if mi.is_spectral:
        return mi.spectrum_to_srgb(value, wavelengths)
    return mi.Color3f(value.x) if mi.is_monochromatic else mi.Color3f(value)


def mean_rgb(value: Any) -> Any:
    """The Color3f of a weight; of spectra the mean, which is grey."""
    value = mi.unpolarized_spectrum(value)
    return mi.Color3f(dr.mean(value)) if mi.is_spectral else to_rgb(value, None)


def radiance_of(spectrum: Callable[[Any], Any], si: Any) -> Any:
    """The Color3f, free of noise, of radiance that is a function of the surface interaction."""
    if not mi.is_spectral:
        return to_rgb(spectrum(si), None)
    at, total = type(si)(si), mi.Color3f(0)
    step = (LAST_NM - FIRST_NM) / (4 * STRATA)
    for stratum in range(STRATA):
        nm = [FIRST_NM + step * (stratum + STRATA * i + 0.5) for i in range(4)]
        at.wavelengths = type(si.wavelengths)(*nm)
        total += to_rgb((LAST_NM - FIRST_NM) * mi.unpolarized_spectrum(spectrum(at)), at.wavelengths)
    return total / STRATA


def reflectance_of(spectrum: Callable[[Any], Any], si: Any) -> Any:
    """The Color3f of a reflectance under daylight: 1 for white."""
    if not mi.is_spectral:
        return to_rgb(spectrum(si), None)

    def daylight(at: Any) -> Any:
        return type(at.wavelengths)(*map(mi.cie_d65, at.wavelengths))

    lit = radiance_of(lambda at: daylight(at) * mi.unpolarized_spectrum(spectrum(at)), si)
    return lit / radiance_of(daylight, si)
