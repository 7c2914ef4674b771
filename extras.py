"""Optional packages: imports that say which extra to install where one is missing."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

from errors import BadInput


@contextmanager
def requires_extra(extra: str) -> Iterator[None]:
    """A context for imports of an extra's packages. Raises BadInput, with what to install, where one is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise BadInput(f"{error.name} is not installed: `pip install 'onespp[{extra}]'`") from None


def can_draw() -> bool:
    """Whether the packages that draw and store pictures are installed, which come with the extra `report`."""
    return find_spec("matplotlib") is not None and find_spec("PIL") is not None
