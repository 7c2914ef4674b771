"""Furniture from libraries that the tests write: sizes, materials, what is passed over, and the rooms made of it."""

import io
import shutil
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image

from datasets.card import licence_of
from datasets.channels import USUAL_CHANNELS
from errors import BadInput
from render.clip import NO_OPTIONS
from render.job.generate import begun
from render.job.plan import plan
from scenes.colours import Bsdf, srgb_to_linear
from scenes.objects.library import VARNISHED, make_piece, model_of, open_libraries, open_library
from scenes.registry import build_scene

HEAD = "id=test\nname=Test\nlicense=CC0\n"
MATERIALS = """newmtl plain
Kd 0.5 0.25 1.0
newmtl pane
Kd 1 1 1
d 0.1
newmtl picture
Kd 1 1 1
map_Kd picture.png
newmtl chrome leg
Kd 0.9 0.9 0.9
"""


def box(x: float, material: str, first: int) -> str:
    """A box 1 x 2 x 4 in an OBJ file, from `x` on along x, whose vertices begin at `first`."""
    corners = [(x + i, 2 * j, 4 * k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    lines = [f"v {a} {b} {c}" for a, b, c in corners] + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", f"usemtl {material}"]
    texels = 4 * (first - 1) // 8
    lines += ["f " + " ".join(f"{first + v}/{texels + t + 1}" for t, v in enumerate(quad)) for quad in quads]
    return "\n".join(lines) + "\n"


def entry(number: int, **changed: str) -> str:
    usual = {"name": f"Table {number}", "category": "Living room", "model": f"/test/t{number}/t.obj", "creator": "Ada"}
    usual |= {"width": "100", "depth": "80", "height": "70", "doorOrWindow": "false"}
    return "".join(f"{key}#{number}={value}\n" for key, value in (usual | changed).items())


def write_library(folder: Path, entries: str, models: dict[str, str]) -> Path:
    picture = np.zeros((2, 2, 3), np.uint8)
    picture[0] = 255, 0, 0  # the upper row
    picture[1] = 0, 0, 128
    png = io.BytesIO()
    Image.fromarray(picture).save(png, "png")
    file = folder / "test.sh3f"
    with ZipFile(file, "w") as archive:
        archive.writestr("PluginFurnitureCatalog.properties", HEAD + entries)
        for model, text in models.items():
            archive.writestr(f"{model}/t.obj", f"mtllib t.mtl\n{text}")
            archive.writestr(f"{model}/t.mtl", MATERIALS)
            archive.writestr(f"{model}/picture.png", png.getvalue())
    return file


@pytest.fixture
def libraries(tmp_path: Path) -> Path:
    """A folder with a library of a table, a vase and a shelf."""
    entries = entry(1) + entry(2, name="Vase", width="10", depth="10", height="20") + entry(3, name="Shelf")
    model = box(0, "plain", 1) + box(3, "picture", 9) + box(5, "pane", 17)
    write_library(tmp_path, entries, {f"test/t{number}": model for number in (1, 2, 3)})
    return tmp_path


def test_a_piece_has_the_size_of_the_catalogue_and_stands_on_the_floor(libraries: Path):
    table = open_libraries(libraries)[0].pieces[0]
    thing = make_piece(np.random.default_rng(0), [table])
    # The pane from x = 5 to 6 belongs to the model, but is not shown.
    assert np.allclose(np.ptp(thing.bounds, axis=0), (1.0 * 4 / 6, 0.7, 0.8))
    assert np.allclose(thing.bounds[0] + thing.bounds[1], (0, 0.7, 0))
    (support,) = thing.supports
    assert support[0, 1] == pytest.approx(0.7) and support[1, 1] == np.inf


def colour_of(material: Bsdf) -> Bsdf:
    """Varnished or not."""
    inside = material["bsdf"]
    return inside["reflectance"] if inside["type"] == "diffuse" else inside["diffuse_reflectance"]


def test_colours_are_linear_and_pictures_upright(libraries: Path):
    thing = make_piece(np.random.default_rng(0), [open_libraries(libraries)[0].pieces[0]])
    plain, picture = (colour_of(thing.materials[slot]) for slot in ("1-plain", "0-picture"))
    assert plain["value"] == pytest.approx(srgb_to_linear(np.array([0.5, 0.25, 1.0])).clip(0.02, 0.9), abs=3e-3)
    # OBJ: v = 1 is the upper row, red; Mitsuba: v = 0 is the first row.
    surface = thing.parts["0-picture"]
    rows = np.rint(surface.uv[:, 1] * 2 - 0.5).clip(0, 1).astype(int)
    assert picture["data"][0, 0] == pytest.approx([0.9, 0.02, 0.02])
    upper = np.isclose(surface.uv[:, 1], 0)
    assert upper.any() and (picture["data"][rows[upper], 0] == picture["data"][0, 0]).all()


def test_metal_is_told_by_its_name(tmp_path: Path):
    file = write_library(tmp_path, entry(1), {"test/t1": box(0, "chrome leg", 1)})
    thing = make_piece(np.random.default_rng(0), open_library(file).pieces)
    assert [material["bsdf"]["type"] for material in thing.materials.values()] == ["roughconductor"]


def test_turned_models(tmp_path: Path):
    turned = entry(1, modelRotation="0 0 1 0 1 0 -1 0 0")  # x from z
    file = write_library(tmp_path, turned, {"test/t1": box(0, "plain", 1)})
    (surface, _) = model_of(open_library(file).pieces[0])["0-plain"]
    assert np.allclose(np.ptp(surface.points, axis=0), (1, 0.7, 0.8))
    # Triangles still face outwards: the divergence theorem gives the volume.
    a, b, c = (surface.points[corner] for corner in surface.faces.T)
    assert abs(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6) == pytest.approx(1 * 0.7 * 0.8)


@pytest.mark.parametrize(
    "changed",
    [{"doorOrWindow": "true"}, {"category": "Vehicles"}, {"elevation": "90"}, {"width": "900"}, {"model": "/no.obj"}],
)
def test_what_does_not_stand_in_rooms_is_passed_over(tmp_path: Path, changed: dict[str, str]):
    file = write_library(tmp_path, entry(1, **changed) + entry(2), {f"test/t{n}": box(0, "plain", 1) for n in (1, 2)})
    assert [piece.model for piece in open_library(file).pieces] == ["test/t2/t.obj"]


def test_damaged_models_are_passed_over_and_only_those(tmp_path: Path):
    good = {"test/t1": box(0, "plain", 1), "test/t2": "v 0 0\nf 1 2 3\n"}
    pieces = open_library(write_library(tmp_path, entry(1) + entry(2), good)).pieces
    assert {make_piece(np.random.default_rng(seed), pieces).name for seed in range(8)} == {"t"}
    with pytest.raises(ValueError, match="can be used"):
        make_piece(np.random.default_rng(0), pieces[1:])


def test_bad_libraries(tmp_path: Path):
    with pytest.raises(BadInput, match="sweethome3d-furniture"):
        open_libraries(tmp_path)
    broken = tmp_path / "broken.sh3f"
    broken.write_bytes(b"no zip")
    with pytest.raises(BadInput, match="broken"):
        open_library(broken)
    with pytest.raises(BadInput, match="--models"):
        build_scene("furnished-room-1", 0, 2)


def diffuse_share(room: str, libraries: Path) -> float:
    """Of all shapes in eight rooms, those that are plainly diffuse."""
    shapes = [shape for number in range(8) for shape in build_scene(f"{room}-{number}", 0, 1, libraries).shapes]
    return sum((shape.bsdf.get("bsdf") or shape.bsdf)["type"] == "diffuse" for shape in shapes) / len(shapes)


@pytest.mark.slow
def test_varnish(libraries: Path):
    """On VARNISHED of the materials, so that furnished rooms are glossier than others."""
    pieces = open_libraries(libraries)[0].pieces[:1]
    things = [make_piece(np.random.default_rng(seed), pieces) for seed in range(100)]
    plain = [thing.materials["1-plain"]["bsdf"] for thing in things]
    varnished = [bsdf for bsdf in plain if bsdf["type"] == "roughplastic"]
    assert len(varnished) / len(plain) == pytest.approx(VARNISHED, abs=0.15)  # three deviations
    assert all(0.03 <= bsdf["alpha"] <= 0.5 for bsdf in varnished)
    assert diffuse_share("furnished-room", libraries) < 0.7 * diffuse_share("room", libraries)


def test_furnished_rooms_hold_pieces_and_are_deterministic(libraries: Path):
    one, again = (build_scene("furnished-room-1", 0, 2, libraries) for _ in range(2))
    names = [shape.name for shape in one.shapes]
    assert names == [shape.name for shape in again.shapes]
    assert any(name.endswith("-t-1-plain") for name in names)


@pytest.mark.slow
def test_libraries_leave_plain_rooms_as_they_are(libraries: Path):
    own = build_scene("room-1", 0, 2, libraries)
    assert [shape.name for shape in own.shapes] == [shape.name for shape in build_scene("room-1", 0, 2).shapes]


def test_training_rooms_are_furnished_and_test_rooms_are_not(libraries: Path):
    made = plan("rooms-2x4", 0, models=str(libraries))
    assert made["splits"]["train"] == ["furnished-room-0/000", "furnished-room-1/000"]
    assert all(name.startswith("room-") for name in made["splits"]["test"])
    assert made["models"]["credits"] == ["furniture of test.sh3f (CC0), by Ada"]
    assert plan("rooms-2x4", 0)["models"] == {}
    assert plan("furnished", 0, models=str(libraries))["splits"]["train"][0].startswith("furnished-room-")
    with pytest.raises(BadInput, match="furnished needs furniture: --models DIR"):
        plan("furnished", 0)


def test_a_dataset_may_be_rendered_from_copies_of_the_libraries(libraries: Path, tmp_path: Path):
    """Machines that share a folder may have them in different places; others than it was begun with are refused."""
    root, copies = tmp_path / "data", tmp_path / "copies"
    shutil.copytree(libraries, copies, ignore=shutil.ignore_patterns("data", "copies"))
    for folder in (libraries, copies):
        assert begun(root, "release", 0, USUAL_CHANNELS, NO_OPTIONS, str(folder)).facts["models"]
    with pytest.raises(BadInput, match="other models"):
        begun(root, "release", 0, USUAL_CHANNELS, NO_OPTIONS)


def test_the_card_has_another_licence_for_pictures_of_furniture(libraries: Path):
    facts = plan("release", 0, models=str(libraries))
    assert licence_of(facts).startswith("CC0-1.0, but") and licence_of(plan("release", 0)) == "CC0-1.0"
