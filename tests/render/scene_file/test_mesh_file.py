"""glTF, OBJ and PLY of other programs: their materials, cameras and lights, and what is refused or left out."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from errors import BadInput
from render.backend import dr, mi
from render.loading import to_mitsuba
from render.scene_file.assets import linear_image, stored_texture, texture, unit_values
from render.scene_file.mesh_file import MeshFile

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
OBJ = f"mtllib m.mtl\n{TRIANGLE}usemtl red\nf 1/1 2/2 3/3\n"


def picture(seed: int = 0) -> Image.Image:
    return Image.fromarray(np.uint8(np.random.default_rng(seed).integers(0, 255, (8, 8, 3))))


def with_material(mesh: trimesh.Trimesh, **material) -> trimesh.Trimesh:
    uv = np.random.default_rng(1).random((len(mesh.vertices), 2))
    mesh.visual = TextureVisuals(uv=uv, material=PBRMaterial(**material))
    return mesh


def world(**material) -> trimesh.Scene:
    """A box of a material, at rest at (1, 2, 3)."""
    scene = trimesh.Scene()
    place = trimesh.transformations.translation_matrix([1, 2, 3])
    scene.add_geometry(with_material(trimesh.creation.box(), **material), node_name="box", transform=place)
    return scene


def loaded(folder, scene: trimesh.Scene):
    path = folder / "scene.glb"
    path.write_bytes(scene.export(file_type="glb"))
    return MeshFile(path, 1.5)


def gltf(folder, change, **material):
    """The path of a .gltf whose JSON `change` has changed."""
    for name, content in world(**material).export(file_type="gltf").items():
        (folder / name).write_bytes(content)
    path = folder / "model.gltf"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    return path


def test_materials_of_gltf(tmp_path):
    textures = {"baseColorTexture": picture(), "metallicRoughnessTexture": picture(1)}
    found = loaded(tmp_path, world(**textures, metallicFactor=0.5, roughnessFactor=0.25))
    (box,) = found.shapes
    assert box.name == "box" and not box.smooth and box.radiance is None  # without normals
    np.testing.assert_allclose(box.mesh.bounds, [[0.5, 1.5, 2.5], [1.5, 2.5, 3.5]])
    assert box.mesh.visual.uv.shape == (len(box.mesh.vertices), 2)
    bsdf = box.bsdf["bsdf"]
    assert bsdf["type"] == "principled"
    np.testing.assert_array_equal(bsdf["base_color"]["bitmap"], np.asarray(picture())[::-1])
    channels = np.asarray(picture(1), float)[::-1] / 255
    np.testing.assert_allclose(bsdf["roughness"]["data"], channels[..., 1:2] * 0.25, rtol=1e-5)
    np.testing.assert_allclose(bsdf["metallic"]["data"], channels[..., 2:3] * 0.5, rtol=1e-5)
    assert found.sky is not None and found.notes == ["there is no light: a clear sky with the sun, y up"]


def test_authored_normals_of_gltf_are_smooth(tmp_path):
    path = tmp_path / "scene.glb"
    path.write_bytes(world().export(file_type="glb", include_normals=True))
    assert MeshFile(path, 1.5).shapes[0].smooth


def test_factors_relief_and_light_of_gltf(tmp_path):
    factors = {"baseColorFactor": [1.0, 0.5, 0.25, 0.5], "emissiveFactor": [1.0, 0.5, 0.2], "metallicFactor": 0.0}
    textures = {"normalTexture": picture(), "emissiveTexture": Image.new("RGB", (4, 4), (188, 188, 188))}
    found = loaded(tmp_path, world(**factors, **textures, alphaMode="BLEND"))
    (box,) = found.shapes
    assert found.sky is None
    np.testing.assert_allclose(box.radiance.at(3), np.multiply(0.5029, [1, 0.5, 0.2]), atol=1e-4)
    assert box.bsdf["bsdf"]["type"] == "normalmap"
    assert box.bsdf["bsdf"]["bsdf"]["base_color"]["value"] == pytest.approx([1, 0.5, 0.25], abs=0.01)
    assert len(found.notes) == 2 and "transparency" in found.notes[0] and "emissive texture" in found.notes[1]


def test_srgb_pictures_become_linear():
    """As IEC 61966-2-1 has it: byte 188 is half of white, 10 lies on the straight part."""
    values = linear_image(Image.fromarray(np.uint8([[[0, 10, 188]], [[255, 255, 255]]])))
    np.testing.assert_allclose(values, [[[0, 10 / 255 / 12.92, 0.5029]], [[1, 1, 1]]], atol=1e-4)
    assert texture(values)["data"][0, 0, 0] == 1  # the last row is v = 0


@pytest.mark.parametrize(("raw", "values"), [(False, linear_image), (True, unit_values)])
def test_pictures_that_are_stored_as_they_are_show_the_same(raw, values):
    si = dr.zeros(mi.SurfaceInteraction3f, 64)
    si.uv = mi.Point2f(*np.random.default_rng(0).random((2, 64)).astype(np.float32))
    both = [stored_texture(picture(), raw), texture(values(picture()))]
    colours = [np.array(mi.load_dict(to_mitsuba(each)).eval(si)) for each in both]
    np.testing.assert_allclose(*colours, atol=1e-5)


@pytest.mark.parametrize("aspect", [0.5, 1.5])
def test_cameras_of_gltf_keep_their_vertical_field_of_view(tmp_path, aspect):
    def add(content):
        content["cameras"] = [{"type": "orthographic"}, {"type": "perspective", "perspective": {"yfov": 0.8}}]
        turned = {"rotation": [0, 2**-0.5, 0, 2**-0.5], "translation": [5, 0, 0], "children": []}  # by 90 degrees
        content["nodes"] += [{"camera": 0}, turned, {"camera": 1, "translation": [0, 0, 4], "name": "eye"}]
        last = len(content["nodes"]) - 1
        content["nodes"][0].setdefault("children", []).append(last - 1)
        content["nodes"][last - 1]["children"].append(last)
        content["nodes"][0]["matrix"] = np.eye(4).ravel().tolist()

    found = MeshFile(gltf(tmp_path, add), aspect)
    camera = found.camera
    assert "orthographic cameras are left out" in found.notes
    np.testing.assert_allclose(camera.eye.at(0), [9, 0, 0], atol=1e-12)
    np.testing.assert_allclose(camera.target.at(0), [8, 0, 0], atol=1e-12)
    assert np.tan(np.radians(camera.x_fov.at(0)) / 2) / aspect == pytest.approx(np.tan(0.4))


@pytest.mark.parametrize("perspective", [{}, {"yfov": float("nan")}])
def test_a_damaged_camera_of_gltf_is_left_out(tmp_path, perspective):
    def add(content):
        content["cameras"] = [{"type": "perspective", "perspective": perspective}]
        content["nodes"].append({"camera": 0})

    found = MeshFile(gltf(tmp_path, add), 1.0)
    assert found.camera is None and "its cameras are damaged: left out" in found.notes


def test_what_gltf_says_beyond_meshes(tmp_path):
    def add(content):
        content["animations"] = [{"channels": [], "samplers": []}]
        content["extensionsUsed"] = ["KHR_lights_punctual"]

    notes = MeshFile(gltf(tmp_path, add), 1.0).notes
    assert any("animations" in note for note in notes) and any("KHR_lights_punctual" in note for note in notes)


def test_names_are_unique(tmp_path):
    scene = trimesh.Scene()
    for name in ("sky", "a.b", "a_b", "größe 1"):
        scene.add_geometry(trimesh.creation.box(), node_name=name)
    assert {shape.name for shape in loaded(tmp_path, scene).shapes} == {"sky-2", "a_b", "a_b-2", "größe 1"}


def test_materials_of_obj(tmp_path):
    picture().save(tmp_path / "tex.png")
    (tmp_path / "scene.obj").write_text(OBJ)
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 0.0015 0.2 0.4\nKs 0.5 0.5 0.5\nKe 3 2 1\nd 0.5\n")
    found = MeshFile(tmp_path / "scene.obj", 1.0)
    assert found.shapes[0].bsdf["bsdf"]["reflectance"]["value"] == [0.0015, 0.2, 0.4]
    np.testing.assert_array_equal(found.shapes[0].radiance.at(0), [3, 2, 1])
    assert ["gloss" in note for note in found.notes] == [True, False] and "transparency" in found.notes[1]
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 0.8 0.2 0.4\nKs 0 0 0\nd 1\nmap_Kd tex.png\n")
    found = MeshFile(tmp_path / "scene.obj", 1.0)
    stored = found.shapes[0].bsdf["bsdf"]["reflectance"]["bitmap"]
    np.testing.assert_array_equal(stored, np.asarray(picture())[::-1])
    assert len(found.notes) == 1  # of the sky


@pytest.mark.parametrize("name", ["t\\tex.png", "-s 2 2 1 -clamp on t/tex.png"])
def test_textures_of_obj_behind_options_and_backslashes(tmp_path, name):
    (tmp_path / "t").mkdir()
    picture().save(tmp_path / "t" / "tex.png")
    (tmp_path / "scene.obj").write_text(OBJ)
    (tmp_path / "m.mtl").write_text(f"newmtl red\nmap_Kd {name}\n")
    found = MeshFile(tmp_path / "scene.obj", 1.0)
    assert found.shapes[0].bsdf["bsdf"]["reflectance"]["type"] == "bitmap"
    assert any("options" in note for note in found.notes) == name.startswith("-")


def test_a_damaged_texture_of_obj_is_left_out(tmp_path):
    picture().resize((64, 64)).save(tmp_path / "tex.png")
    (tmp_path / "tex.png").write_bytes((tmp_path / "tex.png").read_bytes()[:500])
    (tmp_path / "scene.obj").write_text(OBJ)
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 0.8 0.2 0.4\nmap_Kd tex.png\n")
    found = MeshFile(tmp_path / "scene.obj", 1.0)
    assert found.shapes[0].bsdf["bsdf"]["reflectance"]["value"] == [0.8, 0.2, 0.4]
    assert "its texture is damaged" in found.notes[0]


def test_colours_of_ply(tmp_path):
    box = trimesh.creation.box()
    box.visual.vertex_colors = [200, 50, 50, 255]
    box.export(tmp_path / "scene.ply")
    found = MeshFile(tmp_path / "scene.ply", 1.0)
    assert found.shapes[0].bsdf["bsdf"]["reflectance"]["value"] == pytest.approx([200 / 255, 50 / 255, 50 / 255])
    assert "colours of its vertices" in found.notes[0]


def test_missing_files_are_said(tmp_path):
    (tmp_path / "scene.obj").write_text(OBJ)
    assert "m.mtl is missing" in MeshFile(tmp_path / "scene.obj", 1.0).notes[0]
    (tmp_path / "m.mtl").write_text("newmtl red\nmap_Kd gone.png\n")
    assert "gone.png is missing" in MeshFile(tmp_path / "scene.obj", 1.0).notes[0]

    def lose(content):
        content["images"] = [{"uri": "gone.png"}]

    assert "gone.png is missing" in MeshFile(gltf(tmp_path, lose, baseColorTexture=picture()), 1.0).notes[0]
    with pytest.raises(BadInput, match=r"gone\.bin is missing"):
        MeshFile(gltf(tmp_path, lambda content: content["buffers"][0].update(uri="gone.bin")), 1.0)


def test_nothing_outside_of_its_folder_is_read(tmp_path, capfd):
    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "m.mtl").write_text("newmtl red\nKd 1 0 0\n")
    picture().save(tmp_path / "tex.png")
    for library in ("../m.mtl", str(tmp_path / "m.mtl")):
        (folder / "scene.obj").write_text(OBJ.replace("m.mtl", library))
        with pytest.raises(BadInput, match="leaves the scene's folder"):
            MeshFile(folder / "scene.obj", 1.0)
    (folder / "scene.obj").write_text(OBJ)
    (folder / "m.mtl").write_text("newmtl red\nmap_Kd ../tex.png\n")
    with pytest.raises(BadInput, match="leaves the scene's folder"):
        MeshFile(folder / "scene.obj", 1.0)
    for uri in ("../model.bin", "/etc/hostname", "..%2Fmodel.bin", "file:///etc/hostname"):
        path = gltf(folder, lambda content, uri=uri: content["buffers"][0].update(uri=uri))
        with pytest.raises(BadInput):
            MeshFile(path, 1.0)
    with pytest.raises(BadInput, match="leaves the scene's folder"):
        path = gltf(folder, lambda content: content.update(images=[{"uri": "../tex.png"}]), baseColorTexture=picture())
        MeshFile(path, 1.0)
    ply = "ply\nformat ascii 1.0\ncomment TextureFile ../tex.png\nelement vertex 3\n"
    ply += "".join(f"property float {name}\n" for name in "xyzst") + "element face 1\n"
    ply += "property list uchar int vertex_indices\nend_header\n0 0 0 0 0\n1 0 0 1 0\n1 1 0 1 1\n3 0 1 2\n"
    (folder / "scene.ply").write_text(ply)
    with pytest.raises(BadInput, match="leaves the scene's folder"):
        MeshFile(folder / "scene.ply", 1.0)
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.parametrize("suffix", ["glb", "gltf", "obj", "ply"])
def test_damaged_files(tmp_path, suffix):
    path = tmp_path / f"scene.{suffix}"
    mesh = world() if suffix == "glb" else trimesh.creation.box()
    whole = mesh.export(file_type=suffix if suffix != "gltf" else "ply")
    whole = whole if isinstance(whole, bytes) else whole.encode()
    for content in (b"", b"\xff" * 99, bytes(range(256)) * 4, whole[:40], whole[: len(whole) * 2 // 3]):
        if suffix == "obj" and content.startswith(b"#"):
            continue  # lines that are whole are a smaller mesh
        path.write_bytes(content)
        with pytest.raises(BadInput, match=rf"scene\.{suffix}"):
            MeshFile(path, 1.0)
    path.unlink()
    with pytest.raises(BadInput, match="missing"):
        MeshFile(path, 1.0)


@pytest.mark.parametrize("vertex", ["nan 1 0", "inf 1 0", "1e30 1 0"])
def test_vertices_that_are_nowhere(tmp_path, vertex):
    (tmp_path / "scene.obj").write_text(TRIANGLE.replace("1 1 0", vertex) + "f 1/1 2/2 3/3\n")
    with pytest.raises(BadInput, match=r"scene\.obj: mesh 'scene_obj' is empty or damaged"):
        MeshFile(tmp_path / "scene.obj", 1.0)


def test_faces_without_vertices(tmp_path):
    path = tmp_path / "scene.ply"
    box = trimesh.creation.box()
    box.faces[0] = [0, 1, 9]
    path.write_bytes(box.export(file_type="ply"))
    with pytest.raises(BadInput, match=r"scene\.ply: mesh 'scene_ply' is damaged: it lacks vertices"):
        MeshFile(path, 1.0)


def test_what_of_a_mesh_would_make_pixels_nan_is_replaced(tmp_path):
    """Normals without a direction, those that cancel out included, and texture coordinates."""
    normals = "vn nan 0 0\nvn 0 0 0\nvn 0 0.6 0.8\n"
    (tmp_path / "scene.obj").write_text(TRIANGLE.replace("vt 0 0", "vt nan 0") + normals + "f 1/1/1 2/2/2 3/3/3\n")
    found = MeshFile(tmp_path / "scene.obj", 1.0)
    assert any("normals" in note for note in found.notes) and any("coordinates" in note for note in found.notes)
    mesh = found.shapes[0].mesh
    np.testing.assert_allclose(mesh.vertex_normals, [[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]], atol=1e-9)
    np.testing.assert_array_equal(mesh.visual.uv[0], 0)
    (tmp_path / "scene.obj").write_text(TRIANGLE + "f 1 2 3\nf 3 2 1\n")
    both_sides = MeshFile(tmp_path / "scene.obj", 1.0).shapes[0].mesh.vertex_normals
    np.testing.assert_allclose(np.abs(both_sides), [[0, 0, 1]] * 3, atol=1e-9)


def test_points_are_no_mesh(tmp_path):
    trimesh.PointCloud(np.eye(3)).export(tmp_path / "scene.ply")
    with pytest.raises(BadInput, match=r"no mesh to render; .*PointCloud"):
        MeshFile(tmp_path / "scene.ply", 1.0)
