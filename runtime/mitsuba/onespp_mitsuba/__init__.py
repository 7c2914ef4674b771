"""onespp for Mitsuba 3: a denoiser for sequences, and an integrator that gives it guides.

Choose a variant of Mitsuba before or after importing this.
"""

import importlib
import sys

import mitsuba as mi


def register(*_: object) -> None:
    """Make the integrator known to the variant."""
    name = f"{__name__}.integrator"
    module = importlib.import_module(name) if name not in sys.modules else importlib.reload(sys.modules[name])
    del module


mi.detail.add_variant_callback(register)
if mi.variant():
    register()
