"""References of a clip in progress, kept on disk so that an interrupted job need not render them again."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from files import replacing


@contextmanager
def kept_references(clip: Path) -> Iterator[Path]:
    """A hidden folder beside the folder `clip`. A job that is killed, interrupted, or out of disk leaves it behind."""
    folder = clip.with_name(f".{clip.name}.references")
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield folder
    except OSError:
        raise
    except Exception:
        shutil.rmtree(folder)
        raise
    shutil.rmtree(folder)


def kept(path: Path, render: Callable[[], NDArray[Any]]) -> NDArray[Any]:
    """The array in the file `path`, which is rendered where it is missing or damaged."""
    with suppress(FileNotFoundError, ValueError, EOFError):
        return np.asarray(np.load(path))
    array = render()
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.save(file, array)
    return array
