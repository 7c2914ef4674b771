"""Scene files as plain data: shapes, lights and a camera as Mitsuba dictionaries."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from errors import BadInput
from render.backend import mi
from render.loading import PLACE
from render.scene_file.stand_ins import GREY, REPAIRS, SURFACE_LIGHTS, Names, Properties, StandIn, plugins, stand_in
from render.scene_file.xml import ParsedFile, inside
from scenes.animation import StockLight, StockShape
from scenes.colours import diffuse_bsdf, rgb

RENDERER_SETTINGS = ("Sampler", "Film", "ReconstructionFilter")  # of other renderers: frames here follow the TOML
# By kind of object: the kinds that may be nested in it. Mitsuba crashes on some others.
PARTS = {
    "Shape": ("BSDF", "Emitter", "Sensor", "Shape", "Texture"),
    "BSDF": ("BSDF", "Texture"),
    "Emitter": ("Texture",),
    "Texture": ("Texture", "Volume"),
}
WHITE_SKY = {"type": "constant", "radiance": rgb([1.0, 1.0, 1.0])}
SKIES = ("constant", "envmap", "sunsky")  # a scene has at most one
UP = "_up"  # of the <lookat> of a sensor: a key of its dictionary that Mitsuba does not get
OWN_INTEGRATORS = ("path", "direct")  # with the same light transport as here


def turned_to_y(described: Properties) -> Properties:
    """A sky of versions before 3, with its zenith at y instead of z."""
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return described | {"to_world": described.get("to_world", np.eye(4)) @ turn}


class SceneFile:
    """The content of a Mitsuba XML file; `notes` list what is not honoured, and its stand-ins, `files` what it names.

    A node with several references is one shared dictionary. Raises BadInput, naming the file, if it cannot be used, or
    if nothing is left to render.
    """

    def __init__(self, path: Path):
        self.parsed = ParsedFile(path)
        self.path = self.parsed.path
        self.state = self.parsed.state
        self.shapes: list[StockShape] = []
        self.lights: list[StockLight] = []
        self.sensor: Properties | None = None
        self.max_depth: int | None = None
        self.notes = self.parsed.notes
        self.files = self.parsed.files
        self.names = Names()
        self.described = cache(self.describe)
        adders = {
            "Shape": self.add_shape,
            "Sensor": self.add_sensor,
            "Integrator": self.add_integrator,
            "Emitter": self.add_light,
        }
        for _, index in self.children(self.state.root):
            kind = self.kind(index)
            if kind in adders:
                adders[kind](index)
            elif kind not in ("BSDF", "Texture", *RENDERER_SETTINGS):
                self.note(f"a {kind.lower()} is left out", self.state.nodes[index])
        if not self.shapes:
            raise BadInput("; ".join([f"{self.path} has no shape to render", *self.notes]))
        if not self.lights and not any(shape.emitter for shape in self.shapes):
            self.note("there is no light: a uniform white sky instead")
            self.lights.append(StockLight(self.names.unique("white-sky"), WHITE_SKY))

    def note(self, text: str, node: mi.parser.SceneNode | None = None) -> None:
        """Add a note, on a node by its id, its file, or its plugin."""
        if node is not None:
            name = node.props.id() or str(node.props.get("filename", "")) or node.props.plugin_name()
            text = f"{name}{self.parsed.line_of(node)}: {text}"
        self.notes.append(text)

    def kind(self, index: int) -> str:
        return str(self.state.nodes[index].type).rpartition(".")[2]

    def children(self, node: mi.parser.SceneNode) -> list[tuple[str, int]]:
        """(name, node index) of a node's references, in their order."""
        props = node.props
        return [(key, props[key].index()) for key in props if props.type(key) == mi.Properties.Type.ResolvedReference]

    def describe(self, index: int) -> Properties | None:
        """The dictionary of a node, which is `described` once; None if it is left out."""
        node = self.state.nodes[index]
        kind = self.kind(index)
        plugin = node.props.plugin_name()
        described: Properties = {"type": plugin, PLACE: self.parsed.line_of(node)}
        for key in node.props:
            value = self.value(node, key)
            if key == "type":  # in dictionaries this is the plugin's name
                self.note("a property called 'type' is left out", node)
            elif value is not None:
                described[key.lstrip("_")] = value
        if plugin in ("sky", "sun", "sunsky") and self.is_old(node):
            described = turned_to_y(described)
        if plugin not in plugins() or (kind == "Shape" and plugin == "hair"):  # today that is a material
            found, words = stand_in(kind, described)
            self.note(f"this Mitsuba has no {kind.lower()} '{plugin}': {words} instead", node)
        else:
            found = self.with_files(node, kind, described)
        repair = REPAIRS[found["type"]](found) if found and found["type"] in REPAIRS else None
        if repair is None:
            return found
        if repair[1]:
            self.note(repair[1], node)
        return repair[0]

    def value(self, node: mi.parser.SceneNode, key: str) -> Any:
        """A property as plain data; None if it is left out."""
        props = node.props
        value = props[key]
        match props.type(key).name:
            case form if key == "to_world" and form != "Transform":
                self.note("its to_world is no transform: left out", node)
                return None
            case "ResolvedReference":
                kind = self.kind(value.index())
                if kind in ("Medium", "PhaseFunction"):
                    self.note(f"a {kind.lower()} is left out: only surfaces are rendered", node)
                    return None
                if kind in RENDERER_SETTINGS:
                    return None
                if kind not in PARTS.get(str(node.type).rpartition(".")[2], (kind,)):
                    self.note(f"a {kind.lower()} cannot be nested here: left out", node)
                    return None
                return self.described(value.index())
            case "Color":
                return {"type": "rgb", "value": np.array(value).tolist()}
            case "Transform":
                return np.array(value.matrix, np.float64)
            case "Vector":
                return np.array(value).tolist()
            case "Spectrum" if not value.is_uniform():
                self.note(f"the spectrum '{key}' is rendered as red, green and blue", node)
        return value

    def with_files(self, node: mi.parser.SceneNode, kind: str, described: Properties) -> Properties | None:
        """The dictionary with the full path of its file, or a stand-in if that is missing."""
        if "filename" not in described:
            return described
        name = str(described["filename"])
        for folder in self.parsed.searched:
            path = inside(self.path.parent, str(folder / name), self.path)
            if path.is_file():
                self.files.append(path)
                return described | {"filename": str(path)}
        replacements: dict[str, StandIn] = {
            "Texture": (GREY, "grey instead of this texture"),
            "Emitter": (WHITE_SKY, "a uniform white sky instead"),
            "BSDF": (diffuse_bsdf(GREY), "a grey diffuse surface instead"),
        }
        replacement, words = replacements.get(kind, (None, f"this {kind.lower()} is left out"))
        self.note(f"the file {name} is missing: {words}", node)
        return replacement

    def unique_name(self, node: mi.parser.SceneNode) -> str:
        """A shape's or light's id, or the name of its file or plugin, numbered if it is taken."""
        props = node.props
        plain = props.id() if not props.id().startswith("_") else ""
        return self.names.unique(plain or Path(str(props.get("filename", ""))).stem or props.plugin_name())

    def add_shape(self, index: int) -> None:
        node = self.state.nodes[index]
        if node.props.plugin_name() == "shapegroup":
            return  # instances refer to it
        if node.props.plugin_name() == "merge":
            for _, child in self.children(node):
                if self.kind(child) == "Shape":
                    self.add_shape(child)
                else:
                    self.note(f"a {self.kind(child).lower()} of merged shapes is left out", node)
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
                    self.note("a sensor on a shape is left out", node)
                elif kind == "Emitter" and value is not None and value["type"] not in SURFACE_LIGHTS:
                    self.note(f"a light of the kind {value['type']} on a shape is left out", node)
                elif value is not None:
                    if kind in parts:
                        self.note(f"a further {kind.lower()} on the same shape: the last one is rendered", node)
                    parts[kind] = value
        if "Emitter" not in parts and self.is_invisible(node, parts.get("BSDF")):
            self.note("the boundary of a medium is no surface: left out", node)
            return
        name = self.unique_name(node)
        self.shapes.append(StockShape(name, described, parts.get("BSDF"), parts.get("Emitter")))

    def is_invisible(self, node: mi.parser.SceneNode, bsdf: Properties | None) -> bool:
        """Whether light passes through a shape unchanged; before version 3, that was the default around a medium."""
        if bsdf is not None:
            return bool(bsdf["type"] == "null")
        return self.is_old(node) and any(self.kind(child) == "Medium" for _, child in self.children(node))

    def is_old(self, node: mi.parser.SceneNode) -> bool:
        """Whether a node is from a file of a version before 3."""
        return str(self.state.versions[node.file_index]).startswith("0.")

    def add_sensor(self, index: int) -> None:
        node = self.state.nodes[index]
        if self.sensor is not None:
            self.note("a further sensor is left out: the first one is the camera", node)
            return
        described = self.described(index)
        if described is None or described["type"] not in ("perspective", "thinlens"):
            self.note("not a perspective camera: left out", node)
            return
        if described["type"] == "thinlens":
            self.note("a lens: a pinhole instead, without depth of field", node)
        films = [self.state.nodes[child].props for _, child in self.children(node) if self.kind(child) == "Film"]
        if any(key.startswith("crop_") for props in films for key in props):
            self.note("its film is cropped: the whole view is rendered", node)
        if "near_clip" in described or "far_clip" in described:
            self.note("near_clip and far_clip: nothing is clipped", node)
        up = self.parsed.lookat_up(node)
        self.sensor = described | {UP: up} if up else described

    def add_light(self, index: int) -> None:
        """Add a light that belongs to no shape."""
        node = self.state.nodes[index]
        light = self.described(index)
        if light is None:
            return
        if light["type"] in SURFACE_LIGHTS:
            self.note("a light for surfaces, but on none: left out", node)
            return
        if light["type"] in SKIES and any(other.emitter["type"] in SKIES for other in self.lights):
            self.note("a second sky is left out: there can be only one", node)
            return
        self.lights.append(StockLight(self.unique_name(node), light))

    def add_integrator(self, index: int) -> None:
        props = self.state.nodes[index].props
        nested = self.children(self.state.nodes[index])
        for _, inner in nested:
            self.add_integrator(inner)
        if props.get("hide_emitters", False):
            self.note("hide_emitters: lights stay visible")
        if props.plugin_name() not in OWN_INTEGRATORS:
            self.note(f"the integrator '{props.plugin_name()}': path tracing instead")
        depth = props.get("max_depth", None)
        if depth == 1:
            self.note("max_depth 1 is light seen directly, alone: surfaces show direct light, too")
        if isinstance(depth, int) and depth > 0:
            self.max_depth = max(depth, 2)
        elif props.plugin_name() == "direct":
            self.max_depth = 2
        elif not nested:
            self.note("paths of any length: of 2 bounces, unless the TOML sets `bounces`")
