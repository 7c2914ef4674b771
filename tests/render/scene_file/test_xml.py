"""Scene files of strangers: nothing outside of their folder is read, nothing endless is parsed."""

import pytest

from errors import BadInput
from render.scene_file.xml import MAX_INCLUDE_DEPTH, MAX_INCLUDES, ParsedFile
from tests.helpers.scene_files import old_xml, refusal, xml


def included(name: str) -> str:
    return xml(f'<include filename="{name}"/>')


def test_what_is_damaged(tmp_path):
    for path in (tmp_path / "gone.xml", tmp_path):
        with pytest.raises(BadInput, match="cannot be read"):
            ParsedFile(path)
    assert "empty or damaged" in refusal(tmp_path, "")
    assert "empty or damaged" in refusal(tmp_path, xml()[:-20])
    assert "empty or damaged" in refusal(tmp_path, b"\x89PNG\r\n\x1a\n" + bytes(range(1, 256)))
    assert "banana" in refusal(tmp_path, xml("<banana/>"))
    assert "version" in refusal(tmp_path, xml().replace("3.0.0", "new"))
    assert "$r" in refusal(tmp_path, xml('<shape type="sphere"><float name="radius" value="$r"/></shape>'))
    assert 'id="gone"' in refusal(tmp_path, xml('<shape type="cube"><ref id="gone"/></shape>'))
    assert "ball" in refusal(tmp_path, xml('<shape type="cube" id="ball"/>'))
    assert "abc" in refusal(tmp_path, xml('<shape type="sphere"><float name="radius" value="abc"/></shape>'))


def test_errors_name_file_line_and_element(tmp_path):
    """Also of an element that spans lines, after one that was upgraded, and in an included file."""
    sphere = '<shape\n type="sphere">\n<float name="radius" value="abc"/></shape>'
    content = f'<scene version="0.6.0">\n<camera type="perspective"/>\n{sphere}</scene>'
    assert "scene.xml line 5, <float>: could not parse" in refusal(tmp_path, content)
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">\n\n{sphere}</scene>')
    assert "part.xml line 5, <float>: could not parse" in refusal(tmp_path, included("part.xml"))
    red = old_xml('\n<bsdf type="diffuse"><srgb name="x" value="red"/></bsdf>')
    assert "scene.xml line 2, <srgb>: could not" in refusal(tmp_path, red)


OUTSIDE = [
    '<include filename="../other.xml"/>',
    '<include filename="/etc/hostname"/>',
    '<path value=".."/>',
    '<path value="/"/>',
    '<bsdf type="diffuse"><spectrum name="reflectance" filename="../x.spd"/></bsdf>',
    '<bsdf type="diffuse"><spectrum name="reflectance" filename="/etc/passwd"/></bsdf>',
    '<include filename="link.xml"/>',
]


@pytest.mark.parametrize("part", OUTSIDE)
def test_nothing_outside_of_its_folder_is_read(tmp_path, part):
    (tmp_path / "other.xml").write_text(xml())
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "link.xml").symlink_to(tmp_path / "other.xml")
    text = refusal(folder, xml(part))
    assert "leaves the scene's folder" in text and "root:" not in text


def test_names_that_depend_on_parameters(tmp_path):
    for tag in ('<include filename="$x"/>', '<path value="$x"/>'):
        assert "depends on a parameter" in refusal(tmp_path, xml('<default name="x" value="/etc"/>', tag))


def test_bombs(tmp_path):
    for name, next_ in (("a", "b"), ("b", "a")):
        (tmp_path / f"{name}.xml").write_text(included(f"{next_}.xml"))
    assert str(MAX_INCLUDE_DEPTH) in refusal(tmp_path, included("a.xml"))
    (tmp_path / "wide.xml").write_text(xml(*['<include filename="leaf.xml"/>'] * 40))
    (tmp_path / "leaf.xml").write_text(xml())
    assert str(MAX_INCLUDES) in refusal(tmp_path, xml(*['<include filename="wide.xml"/>'] * 40))
    laughs = "<!DOCTYPE s [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;'>]>" + xml("&b;")
    assert "entities" in refusal(tmp_path, laughs)
    assert "UTF-8" in refusal(tmp_path, laughs.encode("utf-16"))
    deep = '<bsdf type="mask">' * 100_000 + "</bsdf>" * 100_000
    assert "within each other" in refusal(tmp_path, xml(deep))
    assert "cannot be the name of a file" in refusal(tmp_path, included("x" * 5000))


def test_includes_defaults_aliases_and_comments(tmp_path):
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "part.xml").write_text('<scene version="3.0.0"><shape type="disk" id="included"/></scene>')
    parts = (
        '<include filename="sub/part.xml"/>',
        "<!-- a comment -->",
        '<default name="r" value="0.25"/><shape type="sphere"><float name="radius" value="$r"/></shape>',
        '<bsdf type="plastic" id="a"/><alias id="a" as="b"/><shape type="cube"><ref id="b"/></shape>',
    )
    path = tmp_path / "scene.xml"
    path.write_text(xml(*parts))
    parsed = ParsedFile(path)
    nodes = [node.props for node in parsed.state.nodes]
    assert {"disk", "sphere", "cube", "plastic"} <= {node.plugin_name() for node in nodes}
    assert 0.25 in [node.get("radius", None) for node in nodes]
    assert parsed.searched == [tmp_path.resolve()] and parsed.notes == []


def test_elements_of_old_files(tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(
        old_xml(
            '<shape type="disk"><subsurface type="dipole"/></shape>',
            '<shape type="cube"><subsurface type="dipole"><float name="scale" value="3"/></subsurface></shape>',
            '<shape type="cube"><animation name="toWorld"><transform time="0"><translate x="7"/></transform>'
            '<transform time="1"><translate x="8"/></transform></animation></shape>',
        )
    )
    parsed = ParsedFile(path)
    moved = [node.props["to_world"] for node in parsed.state.nodes if "to_world" in node.props]
    assert any(transform.matrix[0, 3] == 7 for transform in moved)
    assert len(parsed.notes) == 2 and "2 times subsurface" in parsed.notes[0] and "animation" in parsed.notes[1]
