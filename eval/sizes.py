"""Networks in other sizes than the named denoisers have: WSKP that fuses one window to six."""

from collections.abc import Callable
from functools import partial

from eval.ablation.definitions import label_of
from eval.results import BASELINES
from models.denoiser import Denoiser
from models.parameters import WINDOWS
from models.registry import create
from models.wskp import WSKP

# wskp6-2w fuses windows of 3 and 5 pixels, and so on. They are trained by `onespp ablate wskp-windows`.
SIZES = {f"wskp6-{count}w": WINDOWS[:count] for count in range(1, len(WINDOWS) + 1)}
WHOLE = f"wskp6-{len(WINDOWS)}w"  # is wskp6, in another training


def create_any(name: str) -> Denoiser:
    """A denoiser or one of SIZES, with fresh weights. Raises BadInput for an unknown name."""
    makers: dict[str, Callable[[], Denoiser]] = {size: partial(WSKP, windows=SIZES[size]) for size in SIZES}
    return makers[name]() if name in makers else create(name)


def timed_as(name: str, signal: str) -> str:
    """What the bench calls whatever computes the same, in time: another training of a network, a baseline's signal."""
    if signal == "indirect" and name in BASELINES:
        return f"{name} (indirect)"
    return {WHOLE: "wskp6", "ntd-b": "ntd"}.get(name, name)


def trained_as(name: str) -> str:
    """What the ablation calls one of SIZES, and its weights."""
    return label_of(SIZES[name])
