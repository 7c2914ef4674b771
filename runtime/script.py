"""What the scripts of this folder share."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from errors import BadInput


@contextmanager
def exits_in_words() -> Iterator[None]:
    """Exit with one line on what the user can correct, as the command line does."""
    try:
        yield
    except BadInput as error:
        sys.exit(f"error: {error}")
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        sys.exit(f"error: {where}{error.strerror or error}; correct that or choose another file, and run it again")
