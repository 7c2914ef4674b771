"""What the user can mend: bad input, and optional packages that are not installed."""

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec


class BadInput(Exception):  # noqa: N818 - it is the user's input, not an error of ours
    """What the user gave cannot be used. The message is one line: what is wrong and what to do.

    The command line prints it and exits with code 2; every other exception is a bug and keeps its traceback.
    """


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
