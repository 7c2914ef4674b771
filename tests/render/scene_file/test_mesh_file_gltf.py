"""glTF as the specification has it, in files that a test writes: names, accessors, textures, lamps, extensions."""

import base64
import io
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh
from PIL import Image

from errors import BadInput
from render.path import PosedFrame
from render.scene_file.assets import unit_values
from render.scene_file.gltf_materials import surface_mean
from render.scene_file.mesh_file import MeshFile
from render.stage import Stage
from scenes.animation import Camera, Scene

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
COMPONENTS = {"float32": 5126, "uint16": 5123, "uint8": 5121, "int8": 5120, "int16": 5122}
TEXTURED = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]


def data_uri(content: bytes) -> str:
    return f"data:application/octet-stream;base64,{base64.b64encode(content).decode()}"


def image(values) -> dict:
    file = io.BytesIO()
    Image.fromarray(np.asarray(values)).save(file, "png")
    return {"uri": data_uri(file.getvalue())}


def dots(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (4, 4, 3)).astype(np.uint8)


def content(*primitives, nodes=({"mesh": 0, "name": "n"},), images=(), **more) -> dict:
    """The JSON of a file whose only mesh has these primitives: arrays by attribute, whole numbers normalised."""
    gltf = {"asset": {"version": "2.0"}, "nodes": list(nodes), "accessors": [], "bufferViews": [], "buffers": []}

    def add(values) -> int:
        gltf["buffers"].append({"byteLength": values.nbytes, "uri": data_uri(values.tobytes())})
        number = len(gltf["buffers"]) - 1
        gltf["bufferViews"].append({"buffer": number, "byteLength": values.nbytes})
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessor = {"bufferView": number, "componentType": COMPONENTS[values.dtype.name], "type": kind}
        whole = values.dtype.kind != "f" and values.ndim > 1
        gltf["accessors"].append(accessor | {"count": len(values), "normalized": whole})
        return number

    described = []
    for primitive in primitives:
        attributes = {key: add(value) for key, value in primitive.items() if key.isupper()}
        rest = {key: value for key, value in primitive.items() if not key.isupper()}
        rest |= {"indices": add(rest["indices"])} if "indices" in rest else {}
        described.append({"attributes": attributes, **rest})
    children = {child for node in nodes for child in node.get("children", [])}
    gltf["scenes"] = [{"nodes": [index for index in range(len(nodes)) if index not in children]}]
    gltf |= {"meshes": [{"primitives": described}], "images": list(images)}
    return gltf | {"textures": [{"source": index} for index in range(len(images))], **more}


def square(material: int | None = 0, **more) -> dict:
    return {"POSITION": SQUARE, "indices": FACES} | ({} if material is None else {"material": material}) | more


def written(folder, gltf: dict):
    path = folder / "scene.gltf"
    path.write_text(json.dumps(gltf))
    return path


def read(folder, *primitives, **more) -> MeshFile:
    return MeshFile(written(folder, content(*primitives, **more)), 1.0)


def base_colour(found: MeshFile, index: int = 0):
    return found.shapes[index].bsdf["bsdf"]["base_color"]


def test_names_of_several_primitives_are_the_same_in_every_process(tmp_path):
    nodes = [{"mesh": 0, "name": "car"}, {"mesh": 0}]
    materials = [{"name": "paint"}, {"alphaMode": "BLEND"}]
    path = written(tmp_path, content(square(), square(1), square(1), nodes=nodes, materials=materials))
    program = "import sys\nfrom pathlib import Path\nfrom render.scene_file.mesh_file import MeshFile\n"
    program += "found = MeshFile(Path(sys.argv[1]), 1.0)\nprint([shape.name for shape in found.shapes], found.notes)"
    results = set()
    for seed in "12":
        environment = os.environ | {"PYTHONHASHSEED": seed}
        run = subprocess.run([sys.executable, "-c", program, path], capture_output=True, text=True, env=environment)
        results.add(run.stdout)
    assert len(results) == 1
    wanted = ["car_paint", "car_material 1", "car_material 1-2", "mesh_paint", "mesh_material 1", "mesh_material 1-2"]
    assert results.pop().startswith(str(wanted))


def test_a_mesh_without_area_has_the_mean_of_its_texture():
    point = trimesh.Trimesh(np.zeros((3, 3)), [[0, 1, 2]], process=False)
    image = np.array([[[0.0, 1.0, 0.5], [1.0, 1.0, 0.0]]])
    np.testing.assert_allclose(surface_mean(point, np.zeros((3, 2)), image), [0.5, 1, 0.25])


def test_emissive_textures_emit_their_mean_over_the_mesh(tmp_path):
    halves = np.zeros((4, 4, 3), np.uint8)
    halves[:, 2:] = 188  # about a half in linear light
    lamp = {"emissiveFactor": [1, 0.5, 0], "emissiveTexture": {"index": 0}}
    lamp |= {"extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4}}}
    images = [image(halves)]
    found = read(tmp_path, square(TEXCOORD_0=UV), materials=[lamp], images=images)
    np.testing.assert_allclose(found.shapes[0].radiance.at(0), [1, 0.5, 0], rtol=0.03)
    assert found.notes == ["n: an emissive texture: its mean everywhere instead"]
    bright, dark = ((0.5, 0.25), (0, 0.25))  # the mesh shows one half of the image alone
    found = read(tmp_path, square(TEXCOORD_0=UV * 0.5 + np.float32(bright)), materials=[lamp], images=images)
    np.testing.assert_allclose(found.shapes[0].radiance.at(0), [2.01, 1.006, 0], rtol=0.01)
    found = read(tmp_path, square(TEXCOORD_0=UV * 0.5 + np.float32(dark)), materials=[lamp], images=images)
    assert found.shapes[0].radiance is None and found.sky is not None and "dark" in found.notes[0]


@pytest.mark.parametrize("name", ["KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_texture_basisu"])
def test_required_extensions_that_are_not_supported_are_refused(tmp_path, name):
    more = {"extensionsUsed": [name]}
    assert f"the extension {name} may not be honoured" in read(tmp_path, square(None), **more).notes
    with pytest.raises(BadInput, match=rf"scene\.gltf requires the extension {name}, .*: export it without"):
        read(tmp_path, square(None), extensionsRequired=[name], **more)


def test_meshes_without_data_are_refused(tmp_path):
    gltf = content(square(None))
    del gltf["accessors"][0]["bufferView"]
    with pytest.raises(BadInput, match="without compression"):
        MeshFile(written(tmp_path, gltf), 1.0)


def test_quantised_meshes_are_read(tmp_path):
    names = ["KHR_mesh_quantization"]
    quantised = square(None, POSITION=np.int8(SQUARE * 127), NORMAL=np.tile(np.int8([0, 0, 127]), (4, 1)))
    found = read(tmp_path, quantised, extensionsUsed=names, extensionsRequired=names)
    np.testing.assert_array_equal(found.shapes[0].mesh.vertices, SQUARE)
    np.testing.assert_array_equal(found.shapes[0].mesh.vertex_normals[0], [0, 0, 1])
    assert not any("extension" in note for note in found.notes)


def test_colours_of_vertices_multiply_the_material(tmp_path):
    materials = [{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.0015, 1]}}]
    colours = np.uint8([[255, 0, 255], [255, 0, 255], [255, 0, 255], [9, 9, 9]])
    found = read(tmp_path, square(COLOR_0=colours), materials=materials)
    assert base_colour(found)["value"] == [0.5, 0, 0.0015] and "colours of its vertices" in found.notes[0]
    found = read(tmp_path, square(COLOR_0=colours[:1].repeat(4, axis=0)), materials=materials)
    assert base_colour(found)["value"] == [0.5, 0, 0.0015] and len(found.notes) == 1  # of the sky


def test_texture_coordinates_may_be_whole_numbers(tmp_path):
    found = read(tmp_path, square(TEXCOORD_0=np.uint16(UV * 65535)), materials=TEXTURED, images=[image(dots())])
    np.testing.assert_array_equal(found.shapes[0].mesh.visual.uv, UV * [1, -1] + [0, 1])


def test_the_set_of_texture_coordinates_is_the_material_s(tmp_path):
    materials = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}}}]
    more = {"materials": materials, "images": [image(dots())]}
    found = read(tmp_path, square(TEXCOORD_0=UV * 0, TEXCOORD_1=UV), **more)
    np.testing.assert_array_equal(found.shapes[0].mesh.visual.uv, UV * [1, -1] + [0, 1])
    materials[0]["normalTexture"] = {"index": 0}
    assert "several sets" in read(tmp_path, square(TEXCOORD_0=UV, TEXCOORD_1=UV), **more).notes[0]


def test_sparse_accessors(tmp_path):
    gltf = content(square(None))
    gltf["buffers"] += [{"uri": data_uri(values.tobytes())} for values in (np.uint16([2]), np.float32([9, 9, 9]))]
    gltf["bufferViews"] += [{"buffer": 2, "byteLength": 2}, {"buffer": 3, "byteLength": 12}]
    indices = {"bufferView": 2, "componentType": 5123}
    gltf["accessors"][0]["sparse"] = {"count": 1, "indices": indices, "values": {"bufferView": 3}}
    vertices = MeshFile(written(tmp_path, gltf), 1.0).shapes[0].mesh.vertices
    np.testing.assert_array_equal(vertices, [*SQUARE[:2], [9, 9, 9], SQUARE[3]])


def test_strips_and_fans(tmp_path):
    strip = {"POSITION": SQUARE[[0, 1, 3, 2]], "mode": 5}
    fan = {"POSITION": SQUARE, "mode": 6}
    found = read(tmp_path, strip, fan, {"POSITION": SQUARE, "mode": 0})
    for shape in found.shapes:
        np.testing.assert_array_equal(shape.mesh.face_normals, [[0, 0, 1]] * 2)
        assert shape.mesh.area == pytest.approx(1)
    assert len(found.shapes) == 2 and "n-3: points or lines, no mesh: left out" in found.notes


def test_samplers_and_the_strength_of_relief(tmp_path):
    relief = {"normalTexture": {"index": 0, "scale": 0.5}}
    more = {"images": [image(dots())], "samplers": [{"wrapS": 33071, "wrapT": 33648, "magFilter": 9728}]}
    more |= {"textures": [{"source": 0, "sampler": 0}], "materials": [relief]}
    found = read(tmp_path, square(TEXCOORD_0=UV), **more)
    normals = found.shapes[0].bsdf["bsdf"]["normalmap"]
    assert normals["wrap_mode"] == "clamp" and normals["filter_type"] == "nearest" and "two ways" in found.notes[0]
    values = dots()[::-1] / 255
    np.testing.assert_allclose(normals["data"][..., :2] - 0.5, (values[..., :2] - 0.5) / 2, atol=1e-6)
    np.testing.assert_allclose(normals["data"][..., 2], values[..., 2], atol=1e-6)


@pytest.mark.parametrize(
    ("transform", "place"),
    [({"offset": [0.5, 0.25], "scale": [2, 3]}, [0.7, 0.85]), ({"rotation": np.pi / 2}, [0.2, -0.1])],
)
def test_transformed_textures(tmp_path, transform, place):
    """Rotations are counter-clockwise, v being down, as in three.js and Blender."""
    info = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    more = {"materials": [{"pbrMetallicRoughness": {"baseColorTexture": info}}], "images": [image(dots())]}
    more |= {"extensionsRequired": ["KHR_texture_transform"]}
    matrix = base_colour(read(tmp_path, square(TEXCOORD_0=UV), **more))["to_uv"]
    u, v, _ = matrix @ [0.1, 1 - 0.2, 1]
    np.testing.assert_allclose([u, 1 - v], place, atol=1e-12)


def test_percent_encoded_names(tmp_path):
    Image.fromarray(dots()).save(tmp_path / "my tex.png")
    gltf = content(square(TEXCOORD_0=UV), materials=TEXTURED, images=[{"uri": "my%20tex.png"}])
    (tmp_path / "my buf.bin").write_bytes(SQUARE.tobytes())
    gltf["buffers"][0]["uri"] = "my%20buf.bin"
    found = MeshFile(written(tmp_path, gltf), 1.0)
    np.testing.assert_array_equal(base_colour(found)["bitmap"], dots()[::-1])
    gltf["images"][0]["uri"] = "..%2Fmy%20tex.png"
    with pytest.raises(BadInput, match="leaves the scene's folder"):
        MeshFile(written(tmp_path, gltf), 1.0)


def test_meshes_below_cameras_and_below_skipped_meshes(tmp_path):
    nodes = [
        {"camera": 0, "translation": [0, 0, 5], "children": [1]},
        {"mesh": 0, "name": "lamp", "translation": [1, 0, 0], "scale": [2, 2, 2]},
        {"mesh": 1, "translation": [0, 3, 0], "children": [3]},
        {"mesh": 0, "name": "ball"},
    ]
    gltf = content(square(None), nodes=nodes)
    gltf["cameras"] = [{"type": "perspective", "perspective": {"yfov": 0.6, "aspectRatio": 1.5, "znear": 0.1}}]
    gltf["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}, "mode": 1}]})
    found = MeshFile(written(tmp_path, gltf), 1.0)
    lamp, ball = found.shapes
    assert (lamp.name, ball.name) == ("lamp", "ball") and found.camera is not None
    np.testing.assert_array_equal(lamp.mesh.vertices, SQUARE * 2 + [1, 0, 5])
    np.testing.assert_array_equal(ball.mesh.vertices, SQUARE + np.float32([0, 3, 0]))


def test_double_sided_lamps_shine_to_both_sides(tmp_path):
    """A square lamp before a wall, which lights the wall only with its back."""
    places = [{"translation": [-0.5, -0.5, 0]}, {"scale": [9, 9, 1], "translation": [-4.5, -4.5, -1]}]
    brightness = []
    for double in (False, True):
        gltf = content(square(), nodes=[places[0] | {"mesh": 0}, places[1] | {"mesh": 1}])
        gltf["materials"] = [{"emissiveFactor": [1, 1, 1], "doubleSided": double}, {}]
        gltf["meshes"].append({"primitives": [gltf["meshes"][0]["primitives"][0] | {"material": 1}]})
        shapes = tuple(MeshFile(written(tmp_path, gltf), 1.0).shapes)
        assert len(shapes) == 2
        for z in (3, -0.9):
            stage = Stage(Scene(shapes, Camera.at_rest([0, 0, z], [0, 0, 0], 30)), 16, 16)
            frame = PosedFrame(stage, 0)
            brightness.append((frame.emission.mean(), frame.reflected(0, 64).mean()))
    (front, wall), (back, _), (both_front, both_wall), (both_back, _) = brightness
    assert front > 0.3 and back == 0 and wall == 0
    assert both_front == front and both_back == 1 and both_wall > 0.01


def test_nodes_of_a_material_share_its_description(tmp_path):
    nodes = [{"mesh": 0, "name": "a"}, {"mesh": 0, "name": "b"}]
    transparent = [TEXTURED[0] | {"alphaMode": "BLEND", "name": "leaf"}]
    found = read(tmp_path, square(TEXCOORD_0=UV), nodes=nodes, materials=transparent, images=[image(dots())])
    a, b = found.shapes
    assert a.bsdf is b.bsdf and found.notes[0] == "leaf: transparency is left out: opaque instead"
    assert len(found.notes) == 2  # and of the sky


def test_grey_images_of_16_bits(tmp_path):
    found = read(tmp_path, square(TEXCOORD_0=UV), materials=TEXTURED, images=[image(np.full((2, 2), 20000, np.uint16))])
    encoded = 20000 / 65535
    np.testing.assert_allclose(base_colour(found)["data"], ((encoded + 0.055) / 1.055) ** 2.4, rtol=1e-5)
    np.testing.assert_array_equal(unit_values(Image.new("L", (1, 1), 51)), [[[0.2] * 3]])


def test_damaged_images_are_left_out(tmp_path):
    images = [{"uri": data_uri(base64.b64decode(image(dots())["uri"].partition(",")[2])[:60])}]
    found = read(tmp_path, square(TEXCOORD_0=UV), materials=TEXTURED, images=images)
    assert base_colour(found)["value"] == [1, 1, 1] and "image 0 is damaged" in found.notes[0]
