"""A user's own scene as a whole: refusals in one line, what its TOML changes, and glTF in motion."""

import numpy as np
import pytest
import trimesh

from errors import BadInput
from render.gbuffer import render_gbuffer
from render.path import PosedFrame
from render.scene_file.load import OwnScene
from render.stage import Stage
from scenes.camera import look_at, pixel_centres
from tests.helpers.rendering import posed_surfaces
from tests.helpers.scene_files import own, painted, refusal, xml

PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
PLY += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
SOUND = PLY + "0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n"
DAMAGED = {
    "empty.ply": b"",
    "short.ply": SOUND[:-14].encode(),
    "nan.ply": SOUND.replace("1 1 0", "nan 1 0").encode(),
    "far.ply": SOUND.replace("1 1 0", "1e30 1 0").encode(),
    "wild.ply": SOUND.replace("3 0 1 2", "3 0 1 9").encode(),
    "faceless.ply": SOUND.replace("face 1", "face 0").replace("3 0 1 2\n", "").encode(),
    "nan.obj": b"v nan 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 3\n",
    "wild.obj": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nf 1 2 9\n",
    "empty.serialized": b"",
    "junk.serialized": bytes(range(256)),
}


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_meshes_are_refused(tmp_path, name, grouped):
    (tmp_path / name).write_bytes(DAMAGED[name])
    mesh = f'<shape type="{name.partition(".")[2]}" id="thing"><string name="filename" value="{name}"/></shape>'
    if grouped:
        mesh = f'<shape type="shapegroup" id="g">{mesh}</shape><shape type="instance"><ref id="g"/></shape>'
    text = refusal(tmp_path, xml(mesh))
    assert "scene.xml" in text and name in text


@pytest.mark.parametrize("normals", ["0 0 0", "0 0 1e-30"])
def test_normals_without_a_direction_are_computed(tmp_path, normals):
    lines = SOUND.replace("property float z\n", "property float z\n" + "".join(f"property float n{c}\n" for c in "xyz"))
    for vertex in ("0 0 0", "1 0 0", "1 1 0"):
        lines = lines.replace(f"\n{vertex}\n", f"\n{vertex} {normals}\n")
    (tmp_path / "a.ply").write_text(lines)
    mesh = '<shape type="ply" id="a"><string name="filename" value="a.ply"/></shape>'
    for scene in (own(tmp_path, xml(shape=mesh)), own(tmp_path, lines, name="b.ply")):
        assert any("a" in note and "normals that are zero" in note for note in scene.notes)
        assert not any(str(tmp_path) in note for note in scene.notes)
        (name,) = (shape.name for shape in scene.scene.meshes)
        stored = np.array(scene.stage.parameters[f"{name}.vertex_normals"]).reshape(-1, 3)
        np.testing.assert_allclose(stored, [[0, 0, 1]] * 3, atol=1e-6)


def test_damaged_pictures_are_refused(tmp_path):
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\nno picture")
    texture = '<texture type="bitmap" name="reflectance"><string name="filename" value="bad.png"/></texture>'
    assert "bad.png" in refusal(tmp_path, xml(shape=painted(f'<bsdf type="diffuse">{texture}</bsdf>')))
    sky = '<emitter type="envmap"><string name="filename" value="bad.png"/></emitter>'
    assert "light 'bad'" in refusal(tmp_path, xml(light=sky))


NOWHERE = '<point name="center" x="{}" y="0" z="0"/>'
UNUSABLE = {
    "radius": painted('<string name="radius" value="wide"/>'),
    "range [0, 1]": painted('<bsdf type="diffuse"><rgb name="reflectance" value="7, 0, 0"/></bsdf>'),
    "transmission": painted('<bsdf type="twosided"><bsdf type="dielectric"/></bsdf>'),
    "too far away": painted(NOWHERE.format("nan")),
    "too large": painted(NOWHERE.format("1e30")),
}


@pytest.mark.parametrize("words", UNUSABLE)
def test_refusals_of_mitsuba_are_one_line(tmp_path, words):
    assert words in refusal(tmp_path, xml(shape=UNUSABLE[words]))


def test_files_of_no_known_kind(tmp_path):
    assert "is no scene file" in refusal(tmp_path, b"", name="scene.blend")
    assert "empty or damaged" in refusal(tmp_path, b"", name="scene.XML")
    (tmp_path / "my.toml").write_text('file = ""')
    with pytest.raises(BadInput, match="is no scene file"):
        OwnScene(tmp_path / "my.toml")


LAMP = '<shape type="cube" id="lamp"><emitter type="area"/></shape>'


def test_names_that_are_not_there(tmp_path):
    motion = '[[motion]]\nshape = "bell"\nkeyframes = [{ time = 0 }]\n'
    assert "there is no shape 'bell'; there are ball" in refusal(tmp_path, xml(), toml=motion)
    light = '[[light]]\nlight = "ball"\nkeyframes = [{ time = 0, gain = 1 }]\n'
    assert "no light 'ball'; there are constant, lamp" in refusal(tmp_path, xml(LAMP), toml=light)


@pytest.mark.parametrize("key", ["target = [1, 0, 5]", "target = [1, 9, 5]"])
def test_a_camera_that_cannot_see(tmp_path, key):
    """Its position is its target, or its up is its viewing axis."""
    scene = own(tmp_path, xml(), f"[[camera]]\ntime = 0\nposition = [1, 0, 5]\n{key}\n")
    with pytest.raises(BadInput, match=r"my\.toml: in frame 0 the camera"), np.errstate(invalid="ignore"):
        scene.clip("test", 0, 2, 0)


def test_keyframes_move_and_brighten(tmp_path):
    toml = """bounces = 1
    camera = [{ time = 0, position = [0, 0, 5], target = [0, 0, 0] }]
    [[motion]]
    shape = "ball"
    keyframes = [{ time = 0 }, { time = 1, position = [0.5, 0, 0] }]
    [[light]]
    light = "constant"
    keyframes = [{ time = 0, gain = 1 }, { time = 1, gain = 3 }]
    """
    clip = own(tmp_path, xml(), toml).clip("test", 0, 2, 0)
    assert clip.max_depth == 2
    stage = Stage(clip, 24, 32)
    first, last = (PosedFrame(stage, frame).emission.max() for frame in (0, 1))
    assert last == pytest.approx(3 * first)
    centres = []
    for frame in (0, 1):
        stage.pose(frame)
        centres.append(np.nonzero(render_gbuffer(stage, stage.view(frame))["mesh_id"][..., 0])[1].mean())
    expected = 0.5 / 5 * abs(stage.view(0).K[0, 0])  # a right shift of half a unit, five units away
    assert centres[1] - centres[0] == pytest.approx(expected, abs=0.3)


def test_meshes_of_gltf_move_as_their_vectors_say(tmp_path):
    box = trimesh.creation.box((1.5, 1.5, 0.5))
    world = trimesh.Scene()
    world.add_geometry(box, node_name="box")
    behind = trimesh.transformations.translation_matrix([0, 0, -1])
    world.add_geometry(trimesh.creation.box((9, 9, 0.1)), node_name="wall", transform=behind)
    world.camera = trimesh.scene.Camera(fov=(40, 40))
    world.camera_transform = trimesh.transformations.translation_matrix([0, 0, 5])
    toml = """
    [[motion]]
    shape = "box"
    keyframes = [{ time = 0 }, { time = 1, position = [0.2, 0.1, 0], rotation = [0, 0, 10] }]
    """
    scene = own(tmp_path, world.export(file_type="glb"), toml, name="scene.glb")
    clip = scene.clip("test", 0, 2, 0)
    stage = Stage(clip, 48, 64)
    before = render_gbuffer(stage, stage.view(0))["mesh_id"][..., 0]
    *_, mesh_id, vectors = posed_surfaces(stage, 1)
    box_id = 1 + [shape.name for shape in clip.meshes].index("box")
    there = np.floor(pixel_centres(48, 64) + vectors).astype(int)
    inside = (there >= 0).all(axis=-1) & (there < [64, 48]).all(axis=-1) & (mesh_id == box_id)
    assert inside.sum() > 100 and np.abs(vectors[inside]).max() > 1
    assert (before[there[inside][:, 1], there[inside][:, 0]] == box_id).mean() > 0.9  # else hidden, or on an edge


def test_the_smallest_images_and_clips(tmp_path):
    scene = own(tmp_path, xml(), "")
    scene.described.resolution = (1, 1)
    for frames in (1, 2):
        clip = scene.clip("train", 0, frames, 0)
        posed = PosedFrame(Stage(clip, 1, 1), frames - 1)
        assert np.isfinite(posed.reflected(0, 2) + posed.emission).all()


def test_points_of_no_size_and_deep_mixtures(tmp_path):
    point = own(tmp_path, xml(shape=painted('<float name="radius" value="0"/>'), camera=""))
    posed = PosedFrame(Stage(point.clip("train", 0, 2, 0), 4, 4), 1)
    assert np.isfinite(posed.reflected(0, 2) + posed.emission).all()
    blends = '<bsdf type="blendbsdf"><float name="weight" value="0.5"/><bsdf type="diffuse"/>'
    deep = own(tmp_path, xml(shape=painted(blends * 30 + '<bsdf type="plastic"/>' + "</bsdf>" * 30)))
    assert deep.stage.materials.depth == 6


def bulb_in_a_room(max_depth: int) -> str:
    """A lamp in a hollow ball of glass in a closed room, from within."""
    ball = '<shape type="sphere"><float name="radius" value="{}"/>{}</shape>'
    walls = '<shape type="cube"><boolean name="flip_normals" value="true"/>'
    walls += '<transform name="to_world"><scale value="8"/></transform></shape>'
    lamp = ball.format(0.3, '<emitter type="area"><rgb name="radiance" value="20"/></emitter>')
    depth = f'<integrator type="path"><integer name="max_depth" value="{max_depth}"/></integrator>'
    glass = '<bsdf type="dielectric"><float name="int_ior" value="{}"/><float name="ext_ior" value="{}"/></bsdf>'
    inner = ball.format(0.4, glass.format(1, 1.5))
    return xml(depth, walls, lamp, inner, light="", shape=ball.format(0.5, glass.format(1.5, 1)))


@pytest.mark.slow
def test_lamps_that_shine_through_glass_alone_need_more_bounces(tmp_path):
    assert own(tmp_path, bulb_in_a_room(6)).notes == []
    (note,) = own(tmp_path, bulb_in_a_room(3)).notes
    assert note.startswith("with 2 bounces only 0 % of the light") and "set `bounces = " in note
    assert own(tmp_path, bulb_in_a_room(3), "bounces = 4").notes == []


LOOK = '<lookat origin="1,4,3" target="0,0,0" up="0,1,0"/>'
MATRIX = " ".join(f"{value:.9f}" for value in look_at(np.array([1.0, 4, 3]), np.zeros(3)).ravel())
TO_Z_UP = '<rotate x="1" angle="90"/>'


@pytest.mark.parametrize("transform", [LOOK, f'<scale x="-1"/>{LOOK}', LOOK + TO_Z_UP, f'<matrix value="{MATRIX}"/>'])
def test_flights_and_keyframes_of_a_camera_that_looks_down_do_not_roll(tmp_path, transform):
    camera = f'<sensor type="perspective"><transform name="to_world">{transform}</transform></sensor>'
    keys = "[[camera]]\ntime = {}\nposition = {}\ntarget = [0, 0, 0]\n"
    toml = keys.format(0, [0, 4, 3]) + keys.format(1, [-3, 1, 2]) + "[splits.val]\ncamera = 'auto'"
    made = own(tmp_path, xml(camera=camera), toml)
    for split in ("test", "val"):
        left = made.clip(split, 0, 2, 0).view(1, 24, 32).camera_to_world[:3, 0]
        assert left[2 if TO_Z_UP in transform else 1] == pytest.approx(0, abs=1e-9)


def test_a_single_keyframe_counts(tmp_path):
    """A pose and a brightness that the file's scene has throughout."""
    lamp = '<emitter type="point" id="lamp"/>'
    toml = """
    [[motion]]
    shape = "ball"
    keyframes = [{ time = 0, position = [0, 7, 0] }]
    [[light]]
    light = "lamp"
    keyframes = [{ time = 0, gain = 0.25 }]
    """
    scene = own(tmp_path, xml(light=lamp), toml=toml).clip("test", 0, 2, 0)
    stage = Stage(scene, 4, 4)
    assert np.array(stage.mitsuba_scene.bbox().center())[1] == pytest.approx(7)
    assert np.array(stage.parameters["lamp.intensity.value"]).ravel() == pytest.approx(0.25)
