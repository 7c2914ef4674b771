"""Mitsuba's XML files as nodes, of this version and the ones before; nothing outside of their folder is read."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.etree import ElementTree

from errors import BadInput
from render.backend import VARIANT, mi
from render.loading import reason

LARGEST = 64 * 2**20  # bytes of XML, all included files together
MOST_INCLUDES = 256
DEEPEST = 15  # includes within includes


def inside(root: Path, name: str, said_by: Path) -> Path:
    """The path of a file that a scene names. Raises BadInput where that leaves the scene's folder `root`."""
    path = (root / name).resolve()
    if not path.is_relative_to(root):
        raise BadInput(f"{said_by}: '{name}' leaves the scene's folder {root}: move it into that folder")
    return path


def check_includes(path: Path) -> None:
    """Raise BadInput unless the file and all that it includes are XML of bounded size and lie in its folder."""
    root = path.parent
    waiting = [(path, 0)]
    total = 0
    included = -1
    while waiting:
        file, depth = waiting.pop()
        included += 1
        if depth > DEEPEST or included > MOST_INCLUDES:
            raise BadInput(
                f"{path}: more than {MOST_INCLUDES} files are included, or more than {DEEPEST} in each other"
            )
        try:
            content = file.read_bytes()
        except OSError as error:
            raise BadInput(f"{file} cannot be read: {error.strerror}") from None
        total += len(content)
        if total > LARGEST:
            raise BadInput(f"{path}: more than {LARGEST >> 20} MiB of XML")
        if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
            raise BadInput(f"{file} declares entities, which scene files have no use for: remove them")
        try:
            tree = ElementTree.fromstring(content)
        except ElementTree.ParseError as error:
            raise BadInput(f"{file} is empty or damaged: it is not XML ({error})") from None
        for tag in tree.iter("path"):
            inside(root, tag.get("value", ""), file)
        for tag in tree.iter("include"):
            name = tag.get("filename", "")
            if "$" in name:
                raise BadInput(f"{file}: includes '{name}', whose name depends on a parameter: write the file's name")
            waiting.append((inside(root, name, file), depth + 1))


@contextmanager
def searched_in(folder: Path) -> Iterator[None]:
    """While Mitsuba looks for files in `folder` first."""
    resolver = mi.file_resolver()  # type: ignore[operator]
    before = [resolver[i] for i in range(len(resolver))]
    resolver.prepend(str(folder))
    try:
        yield
    finally:
        resolver.clear()
        for each in before:
            resolver.append(each)


SUBSURFACE = re.compile(r"<subsurface\b[^>]*?(/>|>.*?</subsurface\s*>)", re.DOTALL)  # of old files; no longer parsed


def parse(path: Path) -> tuple[mi.parser.ParserState, list[str]]:
    """The nodes of a scene file, with references resolved, and what had to be left out.

    Raises BadInput, naming the file, for what is no scene.
    """
    path = path.resolve()
    check_includes(path)
    config = mi.parser.ParserConfig(VARIANT)
    config.unused_parameters = mi.LogLevel.Debug
    text, removed = SUBSURFACE.subn("", path.read_text(errors="replace"))
    notes = [f"{removed} times subsurface scattering: left out, the surface alone is rendered"] if removed else []
    with searched_in(path.parent):
        try:
            state = mi.parser.parse_string(config, text) if removed else mi.parser.parse_file(config, str(path))
            mi.parser.transform_upgrade(config, state)
            mi.parser.transform_resolve_references(config, state)
        except RuntimeError as error:
            raise BadInput(f"{path} cannot be read: {reason(error)}") from None
    return state, notes
