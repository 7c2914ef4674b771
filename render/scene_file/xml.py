"""Parses Mitsuba's XML files of this and earlier versions; nothing outside of their folder is read."""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np

from errors import BadInput
from render.backend import VARIANT, mi
from render.loading import mitsuba_reason
from render.scene_file.stand_ins import numbers
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


class LocatedElement(Element):
    """An element that remembers its `place`: its file and line."""

    def __init__(self, tag: str, attributes: dict[str, str], place: str):
        super().__init__(tag, attributes)
        self.place = place


def elements_of(file: Path, content: bytes) -> LocatedElement:
    """The root of an XML file. Raises BadInput if it is damaged or too deep."""
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content or b"\0" in content:
        raise BadInput(f"{file} declares entities, which scene files do not need, or is not in UTF-8")
    parser = expat.ParserCreate()
    opened: list[Element] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        opened.append(builder.start(tag, attributes))
        if len(opened) > MAX_ELEMENT_DEPTH:
            raise BadInput(f"{file}: more than {MAX_ELEMENT_DEPTH} elements within each other")

    builder = ElementTree.TreeBuilder(
        element_factory=lambda tag, attributes: LocatedElement(
            tag, attributes, f"{file} line {parser.CurrentLineNumber}"
        )
    )
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: (builder.end(tag), opened.pop())
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise BadInput(f"{file} is empty or damaged: it is not XML ({error})") from None
    return cast(LocatedElement, builder.close())


# --- Elements of old files --------------------------------------------------------------------------------------------


def named_like(element: LocatedElement, tag: str, **attributes: str) -> LocatedElement:
    """Another element under the same name, at the same place."""
    return LocatedElement(tag, {"name": element.get("name", "")} | attributes, element.place)


def with_parameters(element: LocatedElement, tag: str = "float", **parameters: str) -> LocatedElement:
    element.extend(named_like(element, tag, name=name, value=value) for name, value in parameters.items())
    return element


def old_subsurface(element: LocatedElement, searched: Sequence[Path]) -> tuple[Element, str]:
    comment = cast(Element, ElementTree.Comment("subsurface"))
    return comment, "subsurface scattering is left out: the surface alone is rendered"


def old_animation(element: LocatedElement, searched: Sequence[Path]) -> tuple[Element, str]:
    first = named_like(element, "transform")
    first.extend(next(iter(element.findall("transform")), []))
    return first, f"an <animation> ('{element.get('name')}'): its first transform instead"


def old_colour(element: LocatedElement, searched: Sequence[Path]) -> tuple[Element, str]:
    """The values of <rgb>, hexadecimal ones too, are linear; those of <srgb> are not."""
    colour = element.get("value", "")
    if colour.startswith("#"):
        values = np.array([*bytes.fromhex(colour[1:7])]) / 255
    elif element.tag == "rgb":
        return element, ""
    else:
        values = np.array([float(value) for value in colour.replace(",", " ").split()])
    linear = srgb_to_linear(values) if element.tag == "srgb" else values
    upgraded = element if element.tag == "rgb" else named_like(element, "rgb")
    upgraded.set("value", ", ".join(f"{value:.6f}" for value in linear))
    return upgraded, ""


def old_blackbody(element: LocatedElement, searched: Sequence[Path]) -> tuple[Element, str]:
    parameters = {name: element.get(name, "1").strip(" K") for name in ("temperature", "scale")}
    return with_parameters(named_like(element, "spectrum", type="blackbody"), **parameters), ""


def old_spectrum(element: LocatedElement, searched: Sequence[Path]) -> tuple[Element, str]:
    """Three values without wavelengths are red, green and blue; more are evenly spaced from 360 to 830 nm."""
    file = element.get("filename")
    paths = [inside(searched[0], str(folder / file), Path(element.place)) for folder in searched] if file else []
    found = next((path for path in paths if path.is_file()), None)
    if found:
        element.set("filename", str(found))
    elif file is not None:
        note = f"the file {file} of a spectrum is missing: 0.5 everywhere instead"
        return named_like(element, "spectrum", value="0.5"), note
    values = element.get("value", "").replace(",", " ").split()
    if len(values) < 3 or any(":" in value for value in values):
        return element, ""
    if len(values) == 3:
        return named_like(element, "rgb", value=", ".join(values)), ""
    regular = named_like(element, "spectrum", type="regular")
    with_parameters(regular, wavelength_min="360", wavelength_max="830")
    return with_parameters(regular, "string", values=", ".join(values)), ""


# The element instead, and a note.
UPGRADES: dict[str, Callable[[LocatedElement, Sequence[Path]], tuple[Element, str]]] = {
    "subsurface": old_subsurface,
    "animation": old_animation,
    **dict.fromkeys(("srgb", "rgb"), old_colour),
    "blackbody": old_blackbody,
    "spectrum": old_spectrum,
}
RENAMED = {"lookAt": "lookat", "camera": "sensor", "luminaire": "emitter"}


def is_old(root: LocatedElement) -> bool:
    """Whether a file is one of Mitsuba 0.x, as one without a version."""
    return root.get("version", "0.6.0").startswith("0.")


def upgrade(root: LocatedElement, searched: Sequence[Path]) -> list[str]:
    """Replace what Mitsuba's parser does not support any more; files are in the folders
    `searched`, of which the first is the scene's. Returns notes.

    Raises ValueError, with its place, for an element whose value is invalid.
    """
    notes = []
    if root.get("version") is None:
        notes.append("the file names no version: read as one of Mitsuba 0.6")
        root.set("version", "0.6.0")
    for parent in root.iter():
        for index, child in enumerate(cast(list[LocatedElement], [*parent])):
            child.attrib.pop("intent", None)
            child.tag = RENAMED.get(child.tag, child.tag)
            if child.tag in UPGRADES:
                try:
                    parent[index], note = UPGRADES[child.tag](child, searched)
                except ValueError as error:
                    raise ValueError(f"{child.place}, <{child.tag}>: {error}") from None
                notes += [note] if note else []
    return [f"{notes.count(note)} times {note}" if notes.count(note) > 1 else note for note in dict.fromkeys(notes)]


# --- Parsing ----------------------------------------------------------------------------------------------------------


class ParsedFile:
    """The nodes of a scene file with references resolved; `searched` are the folders for its files.

    `notes` list omissions. Raises BadInput, naming file, line and element, if it is invalid, and unless all files that
    it includes are XML of bounded size and name nothing outside of their folder.
    """

    def __init__(self, path: Path):
        self.path = path.resolve()
        self.searched = [self.path.parent]
        self.files: list[Path] = []  # that were read, and those of spectra
        self.bytes = 0
        config = mi.parser.ParserConfig(VARIANT)
        config.unused_parameters = mi.LogLevel.Debug
        usual_folders = mi.file_resolver()  # type: ignore[operator]
        folders = mi.FileResolver(usual_folders)
        folders.prepend(str(self.path.parent))
        mi.set_file_resolver(folders)  # type: ignore[operator]
        try:
            root = self.read(self.path)
            self.notes = upgrade(root, self.searched)
            self.files += [Path(each.attrib["filename"]) for each in root.iter("spectrum") if "filename" in each.attrib]
            self.elements = [element for element in root.iter() if isinstance(element, LocatedElement)]
            self.text = ElementTree.tostring(root, "unicode")
            self.state = mi.parser.parse_string(config, self.text)
            mi.parser.transform_upgrade(config, self.state)
            mi.parser.transform_resolve_references(config, self.state)
        except (RuntimeError, ValueError) as error:
            raise BadInput(f"{self.path} cannot be read: {self.reason(error)}") from None
        finally:
            mi.set_file_resolver(usual_folders)  # type: ignore[operator]

    def read(self, file: Path, depth: int = 0) -> LocatedElement:
        """The root of `file`, with the content of included files in place: of its version, or as old as it."""
        self.files.append(file)
        if depth > MAX_INCLUDE_DEPTH or len(self.files) > MAX_INCLUDES + 1:
            limits = f"{MAX_INCLUDES} files, or more than {MAX_INCLUDE_DEPTH} in each other"
            raise BadInput(f"{self.path} includes more than {limits}: merge some")
        try:
            content = file.read_bytes()
        except OSError as error:
            raise BadInput(f"{file} cannot be read: {error.strerror}") from None
        self.bytes += len(content)
        if self.bytes > MAX_BYTES:
            raise BadInput(f"{self.path}: more than {MAX_BYTES >> 20} MiB of XML")
        root = elements_of(file, content)
        for parent in [*root.iter()]:
            for child in [*parent]:
                name = child.get("value" if child.tag == "path" else "filename")
                if child.tag not in ("path", "include", "spectrum") or name is None:
                    continue
                if "$" in name:
                    raise BadInput(f"{file}: the name '{name}' depends on a parameter: write the file's name")
                named = inside(self.path.parent, name, file)
                if child.tag == "path":
                    self.searched.append(named)
                elif child.tag == "include":
                    part = self.read(named, depth + 1)
                    if part.get("version") == root.get("version") or (is_old(part) and is_old(root)):
                        place = [*parent].index(child)
                        parent[place : place + 1] = [*part]
        return root

    def element(self, offset: int) -> LocatedElement:
        """The element that begins at an offset in the text, or the last one before it."""
        return self.elements[len(re.findall(r"<[^/!?]", self.text[: offset + 1])) - 1]

    def line_of(self, node: mi.parser.SceneNode) -> str:
        """Where a node is described: " (line 12)"; nothing for one of a file that Mitsuba includes."""
        return "" if node.file_index else f" ({self.element(node.offset + 1).place.rpartition('/')[2]})"

    def lookat_up(self, node: mi.parser.SceneNode) -> list[float] | None:
        """The `up` of the <lookat> that a sensor's transform ends with; None where there is none that can be read."""
        steps = [] if node.file_index else self.element(node.offset + 1).findall("transform/*")
        last = steps[-1] if steps else None
        up = numbers(last.get("up")) if last is not None and last.tag == "lookat" else []
        return up if len(up) == 3 else None

    def reason(self, error: Exception) -> str:
        """An error's message with the place and tag of the element that it is about."""
        position = re.search(r"string \(line (\d+), col (\d+)\): (.*)", str(error), re.DOTALL)
        if not position:
            return mitsuba_reason(error)
        line, column = int(position[1]), int(position[2])
        before = self.text.split("\n")[: line - 1]
        element = self.element(sum(len(each) + 1 for each in before) + column)
        return f"{element.place}, <{element.tag}>: {mitsuba_reason(RuntimeError(position[3]))}"
