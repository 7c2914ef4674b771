"""Trained weights that come with onespp: a file a network, beside its card."""

from pathlib import Path

from errors import BadInput
from models.registry import DENOISERS

SHIPPED_FOLDER = Path(__file__).parent / "shipped"


def shipped_weights(name: str) -> Path | None:
    """The shipped weights of a denoiser of the registry; None where there are none."""
    path = SHIPPED_FOLDER / f"{name}.safetensors"
    return path if path.exists() else None


def require_shipped(name: str) -> Path:
    """The same; raises BadInput where there are none."""
    path = shipped_weights(name)
    if path is None:
        raise BadInput(f"no weights of '{name}' are shipped; those are {', '.join(shipped_names()) or 'none'}")
    return path


def shipped_names() -> list[str]:
    """The networks whose weights are shipped, in the order of the registry."""
    return [name for name in DENOISERS if shipped_weights(name)]
