"""G-buffers that look through mirrors: a mirror shows what a window would, were the room behind it built."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import trimesh

from datasets.channels import SECOND_LAYER
from provenance import ROOT
from render.clip import Arrays, Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes.animation import Camera, Scene, Shape, Track
from scenes.camera import pixel_centres, unproject
from tests.helpers.mirrors import CAMERA, FRAMES, HAND_MIRROR, SILVER, SIZE, mirror, painted, panel, placed, room
from tests.helpers.rendering import first_gbuffer, rgb
from tests.helpers.scene_files import own

SURFACE = ("normal", "depth", "roughness", "albedo")


def behind(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh as a mirror in z = 0 shows it."""
    copy = mesh.copy()
    copy.apply_scale([1, 1, -1])
    return copy


def room_twice() -> Scene:
    """The room with its mirror image built where the picture was. The image's ids are those of what it is of, + 3."""
    ours = room(SILVER).shapes
    box, wall = (
        Shape(f"{shape.name} behind", behind(shape.mesh), shape.bsdf, motion=shape.motion) for shape in ours[1:]
    )
    far = replace(ours[0], mesh=placed(ours[0].mesh, [0, 0, -1000]))
    return Scene((far, *ours[1:], Shape("nothing", placed(panel(1, 1), [0, 0, 900]), SILVER), box, wall), CAMERA)


def show_themselves(scene: Scene) -> dict[str, np.ndarray]:
    """Assert that all surfaces in the first frame show nothing but themselves. Returns its G-buffer."""
    buffer = first_gbuffer(scene, *SIZE)
    for name in (*SURFACE, "mesh_id"):
        np.testing.assert_array_equal(buffer[f"mirrored_{name}"], buffer[name], err_msg=name)
    return buffer


def rendered(scene: Scene, spp: int = 1) -> list[Arrays]:
    """What is visible, its light and its motion."""
    channels = (*SURFACE, "mesh_id", "motion", "direct", "indirect", *SECOND_LAYER)
    frames = render_clip(scene, FRAMES, *SIZE, Sampling(1, spp, 2), seed=3, channels=channels)
    return [frame for frame, _ in frames]


@pytest.fixture(scope="module")
def visible() -> list[tuple[dict, dict]]:
    """Each frame of the room with the mirror, and of that which is built twice."""
    return list(zip(rendered(room(SILVER)), rendered(room_twice()), strict=True))


def test_a_mirror_shows_what_a_window_would(visible):
    """Surfaces and motion, but for single pixels at edges."""
    for frame, twice in visible:
        picture = frame["mesh_id"][..., 0] == 1
        same = picture & (frame["mirrored_mesh_id"] + 3 == twice["mesh_id"])[..., 0]
        assert picture.mean() > 0.4 and same.sum() >= picture.sum() - 3
        assert {2, 3} <= set(frame["mirrored_mesh_id"][picture].ravel())
        for name in (*SURFACE, "motion"):
            shown = frame[f"mirrored_{name}"][same]
            np.testing.assert_allclose(shown, twice[name][same], rtol=1e-4, atol=1e-3, err_msg=name)
    assert np.abs(visible[-1][0]["mirrored_motion"]).max() > 1


def test_elsewhere_all_is_as_it_is(visible):
    for frame, _ in visible:
        elsewhere = frame["mesh_id"][..., 0] != 1
        assert elsewhere.any()
        for name in (*SURFACE, "mesh_id", "motion"):
            np.testing.assert_array_equal(frame[f"mirrored_{name}"][elsewhere], frame[name][elsewhere], err_msg=name)


METALS = [{"type": "roughconductor", "material": "Ag", "alpha": 0.3}, {"type": "conductor", "material": "Ag"}]
OTHERS = [painted(0.5), {"type": "plastic", "diffuse_reflectance": rgb(0.5, 0.5, 0.5)}, *METALS]


@pytest.mark.parametrize("surface", OTHERS, ids=lambda bsdf: bsdf["type"])
def test_what_is_no_mirror_is_not_looked_through(surface):
    scene = room(surface)
    if surface["type"] == "conductor":
        scene.shapes[0].mesh.invert()  # its back is black
    show_themselves(replace(scene, shapes=(*scene.shapes, HAND_MIRROR)))


@pytest.mark.parametrize("size, alpha, limit", [(SIZE, 0.0098, 0.75), ((288, 384), 0.0035, 1.2)])
def test_a_glossy_surface_shows_what_it_shows_sharply(size, alpha, limit):
    """Near it, up to 0.75 px or 1/240 of the image's height: rays that leave it spread by twice its alpha."""
    glossy = {"type": "twosided", "bsdf": {"type": "roughconductor", "material": "none", "alpha": alpha}}
    stages = [Stage(room(surface), *size) for surface in (SILVER, glossy)]
    view = stages[0].view(0)
    smooth, rough = (render_gbuffer(stage, view) for stage in stages)
    whole, first = (smooth[name][..., 0].astype(float) for name in ("mirrored_depth", "depth"))
    blur = 2 * alpha * (whole - first) / np.maximum(whole, 1e-9) * abs(view.K[0, 0])
    sharp = blur < limit
    decided = np.abs(blur - limit) > 0.01
    picture = smooth["mesh_id"][..., 0] == 1
    assert (picture & sharp).sum() > 50 and (picture & ~sharp).sum() > 50
    for name in (*SURFACE, "mesh_id"):
        shown = np.where(sharp[..., None], smooth[f"mirrored_{name}"], rough[name])
        np.testing.assert_allclose(rough[f"mirrored_{name}"][decided], shown[decided], rtol=1e-5, atol=1e-5)


def test_a_mirror_that_shows_the_sky_is_a_mirror():
    picture, *others = room(SILVER).shapes
    out_of_sight = (replace(shape, mesh=placed(shape.mesh, [0, 0, -1000])) for shape in others)
    buffer = show_themselves(Scene((replace(picture, mesh=panel(20, 20)), *out_of_sight), CAMERA))
    assert buffer["mesh_id"].mean() > 0.6


def test_a_tinted_mirror_tints_albedo():
    """By its reflectance at normal incidence, the more often the more mirrors there are."""
    buffer = first_gbuffer(room(mirror(0.9, 0.6, 0.3)), *SIZE)
    behind_glass = buffer["mirrored_mesh_id"][..., 0] == 3
    assert behind_glass.any()
    tints = buffer["mirrored_albedo"][behind_glass] / [0.7, 0.4, 0.6]
    np.testing.assert_allclose(tints, np.broadcast_to([0.9, 0.6, 0.3], tints.shape), rtol=1e-5)


def test_mirrors_in_mirrors_turn_what_they_show_in_their_order():
    """A ball between two mirrors at 50 degrees: each image is a sphere around the ball's centre, reflected in turn."""
    angle = np.radians(50)
    normals = {"a": np.array([0.0, 0, 1]), "b": np.array([-np.sin(angle), 0, np.cos(angle)])}
    centre, radius = np.array([0.9, 0.1, 0.45]), 0.25
    ball = placed(trimesh.creation.icosphere(subdivisions=5, radius=radius), list(centre))
    across = placed(panel(4, 4), [2.0, 0, 0])
    other = across.copy()
    other.apply_transform(trimesh.transformations.rotation_matrix(-angle, [0, 1, 0]))
    shapes = (Shape("a", across, SILVER), Shape("b", other, SILVER), Shape("ball", ball, painted(0.5), smooth=True))
    camera = Camera(Track.constant([3.0, 0.4, 1.4]), Track.constant([0.0, 0, 0]), Track.constant(70.0))
    stage = Stage(Scene(shapes, camera), 96, 96)
    view = stage.view(0)
    buffer = render_gbuffer(stage, view)
    hit = buffer["mirrored_mesh_id"][..., 0] == 3
    points = unproject(pixel_centres(96, 96), buffer["mirrored_depth"][..., 0].astype(float), view)[hit]
    reflect = {name: np.eye(3) - 2 * np.outer(n, n) for name, n in normals.items()}
    shown = np.full(hit.sum(), "", dtype=object)
    for order in ("", *("".join(each) for count in (1, 2, 3) for each in product("ab", repeat=count))):
        if "aa" in order or "bb" in order:
            continue
        image = centre
        for name in reversed(order):  # the first mirror on the way is the last to reflect
            image = reflect[name] @ image
        outward = (points - image) / radius
        on_it = np.abs(np.linalg.norm(outward, axis=-1) - 1) < 5e-3
        matches = on_it & (np.abs(outward - buffer["mirrored_normal"][hit]).max(axis=-1) < 2e-2)
        shown[matches & (shown == "")] = order or "itself"
    assert (shown != "").all()
    assert {"itself", "a", "b"} <= set(shown) and {"ab", "ba"} & set(shown)


@pytest.mark.slow
def test_the_ball_of_the_docs_shows_its_room(tmp_path):
    """A curved mirror in a scene file: a picture of the room, farther away than the ball, no sky and no ball in it."""
    found = own(tmp_path, (ROOT / "docs" / "mirror-ball.xml").read_text())
    assert found.notes == []
    buffer = render_gbuffer(found.stage, found.stage.view(0))
    ball = buffer["mesh_id"][..., 0] == [shape.name for shape in found.scene.meshes].index("ball") + 1
    assert ball.mean() > 0.05
    assert len(np.unique(buffer["mirrored_mesh_id"][ball])) > 3
    assert (buffer["mirrored_mesh_id"][ball] != buffer["mesh_id"][ball]).all()
    assert (buffer["mirrored_depth"][ball] > buffer["depth"][ball]).all()
    np.testing.assert_allclose(np.linalg.norm(buffer["mirrored_normal"][ball], axis=-1), 1, atol=1e-5)
