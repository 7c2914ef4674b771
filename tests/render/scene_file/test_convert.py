"""Nodes of scene files as plain data: everything is there, under its own name, and what is shared is shared."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from errors import BadInput
from render.backend import mi
from render.loading import StockLoader
from render.scene_file.convert import SceneFile
from render.scene_file.stand_ins import RESERVED_NAMES, Names
from tests.helpers.scene_files import old_xml, own, painted, write, xml


def converted(folder, content: str):
    write(folder, content)
    return SceneFile(folder / "scene.xml")


def test_names_are_unique_and_usable(tmp_path):
    ids = ("a.b c/ü", "sky", "type", "group 0", "_group 0", "id", "to_world", "sphere-2")
    cubes = "".join(f'<shape type="cube" id="{name}"/>' for name in ids)
    parts = (cubes, '<shape type="sphere"/>' * 3, '<emitter type="point" id="constant-2"/>', '<emitter type="point"/>')
    group = '<shape type="shapegroup" id="g"><shape type="disk"/></shape><shape type="instance"><ref id="g"/></shape>'
    scene = own(tmp_path, xml(*parts, group))
    names = [shape.name for shape in scene.scene.stock] + [light.name for light in scene.scene.lights]
    assert len(names) == 1 + len(ids) + 3 + 1 + 3 and len(set(names)) == len(names)
    assert "a_b c/ü" in names and "group 0" in names and not {"sky", "type", "id"} & set(names)
    assert {shape.id() for shape in scene.stage.shapes} == set(names[:-3])


def test_a_material_of_many_shapes_is_loaded_once(tmp_path, monkeypatch):
    material = '<bsdf type="diffuse" id="d"><texture type="checkerboard" name="reflectance"/></bsdf>'
    found = converted(tmp_path, xml(material, '<shape type="cube"><ref id="d"/></shape>' * 100))
    cubes = [shape for shape in found.shapes if shape.geometry["type"] == "cube"]
    assert len(cubes) == 100 and all(shape.bsdf is cubes[0].bsdf for shape in cubes)
    loader = StockLoader()
    for shape in cubes:
        loader.shape(shape)
    assert len(loader.loaded) == 2  # the checkerboard and what it is on


def test_files_lie_in_the_folder_or_where_paths_say(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "in.obj").write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n")
    mesh = '<shape type="obj"><string name="filename" value="in.obj"/></shape>'
    found = converted(tmp_path, xml('<path value="sub"/>', mesh))
    assert found.shapes[1].name == "in" and found.shapes[1].geometry["filename"] == str(tmp_path / "sub" / "in.obj")
    assert found.notes == []
    for name in ("../x.obj", "/etc/hostname", "sub/../../x.obj"):
        with pytest.raises(BadInput, match="leaves the scene's folder"):
            converted(tmp_path, xml(f'<shape type="obj"><string name="filename" value="{name}"/></shape>'))
    with pytest.raises(BadInput, match="cannot be the name"):
        converted(tmp_path, xml(f'<shape type="obj"><string name="filename" value="{"x" * 5000}"/></shape>'))


def test_depth_is_that_of_the_innermost_integrator(tmp_path):
    inner = '<integrator type="path"><integer name="max_depth" value="{}"/></integrator>'
    assert converted(tmp_path, xml(inner.format(7))).max_depth == 7
    endless = converted(tmp_path, xml(inner.format(-1)))
    assert endless.max_depth is None and "of 2 bounces" in endless.notes[0]
    lights_alone = converted(tmp_path, xml(inner.format(1)))
    assert lights_alone.max_depth == 2 and "max_depth 1" in lights_alone.notes[0]
    assert converted(tmp_path, xml('<integrator type="direct"/>')).max_depth == 2
    aov = f'<integrator type="aov"><string name="aovs" value="d:depth"/>{inner.format(5)}</integrator>'
    found = converted(tmp_path, xml(aov))
    assert found.max_depth == 5 and len(found.notes) == 1


def test_what_is_left_out_of_shapes_and_films_is_noted(tmp_path):
    ball = painted('<bsdf type="diffuse"/><bsdf type="conductor"/>')
    found = converted(tmp_path, xml(shape=ball))
    assert found.shapes[0].bsdf["type"] == "conductor" and "a further bsdf on the same shape" in found.notes[0]
    film = '<film type="hdrfilm"><integer name="crop_width" value="8"/></film></sensor>'
    assert "its film is cropped" in converted(tmp_path, xml().replace("</sensor>", film)).notes[0]


def test_boundaries_of_media_are_no_surfaces(tmp_path):
    fog = '<shape type="cube"><medium name="interior" type="homogeneous"/>{}</shape>'
    null = fog.format('<bsdf type="null"/>')
    for content in (xml(null), old_xml(null), old_xml(fog.format(""))):
        found = converted(tmp_path, content)
        assert [shape.name for shape in found.shapes] == ["ball"] and "boundary of a medium" in found.notes[-1]
    for content in (xml(fog.format("")), old_xml(fog.format('<bsdf type="dielectric"/>'))):
        assert len(converted(tmp_path, content).shapes) == 2


def test_rough_plastic_has_no_texture_of_roughness(tmp_path):
    texture = '<texture name="alpha" type="checkerboard"/>'
    scene = own(tmp_path, xml(shape=painted(f'<bsdf type="roughplastic">{texture}</bsdf>')))
    assert scene.scene.stock[0].bsdf["alpha"] == 0.1 and "0.1 instead of its texture" in scene.notes[0]


def test_a_sky_is_sampled_where_it_is_dark_too(tmp_path):
    """The last vertex of a path gets light from samples of the sky alone: none may be left out."""
    mi.Bitmap(np.linspace(0.1, 2, 24, dtype=np.float32).reshape(2, 4, 3)).write(str(tmp_path / "sky.exr"))
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/>{}</emitter>'
    compensated = sky.format('<boolean name="mis_compensation" value="true"/>')
    assert converted(tmp_path, xml(light=compensated)).lights[0].emitter["mis_compensation"] is False


def test_nothing_to_render(tmp_path):
    with pytest.raises(BadInput, match="no shape to render"):
        converted(tmp_path, xml(shape=""))
    with pytest.raises(
        BadInput, match=r"no shape to render; gone.obj \(scene.xml line 1\): the file gone.obj is missing"
    ):
        converted(tmp_path, xml(shape='<shape type="obj"><string name="filename" value="gone.obj"/></shape>'))


def test_more_lights_than_shapes(tmp_path):
    points = '<emitter type="point"><rgb name="intensity" value="1, 2, 3"/></emitter>' * 30
    found = converted(tmp_path, xml(points))
    assert len(found.lights) == 31 and len(found.shapes) == 1
    np.testing.assert_allclose(found.lights[7].emitter["intensity"]["value"], [1, 2, 3])


@given(st.lists(st.sampled_from(["a", "a-2", "a-3", "a.b", "a_b", "", "type", "sky", "sky-2"])))
def test_names_are_given_once(wanted):
    names = Names()
    given = [names.unique(name) for name in wanted]
    assert len(set(given)) == len(given) and not set(given) & set(RESERVED_NAMES)
    assert not any("." in name or not name for name in given)
