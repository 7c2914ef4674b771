"""Furniture from libraries of Sweet Home 3D (.sh3f): a catalogue, and OBJ models with materials and textures."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np
import trimesh

from errors import BadInput, requires_extra
from scenes.camera import Array, unit
from scenes.colours import MAX_REFLECTANCE, MIN_REFLECTANCE, Bsdf, bitmap, diffuse_bsdf, rgb, srgb_to_linear
from scenes.draws import Rng, log_uniform, one_of
from scenes.meshes import Faces, Surface, area_vectors, box_mapped, flat_shaded
from scenes.objects.thing import Maker, Thing, standing, top_support

CATALOGUE = "PluginFurnitureCatalog.properties"
UNUSED_CATEGORIES = ("Doors and windows", "Exterior", "Staircases", "Vehicles")
SUPPORTING = ("table", "desk", "drawer", "cabinet", "dresser", "sideboard", "stand", "shelf")  # in names
LARGEST_FILE = 1_500_000  # bytes of an OBJ file; larger ones take seconds to read
MOST_PARTS = 10  # of a model; its materials
SMALL = 0.45  # m; smaller pieces stand on others
LARGEST_PIECE = 2.8  # m
TEXTURE_LIMIT = 512  # px
LEAST_OPACITY = 0.5  # opacity below which parts are left out: sheets of glass show next to nothing of themselves
VARNISHED = 0.6  # share of the materials that are neither metal nor glass
METAL = re.compile("metal|chrome|steel|alumin|brass|inox", re.IGNORECASE)
SMALLEST_AREA = 1e-10  # m², twice that of a triangle; smaller ones are left out
ATTEMPTS = 20


class Piece(NamedTuple):
    """A model in a library."""

    library: Path
    model: str  # the OBJ file in it
    size: tuple[float, float, float]  # m: width, height, depth
    rotation: tuple[float, ...]  # of the model before it gets its size: 3 x 3, by rows
    support: float  # m, the height at which smaller things stand on it; 0 for none
    creator: str


class Library(NamedTuple):
    """A library file and what its catalogue says."""

    file: Path
    licence: str
    pieces: Sequence[Piece]

    def credit(self) -> str:
        """Name, licence and authors, for the card of a data set."""
        creators = sorted({piece.creator for piece in self.pieces if piece.creator})
        return f"furniture of {self.file.name} ({self.licence}), by {', '.join(creators)}"


def entries(text: str) -> dict[str, dict[str, str]]:
    """The values of a catalogue by number and key; what concerns the whole library has the number ''."""
    found: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if match := re.match(r"\s*(\w+)(?:#(\d+))?\s*[=:]\s*(.*)", line):
            found.setdefault(match[2] or "", {})[match[1]] = match[3].strip()
    return found


def piece_of(file: Path, entry: dict[str, str]) -> Piece:
    width, height, depth = (float(entry[key]) / 100 for key in ("width", "height", "depth"))
    stands = any(word in entry["name"].lower() for word in SUPPORTING)
    support = float(entry.get("dropOnTopElevation", 100 * height)) / 100 if stands else 0.0
    rotation = tuple(map(float, entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split()))
    return Piece(file, entry["model"].lstrip("/"), (width, height, depth), rotation, support, entry.get("creator", ""))


def usable(entry: dict[str, str], archive: ZipFile) -> bool:
    """Whether an entry describes furniture that stands on a floor, in an OBJ file of moderate size."""
    if "model" not in entry or entry.get("category") in UNUSED_CATEGORIES or float(entry.get("elevation", 0)) > 0:
        return False
    try:
        return (
            entry["model"].endswith(".obj")
            and entry.get("doorOrWindow") != "true"
            and max(float(entry[key]) for key in ("width", "height", "depth")) <= 100 * LARGEST_PIECE
            and archive.getinfo(entry["model"].lstrip("/")).file_size <= LARGEST_FILE
        )
    except KeyError:
        return False


def open_library(file: Path) -> Library:
    """The catalogue of a .sh3f file. Raises BadInput, naming the file, where it has none."""
    with requires_extra("report"):
        import PIL.Image  # noqa: F401 - without it trimesh would leave out textures
    try:
        with ZipFile(file) as archive:
            found = entries(archive.read(CATALOGUE).decode("latin-1"))
            pieces = [piece_of(file, entry) for number, entry in found.items() if number and usable(entry, archive)]
    except (BadZipFile, KeyError, ValueError, OSError) as error:
        raise BadInput(f"{file} is no furniture library of Sweet Home 3D: {error}") from None
    return Library(file, found.get("", {}).get("license", "licence unknown"), pieces)


@cache
def open_libraries(folder: Path) -> tuple[Library, ...]:
    """All libraries in a folder, by name. Raises BadInput where it has none."""
    files = sorted(folder.glob("*.sh3f"))
    if not files:
        raise BadInput(
            f"{folder} has no furniture libraries (*.sh3f): Debian's package sweethome3d-furniture installs some in "
            "/usr/share/sweethome3d/furniture; others are on the site of Sweet Home 3D"
        )
    return tuple(map(open_library, files))


def texture_of(material: Any) -> Bsdf:
    """The colour of a material of an OBJ file: its texture, else a constant."""
    image = getattr(material, "image", None)
    if image is None:
        linear = srgb_to_linear(np.asarray(material.diffuse[:3]) / 255)
        return rgb(np.clip(linear, MIN_REFLECTANCE, MAX_REFLECTANCE).tolist())
    image = image.convert("RGB")
    image.thumbnail((TEXTURE_LIMIT, TEXTURE_LIMIT))
    linear = srgb_to_linear(np.asarray(image, np.float64) / 255)
    return bitmap(np.clip(linear, MIN_REFLECTANCE, MAX_REFLECTANCE).astype(np.float32))


def material_of_obj(rng: Rng, name: str, material: Any) -> Bsdf:
    """A material like that of an OBJ file, varnished where the file says so, and often elsewhere: few files say it."""
    base = texture_of(material)
    shininess = float(getattr(material, "glossiness", 0) or 0)
    is_shiny = shininess > 1 and np.max(material.specular[:3]) > 40
    if METAL.search(name):
        alpha = log_uniform(rng, 0.05, 0.4)
        return {"type": "twosided", "bsdf": {"type": "roughconductor", "material": "Al", "alpha": alpha}}
    if rng.random() < VARNISHED:
        # The exponent of Blinn's model that has the same width as this alpha (Walter et al. 2007, section 5.3).
        alpha = float(np.clip(np.sqrt(2 / (shininess + 2)), 0.05, 0.5)) if is_shiny else log_uniform(rng, 0.03, 0.4)
        varnished = {"type": "roughplastic", "diffuse_reflectance": base, "alpha": alpha}
        return {"type": "twosided", "bsdf": varnished}
    return {"type": "twosided", "bsdf": diffuse_bsdf(base)}


def is_clear(material: Any) -> bool:
    """Whether a material is mostly transparent, or masked by the alpha of its texture."""
    opacity = float(np.ravel(material.kwargs.get("d", [1]))[0]) if hasattr(material, "kwargs") else 1.0
    image = getattr(material, "image", None)
    masked = image is not None and "A" in image.getbands() and np.mean(np.asarray(image.getchannel("A")) < 128) > 0.02
    return opacity < LEAST_OPACITY or bool(masked)


def surface_of(mesh: trimesh.Trimesh, smooth: bool, place: Array) -> Surface | None:
    """A mesh transformed by `place` (4, 4), with the normals of its file where it is `smooth`; None if it is empty."""
    points = mesh.vertices @ place[:3, :3].T + place[:3, 3]
    faces: Faces = mesh.faces[np.linalg.norm(area_vectors(points, mesh.faces), axis=1) > SMALLEST_AREA]
    if len(faces) == 0:
        return None
    normals = mesh.vertex_normals @ np.linalg.inv(place[:3, :3])
    uv = getattr(mesh.visual, "uv", None)
    is_smooth = smooth and bool((np.linalg.norm(normals, axis=1) > 0).all())
    if uv is None or not np.isfinite(uv).all():
        return box_mapped(points, unit(normals), faces, True) if is_smooth else flat_shaded(points, faces)
    uv = uv * (1, -1) + (0, 1)  # the first row of a bitmap is v = 0 in Mitsuba, v = 1 in OBJ files
    if is_smooth:
        return Surface(points, unit(normals), uv, faces, True)
    corners = faces.ravel()
    normals = np.repeat(unit(area_vectors(points, faces)), 3, axis=0)
    return Surface(points[corners], normals, uv[corners], np.arange(len(corners)).reshape(-1, 3), False)


@lru_cache(maxsize=64)
def model_of(piece: Piece) -> dict[str, tuple[Surface, Any]]:
    """Surfaces and materials of the opaque parts of a piece in its size, by name. Raises ValueError if it has none."""
    with ZipFile(piece.library) as archive:
        data = archive.read(piece.model)
        folder = piece.model.rpartition("/")[0]
        resolver = trimesh.resolvers.ZipResolver(
            archive={
                name.removeprefix(f"{folder}/"): trimesh.util.wrap_as_stream(archive.read(name))
                for name in archive.namelist()
                if name.startswith(f"{folder}/") and not name.endswith("/")
            }
        )
        loaded = trimesh.load_scene(
            trimesh.util.wrap_as_stream(data), file_type="obj", resolver=resolver, group_material=True, process=False
        )
    # By name: draws of materials must not depend on the order in which trimesh finds them.
    meshes = [loaded.geometry[name] for name in sorted(loaded.geometry)]
    if not 1 <= len(meshes) <= MOST_PARTS:
        raise ValueError(f"{len(meshes)} parts")
    turn = np.reshape(piece.rotation, (3, 3))
    turned = np.concatenate([mesh.vertices for mesh in meshes]) @ turn.T
    extent = np.maximum(np.ptp(turned, axis=0), 1e-6)
    place = np.eye(4)
    place[:3, :3] = np.diag(np.array(piece.size) / extent) @ turn
    parts: dict[str, tuple[Surface, Any]] = {}
    for mesh in meshes:
        material = mesh.visual.material
        surface = None if is_clear(material) else surface_of(mesh, b"\nvn " in data, place)
        if surface is not None:
            name = f"{len(parts)}-{getattr(material, 'name', None) or 'part'}"
            parts[re.sub(r"[^\w-]", "_", name)] = surface, material
    if not parts:
        raise ValueError("no opaque part")
    return parts


def make_piece(rng: Rng, pieces: Sequence[Piece]) -> Thing:
    """One of the pieces. Raises ValueError where ATTEMPTS of them cannot be used."""
    for _ in range(ATTEMPTS):
        piece = one_of(rng, pieces)
        try:
            parts = model_of(piece)
        except (ValueError, IndexError, KeyError, TypeError, AttributeError, OSError, BadZipFile):
            continue  # models of all kinds of tools: those that trimesh cannot read are passed over
        width, _, depth = piece.size
        supports = [top_support(width, depth, piece.support, margin=0.15 * min(width, depth))] if piece.support else []
        thing = standing(Path(piece.model).stem, {name: [surface] for name, (surface, _) in parts.items()})
        materials = {name: material_of_obj(rng, name, material) for name, (_, material) in parts.items()}
        return replace(thing, supports=supports, materials=materials)
    raise ValueError(f"none of {ATTEMPTS} pieces of {pieces[0].library.parent} can be used")


def makers_of(libraries: Sequence[Library]) -> tuple[Maker, Maker, Maker]:
    """Makers of furniture for the floor, of small things, and of what stands against walls."""
    pieces = [piece for library in libraries for piece in library.pieces]
    floor = [piece for piece in pieces if max(piece.size) >= SMALL]
    small = [piece for piece in pieces if max(piece.size) < SMALL]
    backed = [piece for piece in floor if piece.size[0] >= max(0.5, piece.size[2]) and piece.size[1] >= SMALL]
    chosen = (floor, small, backed)
    if not all(chosen):
        raise BadInput(f"{pieces[0].library.parent if pieces else 'no library'}: too few pieces to furnish rooms from")
    floor_maker, small_maker, backed_maker = (partial(make_piece, pieces=each) for each in chosen)
    return floor_maker, small_maker, backed_maker
