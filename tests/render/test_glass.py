"""Glass in two layers: what it transmits is the room without it, what it reflects is what a mirror shows."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from datasets.channels import MIRRORED, SECOND, SECOND_LAYER
from datasets.clip import Clip
from datasets.frame import read_frame
from render.clip import Arrays, Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes.animation import Camera, RigidMotion, Scene, Shape, StockShape, Track
from scenes.camera import FAR_OUTSIDE, pixel_centres
from scenes.colours import Bsdf
from scenes.glass import GLASS_SCENES
from tests.datasets.test_mirrors import assert_the_same_from_exr, clip_of
from tests.helpers.datasets import MOST_CHANNELS
from tests.helpers.mirrors import BOX, FRAMES, GLIDE, SILVER, SIZE, painted, panel, placed, room
from tests.render.test_look_through import SURFACE, rendered
from tests.render.test_specular import GLASS, THIN, reflectances

SPP = 16


def with_picture(surface: Bsdf) -> Scene:
    """The room whose picture is of `surface`; behind it a box that glides along its far side, and a wall."""
    scene = room(surface)
    wall = Shape("far wall", placed(panel(20, 20), [0, 0, -4]), painted(0.4))
    glide = RigidMotion(Track(np.add(GLIDE.keys, [0, 0, -3]), last=FRAMES - 1.0), Track.constant(0.0))
    return replace(scene, shapes=(*scene.shapes, Shape("box behind", BOX, painted(0.9), motion=glide), wall))


@pytest.fixture(scope="module")
def pane() -> list[Arrays]:
    return rendered(with_picture(THIN), spp=SPP)


def assert_same_surfaces(frame: Arrays, forms: dict[str, str], other: Arrays, names: dict[str, str]) -> None:
    """In the picture, but for single pixels at edges."""
    picture = frame["mesh_id"][..., 0] == 1
    same = picture & (frame[forms["mesh_id"]] == other[names["mesh_id"]])[..., 0]
    assert picture.mean() > 0.4 and same.sum() >= picture.sum() - 6
    for name in (*SURFACE, "motion"):
        shown, expected = frame[forms[name]], other[names[name]]
        found = same & (np.abs(frame[forms["motion"]]) < FAR_OUTSIDE).all(axis=-1)
        assert found.sum() > 0.9 * same.sum()  # the others were hidden
        tolerance = {"motion": 0.05}.get(name, 1e-3)
        np.testing.assert_allclose(shown[found], expected[found], rtol=1e-4, atol=tolerance, err_msg=name)


@pytest.mark.slow
def test_what_a_pane_transmits_is_the_room_without_it(pane):
    scene = with_picture(THIN)
    picture, *others = scene.shapes
    without = replace(scene, shapes=(replace(picture, mesh=placed(picture.mesh, [0, 0, -1000])), *others))
    for frame, other in zip(pane, rendered(without), strict=True):
        assert_same_surfaces(frame, MIRRORED, other, {name: name for name in MIRRORED})
    assert np.abs(pane[-1][MIRRORED["motion"]]).max() > 1


@pytest.mark.slow
def test_what_a_pane_reflects_is_what_a_mirror_shows(pane):
    for frame, other in zip(pane, rendered(with_picture(SILVER)), strict=True):
        assert_same_surfaces(frame, SECOND, other, MIRRORED)


def test_elsewhere_there_is_one_layer(pane):
    for frame in pane:
        elsewhere = frame["mesh_id"][..., 0] != 1
        assert elsewhere.any()
        for name in set(SECOND_LAYER) - {SECOND["motion"]}:
            value = {"second_albedo": 1, "second_roughness": 1}.get(name, 0)
            assert (np.asarray(frame[name])[..., elsewhere, :] == value).all(), name


def test_samples_take_the_second_layer_by_fresnels_equations(pane):
    _, expected = reflectances(Stage(with_picture(THIN), *SIZE))
    picture = pane[0]["mesh_id"][..., 0] == 1
    reflectance = pane[0]["glass_reflectance"][..., 0]
    np.testing.assert_allclose(reflectance[picture], expected[picture], rtol=1e-3)
    drawn = pane[0]["second_samples"][0, ..., 0][picture]
    error = np.sqrt((expected * (1 - expected) / SPP)[picture])
    assert abs((drawn - expected[picture]).mean()) < 4 * np.sqrt((error**2).sum()) / len(error)


@pytest.mark.slow
def test_the_light_of_the_second_layer_is_that_of_a_mirror_times_reflectance():
    pane, mirror = (rendered(with_picture(surface), spp=64) for surface in (THIN, SILVER))
    seconds, expected = [], []
    for frame, other in zip(pane, mirror, strict=True):
        picture = frame["mesh_id"][..., 0] == 1
        second = frame["second_indirect"][0]
        assert (second <= (frame["direct"] + frame["indirect"])[0] * (1 + 1e-5) + 1e-6).all()
        seconds.append(second[picture].mean())
        expected.append((frame["glass_reflectance"] * (other["direct"] + other["indirect"])[0])[picture].mean())
    np.testing.assert_allclose(np.mean(seconds), np.mean(expected), rtol=0.25)


@pytest.mark.slow
def test_motion_through_a_ball_leads_to_the_same_light():
    """Emission, computed by other means, is the same at the end of the motion vectors; motion of the ball's is not.

    The ball stands before a wall that shines in waves.
    """
    waves = 2 + np.sin(np.linspace(0, 6 * np.pi, 256))
    texture = {"type": "bitmap", "data": np.float32(np.broadcast_to(waves[None, :, None], (256, 256, 3))), "raw": True}
    to_world = np.diag([6.0, 6, 1, 1])
    to_world[2, 3] = -3
    shine = {"type": "area", "radiance": texture}
    wall = StockShape("wall", {"type": "rectangle", "to_world": to_world}, painted(0.0), shine)
    ball = Shape("ball", trimesh.creation.icosphere(subdivisions=5, radius=1), GLASS, smooth=True)
    eye = Track(np.array([[0.0, 0.3, 4], [0.12, 0.3, 4]]), last=1.0)
    camera = Camera(eye, Track.constant([0.0, 0, 0]), Track.constant(40.0))
    scene = Scene((ball,), camera, max_depth=8, stock=(wall,))
    first, second = (frame for frame, _ in render_clip(scene, 2, 96, 96, Sampling(1, 1, 2), seed=0))
    inside = np.hypot(*(pixel_centres(96, 96) - [48, 51]).transpose(2, 0, 1)) < 24
    inside &= second["mesh_id"][..., 0] == 1
    assert inside.sum() > 1000

    def error_of(motion: np.ndarray) -> float:
        x, y = (pixel_centres(96, 96) + motion - 0.5).transpose(2, 0, 1)
        column, row = (np.clip(np.floor(t).astype(int), 0, 94) for t in (x, y))
        fx, fy = np.clip(x - column, 0, 1), np.clip(y - row, 0, 1)
        image = first["emission"][..., 0]
        upper = image[row, column] * (1 - fx) + image[row, column + 1] * fx
        lower = image[row + 1, column] * (1 - fx) + image[row + 1, column + 1] * fx
        return float(np.abs(upper * (1 - fy) + lower * fy - second["emission"][..., 0])[inside].mean())

    traced = second[MIRRORED["motion"]]
    assert (np.abs(traced[inside]) < FAR_OUTSIDE).all(axis=-1).mean() > 0.98
    found = np.where(np.abs(traced) < FAR_OUTSIDE, traced, 0)
    assert error_of(found) < 0.15 * error_of(second["motion"])


@pytest.mark.parametrize("surface", [{"type": "roughdielectric", "alpha": 0.2}, {"type": "plastic"}, painted(0.5)])
def test_what_is_no_smooth_glass_has_one_layer(surface):
    assert Stage(with_picture(surface), *SIZE).glass is None


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    return clip_of(with_picture(THIN), tmp_path_factory.mktemp("glass"), MOST_CHANNELS)


def test_only_clips_that_show_glass_have_its_channels(clip, tmp_path):
    of_layers = {*SECOND_LAYER, *MIRRORED.values()}
    assert of_layers <= clip.channels.keys()
    plain = room(painted(0.5))
    hidden = Shape("pane out of sight", placed(panel(0.1, 0.1), [0, 0, 50]), THIN)
    other = clip_of(replace(plain, shapes=(*plain.shapes, hidden)), tmp_path, MOST_CHANNELS)
    assert not of_layers & other.channels.keys()
    assert not [*other.path.glob("second*"), *other.path.glob("mirrored*")]


def test_frames_bring_the_second_layer(clip):
    """And what it takes to split samples. First hits are the surface of the glass alone."""
    frame = read_frame(clip, 1, ("direct", "indirect", "motion"))
    expected = {"glass_reflectance", "second_samples", *(SECOND[name] for name in ("indirect", "albedo", "mesh_id"))}
    assert {*expected, SECOND["motion"], "albedo", "mesh_id", "emission"} <= frame.channels.keys()
    own = read_frame(Clip(clip.path, first_hits=True), 1, ("indirect", "albedo"))
    np.testing.assert_array_equal(own.albedo[0].permute(1, 2, 0), clip.read("albedo", 1))
    assert own.channels.keys() == {"indirect", "albedo"}
    assert Clip(clip.path, first_hits=True).fingerprint != clip.fingerprint


def test_blended_guides_are_means_by_probability(clip):
    share = clip.read("glass_reflectance", 1).astype(np.float32)
    assert 0 < share.max() < 0.5
    main, second = (clip.read(forms["albedo"], 1).astype(np.float32) for forms in (MIRRORED, SECOND))
    np.testing.assert_allclose(clip.read_blended("albedo", 1), (1 - share) * main + share * second, atol=1e-6)


def test_exported_frames_have_both_layers(clip, tmp_path):
    assert_the_same_from_exr(clip, ("indirect", "albedo", "motion"), tmp_path)


def test_a_stage_is_freed_at_once():
    """By the collector of cycles it might be during a recording, which ends the process."""
    stage = Stage(with_picture(THIN), *SIZE)
    render_gbuffer(stage, stage.view(0))
    freed = weakref.ref(stage)
    gc.disable()
    del stage
    assert freed() is None
    gc.enable()


@pytest.mark.parametrize("name", GLASS_SCENES)
def test_the_glass_of_the_test_set_is_in_view(name):
    """And what moves in a scene with a camera at rest does."""
    scene = GLASS_SCENES[name](np.random.default_rng(0), 4)
    stage = Stage(scene, 36, 64)
    assert stage.glass is not None
    assert scene.moves() == name.endswith("-moving") != scene.camera.eye.varies()
