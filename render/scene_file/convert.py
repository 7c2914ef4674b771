"""The nodes of a scene file as plain data: shapes, lights and a camera as Mitsuba's dictionaries."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from errors import BadInput
from render.backend import mi
from render.scene_file.stand_ins import (
    GREY,
    SKIES,
    SURFACE_LIGHTS,
    WHITE_SKY,
    Properties,
    plugins,
    repaired,
    stand_in,
    turned_to_y,
)
from render.scene_file.xml import inside, parse
from scenes.animation import StockLight, StockShape
from scenes.names import Names

RENDERER_SETTINGS = ("Sampler", "Film", "ReconstructionFilter")  # of other renderers: frames here follow the TOML
# By kind of object: what may be nested in it. Mitsuba crashes on some others.
PARTS = {
    "Shape": ("BSDF", "Emitter", "Sensor", "Shape", "Texture"),
    "BSDF": ("BSDF", "Texture"),
    "Emitter": ("Texture",),
    "Texture": ("Texture", "Volume"),
}
OWN_INTEGRATORS = ("path", "direct")  # whose light transport is what is rendered here


@dataclass
class SceneFile:
    """What a scene file holds; `notes` say what is not honoured, and what stands in for it."""

    path: Path
    shapes: list[StockShape] = field(default_factory=list)
    lights: list[StockLight] = field(default_factory=list)
    sensor: Properties | None = None
    max_depth: int | None = None
    notes: list[str] = field(default_factory=list)


class Converter:
    """Turns the nodes of one file into dictionaries; a node that several refer to is one dictionary for all."""

    def __init__(self, path: Path):
        self.root = path.resolve().parent
        self.state, self.searched, notes = parse(path)
        self.made: dict[int, Properties | None] = {}
        self.file = SceneFile(path.resolve(), notes=notes)
        self.names = Names()

    def note(self, text: str) -> None:
        self.file.notes.append(text)

    def name_of(self, node: mi.parser.SceneNode) -> str:
        """How messages call a node: its id, its file, or its plugin."""
        props = node.props
        return props.id() or str(props.get("filename", "")) or props.plugin_name()

    def kind(self, index: int) -> str:
        """The kind of a node: BSDF, Shape, Emitter, Texture, ..."""
        return str(self.state.nodes[index].type).rpartition(".")[2]

    def children(self, node: mi.parser.SceneNode) -> list[tuple[str, int]]:
        """(name, node index) of all that a node refers to, in their order."""
        props = node.props
        return [(key, props[key].index()) for key in props if props.type(key) == mi.Properties.Type.ResolvedReference]

    def described(self, index: int) -> Properties | None:
        """The dictionary of a node; None where nothing stands in for it. The same one at each call."""
        if index not in self.made:
            self.made[index] = self.describe(index)
        return self.made[index]

    def describe(self, index: int) -> Properties | None:
        node = self.state.nodes[index]
        kind = self.kind(index)
        plugin = node.props.plugin_name()
        described: Properties = {"type": plugin}
        for key in node.props:
            value = self.value(node, key)
            if key == "type":  # in dictionaries this is the plugin's name
                self.note(f"{self.name_of(node)}: a property called 'type' is left out")
            elif value is not None:
                described[key.lstrip("_")] = value
        if plugin in ("sky", "sun", "sunsky") and str(self.state.versions[node.file_index]).startswith("0."):
            described = turned_to_y(described)
        if plugin not in plugins() or (kind == "Shape" and plugin == "hair"):  # today that is a material
            found, words = stand_in(kind, described)
            self.note(f"{self.name_of(node)}: this Mitsuba has no {kind.lower()} '{plugin}': {words} instead")
        else:
            found = self.with_files(node, kind, described)
        repair = repaired(found) if found else None
        if repair is None:
            return found
        self.note(f"{self.name_of(node)}: {repair[1]}")
        return repair[0]

    def value(self, node: mi.parser.SceneNode, key: str) -> Any:
        """A property as plain data; None for what is left out."""
        props = node.props
        value = props[key]
        match props.type(key).name:
            case form if key == "to_world" and form != "Transform":
                self.note(f"{self.name_of(node)}: its to_world is no transform: left out")
                return None
            case "ResolvedReference":
                kind = self.kind(value.index())
                if kind in ("Medium", "PhaseFunction"):
                    self.note(f"{self.name_of(node)}: a {kind.lower()} is left out: only surfaces are rendered")
                    return None
                if kind in RENDERER_SETTINGS:
                    return None
                if kind not in PARTS.get(str(node.type).rpartition(".")[2], (kind,)):
                    self.note(f"{self.name_of(node)}: a {kind.lower()} means nothing here: left out")
                    return None
                return self.described(value.index())
            case "Color":
                return {"type": "rgb", "value": np.array(value).tolist()}
            case "Transform":
                return np.array(value.matrix, np.float64)
            case "Vector":
                return np.array(value).tolist()
            case "Spectrum":
                if not value.is_uniform():
                    self.note(f"{self.name_of(node)}: the spectrum '{key}' is rendered as red, green and blue")
                return value
            case _:
                return value

    def with_files(self, node: mi.parser.SceneNode, kind: str, described: Properties) -> Properties | None:
        """The dictionary with the full path of its file, or what stands in where that is missing."""
        if "filename" not in described:
            return described
        name = str(described["filename"])
        for folder in self.searched:
            path = inside(self.root, str(folder / name), self.file.path)
            if path.is_file():
                return described | {"filename": str(path)}
        missing = f"{self.name_of(node)}: the file {name} is missing"
        if kind == "Texture":
            self.note(f"{missing}: grey instead of this texture")
            return GREY
        if kind == "Emitter":
            self.note(f"{missing}: an even white sky instead")
            return WHITE_SKY
        if kind == "BSDF":
            self.note(f"{missing}: a grey diffuse surface instead")
            return {"type": "diffuse", "reflectance": GREY}
        self.note(f"{missing}: this {kind.lower()} is left out")
        return None

    def unique_name(self, node: mi.parser.SceneNode) -> str:
        """A shape's or light's id, or the name of its file or plugin, numbered where it is not the first of them."""
        props = node.props
        plain = props.id() if not props.id().startswith("_") else ""
        return self.names.unique(plain or Path(str(props.get("filename", ""))).stem or props.plugin_name())

    def add_shape(self, index: int) -> None:
        """Take a shape in, with its material and its light."""
        node = self.state.nodes[index]
        if node.props.plugin_name() == "shapegroup":
            return  # instances refer to it
        if node.props.plugin_name() == "merge":
            for _, child in self.children(node):
                if self.kind(child) == "Shape":
                    self.add_shape(child)
                else:
                    self.note(f"{self.name_of(node)}: a {self.kind(child).lower()} of merged shapes is left out")
            return
        described = self.described(index)
        if described is None:
            return
        parts: dict[str, Properties] = {}
        for key, child in self.children(node):
            kind = self.kind(child)
            if kind in ("BSDF", "Emitter", "Sensor"):
                value = described.pop(key.lstrip("_"), None)
                if kind == "Sensor":
                    self.note(f"{self.name_of(node)}: a sensor on a shape is left out")
                elif kind == "Emitter" and value is not None and value["type"] not in SURFACE_LIGHTS:
                    self.note(f"{self.name_of(node)}: a light of the kind {value['type']} on a shape is left out")
                elif value is not None:
                    parts[kind] = value
        name = self.unique_name(node)
        self.file.shapes.append(StockShape(name, described, parts.get("BSDF"), parts.get("Emitter")))

    def add_sensor(self, index: int) -> None:
        node = self.state.nodes[index]
        if self.file.sensor is not None:
            self.note(f"{self.name_of(node)}: a further sensor is left out: the first one is the camera")
            return
        described = self.described(index)
        if described is None or described["type"] not in ("perspective", "thinlens"):
            self.note(f"{self.name_of(node)}: not a perspective camera: left out")
            return
        if described["type"] == "thinlens":
            self.note(f"{self.name_of(node)}: a lens: a pinhole instead, without depth of field")
        if "near_clip" in described or "far_clip" in described:
            self.note(f"{self.name_of(node)}: near_clip and far_clip: nothing is cut off")
        self.file.sensor = described

    def add_light(self, index: int) -> None:
        """Take a light in that is on no shape."""
        light = self.described(index)
        if light is None:
            return
        if light["type"] in SURFACE_LIGHTS:
            self.note(f"{self.name_of(self.state.nodes[index])}: a light of a surface, but on none: left out")
            return
        if light["type"] in SKIES and any(other.emitter["type"] in SKIES for other in self.file.lights):
            self.note(f"{self.name_of(self.state.nodes[index])}: a second sky is left out: there can be one")
            return
        self.file.lights.append(StockLight(self.unique_name(self.state.nodes[index]), light))

    def add_integrator(self, index: int) -> None:
        props = self.state.nodes[index].props
        for _, inner in self.children(self.state.nodes[index]):
            self.add_integrator(inner)
        if props.get("hide_emitters", False):
            self.note("hide_emitters: lights are seen all the same")
        if props.plugin_name() not in OWN_INTEGRATORS:
            self.note(f"the integrator '{props.plugin_name()}': path tracing instead")
        depth = props.get("max_depth", None)
        if isinstance(depth, int) and depth > 0:
            self.file.max_depth = depth
        elif props.plugin_name() == "direct":
            self.file.max_depth = 2

    def convert(self) -> SceneFile:
        """All of the file. Raises BadInput where nothing is left to render."""
        for _, index in self.children(self.state.root):
            node = self.state.nodes[index]
            kind = self.kind(index)
            if kind == "Shape":
                self.add_shape(index)
            elif kind == "Sensor":
                self.add_sensor(index)
            elif kind == "Integrator":
                self.add_integrator(index)
            elif kind == "Emitter":
                self.add_light(index)
            elif kind not in ("BSDF", "Texture", *RENDERER_SETTINGS):
                self.note(f"{self.name_of(node)}: a {kind.lower()} is left out")
        if not self.file.shapes:
            raise BadInput("; ".join([f"{self.file.path} has no shape to render", *self.file.notes]))
        if not self.file.lights and not any(shape.emitter for shape in self.file.shapes):
            self.note("nothing shines: an even white sky instead")
            self.file.lights.append(StockLight(self.names.unique("white-sky"), WHITE_SKY))
        return self.file


def convert(path: Path) -> SceneFile:
    """What a Mitsuba XML file holds. Raises BadInput, naming the file, for one that cannot be used."""
    return Converter(path).convert()
