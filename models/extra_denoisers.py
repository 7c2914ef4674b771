"""Denoisers to measure beside those of the registry: WSKP that fuses one window to six, and OIDN in a hurry."""

from typing import Any, NamedTuple

from models.denoiser import Denoiser
from models.filters.oidn import OIDN
from models.networks.wskp import WSKP
from models.parameters import WINDOWS


class Extra(NamedTuple):
    """A class, and what its constructor is given."""

    kind: type[Denoiser]
    arguments: dict[str, Any]


# wskp6-2w fuses windows of 3 and 5 pixels, and so on. They are trained by `onespp ablate wskp-windows`.
WINDOW_SETS = {f"wskp6-{count}w": WINDOWS[:count] for count in range(1, len(WINDOWS) + 1)}
ALL_WINDOWS = f"wskp6-{len(WINDOWS)}w"  # is wskp6, in another training
FAST_OIDN = "oidn (fast)"

EXTRA = {name: Extra(WSKP, {"windows": windows}) for name, windows in WINDOW_SETS.items()}
EXTRA[FAST_OIDN] = Extra(OIDN, {"quality": "fast"})


def windows_label(windows: tuple[int, ...]) -> str:
    """What the ablation of windows calls a network, and its weights: 3+5."""
    return "+".join(map(str, windows))
