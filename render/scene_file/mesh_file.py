"""glTF, OBJ and PLY files with their materials, lit by their own emission or by a sky."""

import logging
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import SimpleMaterial

from errors import BadInput, can_draw
from render.scene_file.assets import InsideResolver, check_mesh, mended, stored_texture, two_sided
from render.scene_file.gltf import GltfFile
from render.scene_file.stand_ins import GREY, Names
from scenes.animation import Camera, Shape, Track
from scenes.camera import Array
from scenes.colours import Bsdf, rgb
from scenes.textures import sky

Found = TypeVar("Found")

GLTF_FORMATS = (".glb", ".gltf")
FORMATS = (*GLTF_FORMATS, ".obj", ".ply")
SUN = np.array([0.4, 0.8, 0.45])  # the direction to it, y up


@contextmanager
def collected_problems() -> Iterator[list[str]]:
    """Within the context trimesh prints nothing, and its messages on what it could not read are collected."""
    log = logging.getLogger("trimesh")
    level, propagate = log.level, log.propagate
    problems: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno >= logging.WARNING or re.match("unable to|failed to|skipping|face|specified", message):
            problems.append(f"trimesh: {message[:200]}")
        return False

    handler = logging.Handler()
    handler.addFilter(collect)
    log.addHandler(handler)
    log.setLevel(logging.DEBUG)
    log.propagate = False
    try:
        yield problems
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        log.propagate = propagate


def colour_factor(value: Any) -> Array:
    """The first three components of a colour, given in [0, 1] or as bytes; white for none."""
    if value is None:
        return np.ones(3)
    value = np.asarray(value)
    return value[:3] / 255 if value.dtype == np.uint8 else value[:3].astype(np.float64)


# Keywords of an OBJ's materials: the property that is left out, and the value that stands for none.
LEFT_OUT: dict[str, tuple[str, list[float]]] = {
    "ks": ("gloss", [0.0, 0.0, 0.0]),
    "d": ("transparency", [1.0]),
    "tr": ("transparency", [0.0]),
    "map_d": ("transparency", []),
    "map_bump": ("relief", []),
    "bump": ("relief", []),
    "map_ke": ("light", []),
}


def plain_numbers(words: Any) -> list[float]:
    """The numbers in a line of a material; NaN if they are malformed."""
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError):
        return [np.nan]


def bsdf_of(mesh: trimesh.Trimesh, name: str, notes: list[str]) -> tuple[Bsdf, Array | None]:
    """(material, emitted radiance or None) of a mesh."""
    material = getattr(mesh.visual, "material", None)
    if isinstance(material, SimpleMaterial):
        lines = material.kwargs
        for key, (what, none) in LEFT_OUT.items():
            if key in lines and plain_numbers(lines[key]) != none:
                notes.append(f"{name}: its {what} ({key}) is left out")
        emission = np.array(plain_numbers(lines.get("ke", [])))
        exact = np.array(plain_numbers(lines.get("kd", [])))  # trimesh rounds its `diffuse` to 8 bits
        exact = exact if exact.shape == (3,) and np.isfinite(exact).all() else colour_factor(material.diffuse)
        colour = rgb(exact.clip(0, 1).tolist())
        image = getattr(material, "image", None)
        if image is not None:
            if image.info.get("file_path", "").startswith("-"):
                notes.append(f"{name}: the options of its texture are left out")
            try:
                colour = stored_texture(image, raw=False)
            except Exception as error:  # Pillow raises many kinds of exceptions for damaged files
                notes.append(f"{name}: its texture is damaged ({type(error).__name__}): left out")
        return two_sided(colour), emission if emission.shape == (3,) and emission.any() else None
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind in ("vertex", "face"):
        places = {"vertex": "vertices", "face": "faces"}[mesh.visual.kind]
        notes.append(f"{name}: colours of its {places}: the most frequent one everywhere instead")
        return two_sided(rgb(colour_factor(np.asarray(mesh.visual.main_color)).tolist())), None
    notes.append(f"{name}: has no material: grey instead")
    return two_sided(GREY), None


def read(path: Path, reader: Callable[[Path, InsideResolver], Found]) -> tuple[Found, list[str], list[Path]]:
    """What `reader` finds in a file, notes on missing files, and the files that were read.

    Raises BadInput, naming the file, if it is missing, damaged, of another format, or refers to files elsewhere.
    """
    if path.suffix.lower() not in FORMATS:
        raise BadInput(f"{path} is no scene file: Mitsuba's .xml, or one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise BadInput(f"{path} is missing")
    resolver = InsideResolver(path)
    found = None
    damage = ""
    try:
        with warnings.catch_warnings(action="ignore"):
            found = reader(path, resolver)
    except BadInput:
        raise
    except Exception as error:  # readers raise many kinds of exceptions for damaged files
        damage = " ".join(f"{type(error).__name__}: {error}"[:200].split())
    if resolver.outside:
        raise BadInput(f"{path}: '{resolver.outside[0]}' leaves the scene's folder: move it into that folder")
    if found is None:
        missing = f": {resolver.missing[0]} is missing" if resolver.missing else f" is empty or damaged ({damage})"
        raise BadInput(f"{path}{missing}")
    notes = [f"the file {name} is missing: its content is left out" for name in dict.fromkeys(resolver.missing)]
    if not can_draw():
        notes.append("textures are left out: reading them needs `pip install 'onespp[report]'`")
    return found, notes, resolver.files


def load_scene(path: Path, resolver: InsideResolver) -> tuple[trimesh.Scene, list[str]]:
    """An OBJ or PLY as trimesh reads it, and what it says of problems."""
    with collected_problems() as problems:
        return trimesh.load_scene(path, resolver=resolver, process=False), problems


class MeshFile:
    """All meshes of a file, and its camera for images of an `aspect` (width over height); a clear sky if unlit.

    `notes` list what is not honoured, `files` what was read. Raises BadInput, naming the file, if it is missing,
    damaged or empty.
    """

    def __init__(self, path: Path, aspect: float):
        self.shapes: list[Shape] = []
        self.camera: Camera | None = None
        self.sky: Array | None = None
        if path.suffix.lower() in GLTF_FORMATS:
            gltf, self.notes, self.files = read(path, GltfFile)
            self.notes += dict.fromkeys(gltf.notes)
            self.shapes = gltf.shapes
            try:
                self.camera = gltf.camera(aspect)
            except (KeyError, IndexError, TypeError, ValueError):
                self.notes.append("its cameras are damaged: left out")
        else:
            (scene, problems), self.notes, self.files = read(path, load_scene)
            self.notes += dict.fromkeys(problems)
            self.add_shapes(path, scene)
        if not self.shapes:
            raise BadInput("; ".join([f"{path} has no mesh to render", *self.notes]))
        if not any(shape.radiance for shape in self.shapes):
            self.notes.append("there is no light: a clear sky with the sun, y up")
            self.sky = sky(np.random.default_rng(0), SUN)

    def add_shapes(self, path: Path, scene: trimesh.Scene) -> None:
        """Add the meshes of an OBJ or PLY, whose nodes trimesh names after its materials or the file."""
        names = Names()
        for node in scene.graph.nodes_geometry:
            mesh = scene.geometry[scene.graph[node][1]]
            name = names.unique(str(node))
            if not isinstance(mesh, trimesh.Trimesh):
                self.notes.append(f"{name}: no mesh, but a {type(mesh).__name__}: left out")
                continue
            check_mesh(mesh, name, path)
            bsdf, radiance = bsdf_of(mesh, name, self.notes)
            if not isinstance(mesh.visual, TextureVisuals):
                mesh.visual = TextureVisuals()
            emission = None if radiance is None else Track.constant(radiance)
            self.shapes.append(mended(Shape(name, mesh, bsdf, emission, smooth=True), self.notes))
