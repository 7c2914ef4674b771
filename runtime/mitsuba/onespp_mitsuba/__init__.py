"""onespp for Mitsuba 3: a denoiser of sequences, and the integrator `onespp_guides`, which describes what is seen.

`mi.set_variant` may be called before importing this or afterwards.
"""

import importlib
import sys

import mitsuba as mi

from .denoiser import Denoiser
from .motion import Snapshot, flow_between

GUIDES = {f"{name}_ch": name for name in ("albedo", "depth", "roughness", "shape", "primitive", "emission")}
GUIDES["normals_ch"] = "normal"
"""Arguments of `Denoiser` for a bitmap of `onespp_guides`: the names of its channels."""

__all__ = ["GUIDES", "Denoiser", "Snapshot", "flow_between"]


def register(*_: object) -> None:
    """Make the integrator known to the variant, to which classes of integrators belong."""
    name = f"{__name__}.integrator"
    if name in sys.modules:
        importlib.reload(sys.modules[name])
    else:
        importlib.import_module(name)


mi.detail.add_variant_callback(register)
if mi.variant():
    register()
