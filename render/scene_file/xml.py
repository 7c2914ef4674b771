"""Parses Mitsuba's XML files of this and earlier versions; nothing outside of their folder is read."""

from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from errors import BadInput
from render.backend import VARIANT, mi
from render.loading import mitsuba_reason
from scenes.colours import srgb_to_linear

MAX_BYTES = 64 * 2**20  # of XML, all included files together
MAX_INCLUDES = 256
MAX_INCLUDE_DEPTH = 15
MAX_ELEMENT_DEPTH = 64  # parsers overflow their stacks at many thousands


def inside(root: Path, name: str, source: Path) -> Path:
    """The path of a file that `source` names. Raises BadInput if it is outside of the scene's folder `root`."""
    try:
        path = (root / name).resolve()
        path.is_file()
    except (OSError, ValueError) as error:
        raise BadInput(f"{source}: '{name[:80]}' cannot be the name of a file: {error}"[:300]) from None
    if not path.is_relative_to(root):
        raise BadInput(f"{source}: '{name}' leaves the scene's folder {root}: move it into that folder")
    return path


def elements(file: Path, content: bytes) -> Iterator[Element]:
    """All elements of an XML file, with their attributes. Raises BadInput if it is damaged or too deep."""
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content or b"\0" in content:
        raise BadInput(f"{file} declares entities, which scene files do not need, or is not in UTF-8")
    depth = 0
    try:
        for event, element in ElementTree.iterparse(BytesIO(content), ("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > MAX_ELEMENT_DEPTH:
                raise BadInput(f"{file}: more than {MAX_ELEMENT_DEPTH} elements within each other")
            if event == "start":
                yield element
    except ElementTree.ParseError as error:
        raise BadInput(f"{file} is empty or damaged: it is not XML ({error})") from None


def check_includes(path: Path) -> list[Path]:
    """The folders in which the file and all that it includes search for files.

    Raises BadInput unless they are XML of bounded size and name nothing outside of their folder.
    """
    root = path.parent
    searched = [root]
    waiting = [(path, 0)]
    total = 0
    included = -1
    while waiting:
        file, depth = waiting.pop()
        included += 1
        if depth > MAX_INCLUDE_DEPTH or included > MAX_INCLUDES:
            limits = f"{MAX_INCLUDES} files, or more than {MAX_INCLUDE_DEPTH} in each other"
            raise BadInput(f"{path} includes more than {limits}: merge some")
        try:
            content = file.read_bytes()
        except OSError as error:
            raise BadInput(f"{file} cannot be read: {error.strerror}") from None
        total += len(content)
        if total > MAX_BYTES:
            raise BadInput(f"{path}: more than {MAX_BYTES >> 20} MiB of XML")
        for element in elements(file, content):
            name = element.get("value" if element.tag == "path" else "filename")
            if element.tag not in ("path", "include", "spectrum") or name is None:
                continue
            if "$" in name:
                raise BadInput(f"{file}: the name '{name}' depends on a parameter: write the file's name")
            named = inside(root, name, file)
            if element.tag == "path":
                searched.append(named)
            elif element.tag == "include":
                waiting.append((named, depth + 1))
    return searched


@contextmanager
def searched_in(folder: Path) -> Iterator[None]:
    """Within the context Mitsuba searches `folder` first."""
    resolver = mi.file_resolver()  # type: ignore[operator]
    before = [resolver[i] for i in range(len(resolver))]
    resolver.prepend(str(folder))
    try:
        yield
    finally:
        resolver.clear()
        for path in before:
            resolver.append(path)


def linear_colour(colour: str) -> str:
    """The linear values of a colour of old files: #rrggbb, or three sRGB values."""
    if colour.startswith("#"):
        encoded = np.array([*bytes.fromhex(colour[1:7])]) / 255
    else:
        encoded = np.array([float(value) for value in colour.replace(",", " ").split()])
    return ", ".join(f"{value:.6f}" for value in srgb_to_linear(encoded))


def named_like(element: Element, tag: str, **attributes: str) -> Element:
    """Another element under the same name."""
    return Element(tag, {"name": element.get("name", "")} | attributes)


def upgrade(root: Element, path: Path) -> list[str]:
    """Replace elements of old files that Mitsuba's parser does not support any more. Returns notes."""
    notes = []
    for parent in root.iter():
        for place, child in enumerate([*parent]):
            if child.tag == "subsurface":
                notes.append("subsurface scattering is left out: the surface alone is rendered")
                parent[place] = ElementTree.Comment("subsurface")
            elif child.tag == "animation":
                notes.append(f"an <animation> ('{child.get('name')}'): its first transform instead")
                parent[place] = named_like(child, "transform")
                parent[place].extend(next(iter(child.findall("transform")), Element("transform")))
            elif child.tag == "srgb":
                parent[place] = named_like(child, "rgb", value=linear_colour(child.get("value", "")))
            elif child.tag == "blackbody":
                parent[place] = named_like(child, "spectrum", type="blackbody")
                for name in ("temperature", "scale"):
                    parent[place].append(Element("float", {"name": name, "value": child.get(name, "1").strip(" K")}))
            elif child.tag == "spectrum" and not (path.parent / child.get("filename", "")).exists():
                notes.append(f"the file {child.get('filename')} of a spectrum is missing: 0.5 everywhere instead")
                parent[place] = named_like(child, "spectrum", value="0.5")
    return [f"{notes.count(note)} times {note}" if notes.count(note) > 1 else note for note in dict.fromkeys(notes)]


def parse(path: Path) -> tuple[mi.parser.ParserState, list[Path], list[str]]:
    """The nodes of a scene file with references resolved, the folders for its files, and notes of omissions.

    Raises BadInput, naming the file, if it is invalid.
    """
    path = path.resolve()
    searched = check_includes(path)
    config = mi.parser.ParserConfig(VARIANT)
    config.unused_parameters = mi.LogLevel.Debug
    keeping_lines = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    root = ElementTree.fromstring(path.read_bytes(), keeping_lines)
    with searched_in(path.parent):
        try:
            notes = upgrade(root, path)
            state = mi.parser.parse_string(config, ElementTree.tostring(root, "unicode"))
            mi.parser.transform_upgrade(config, state)
            mi.parser.transform_resolve_references(config, state)
        except (RuntimeError, ValueError) as error:
            raise BadInput(f"{path} cannot be read: {mitsuba_reason(error)}") from None
    return state, searched, notes
