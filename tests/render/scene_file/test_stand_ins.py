"""Stand-ins for what is not honoured: they render, are noted in plain words, and nothing else is lost."""

import numpy as np
import pytest

from render.backend import mi
from render.scene_file.convert import turned_to_y
from render.scene_file.stand_ins import OLD_PLUGINS, black_body, coated, mixture, phong
from tests.helpers.scene_files import CAMERA, SKY, old_xml, own, painted, xml
from tests.render.scene_file.test_mitsuba_06 import bsdf, light, rendered, shape, strings, texture


def new(bsdf: str) -> str:
    return xml(shape=painted(bsdf))


def named(tag: str, plugin: str, file: str, name: str = "") -> str:
    return f'<{tag} type="{plugin}" name="{name}"><string name="filename" value="{file}"/></{tag}>'


CHECKS = '<texture type="checkerboard" name="{}"/>'
LOST = named("texture", "bitmap", "no.png", "{}")
GROUP = '<shape type="shapegroup" id="g">{}</shape><shape type="instance"><ref id="g"/></shape>'
NO_OBJ = '<string name="filename" value="no.obj"/>'
MIXTURE = bsdf("mixturebsdf", strings(weights="x"))
IRREGULAR = '<string name="wavelengths" value="400, 700"/><string name="values" value="0.1, 0.2"/>'
WOBBLE = '<float name="{}" value="3"/>'
# Content, words of its note, and how many shapes and lights are left if not one each.
CASES = {
    "roughcoating": (old_xml(shape=painted(bsdf("roughcoating"))), "diffuse surface"),
    "mixture of what": (old_xml(shape=painted(MIXTURE)), "diffuse"),
    "bumps of checks": (new(bsdf("bumpmap", CHECKS.format("t"), bsdf("diffuse"))), "flat"),
    "lost normals": (new(bsdf("normalmap", LOST.format("normalmap"), bsdf("diffuse"))), "flat"),
    "scale": (old_xml(shape=painted(texture("scale"))), "grey"),
    "lost texture": (new(bsdf("diffuse", LOST.format("reflectance"))), "no.png is missing: grey"),
    "lost volume": (new(texture("volume")), "volume"),
    "lost measurements": (new(named("bsdf", "measured", "no.bsdf")), "grey diffuse"),
    "lost mesh": (xml(shape("obj", NO_OBJ)), "no.obj is missing"),
    "lost sky": (xml(light=named("emitter", "envmap", "no.exr")), "uniform white sky"),
    "lost spectrum": (new(bsdf("diffuse", '<spectrum name="reflectance" filename="no.spd"/>')),
                      "no.spd of a spectrum is missing"),
    "hair": (old_xml(shape("hair", '<string name="filename" value="no.hair"/>')), "no shape 'hair': nothing"),
    "unknown light": (old_xml('<emitter type="collimated"/>'), "has no emitter 'collimated': nothing"),
    "no light": (xml(light=""), "there is no light: a uniform white sky"),
    "two skies": (xml(SKY), "a second sky is left out"),
    "spot without picture": (xml(light("spot", LOST.format("texture"))), "without its texture", 1, 2),
    "top medium": (xml('<medium type="homogeneous" id="m"/>'), "m (scene.xml line 1): a medium is left out"),
    "irregular": (new(bsdf("diffuse", f'<spectrum type="irregular" name="reflectance">{IRREGULAR}</spectrum>')),
                  "red, green and blue"),
    "two cameras": (xml(CAMERA), "a further sensor is left out"),
    "orthographic": (xml(camera=CAMERA.replace("perspective", "orthographic").replace("fov", "near_clip")),
                     "frames the whole scene"),
    "no camera": (xml(camera=""), "there is no camera: one that frames the whole scene"),
    "sensor on a shape": (xml(shape("disk", '<sensor type="irradiancemeter"/>')), "a sensor on a shape", 2, 1),
    "shining group": (xml(GROUP.format('<shape type="sphere"><emitter type="area"/></shape>')),
                      "do not emit light", 2, 1),
    "empty group": (xml(GROUP.format(f'<shape type="obj">{NO_OBJ}</shape>')), "an instance of nothing"),
    "unknown property": (xml(shape("cube", WOBBLE.format("wobble") + bsdf("diffuse", WOBBLE.format("jolt")))),
                         "does not have 'wobble'", 2, 1),
    "a moving sun": (xml(light='<emitter type="timed_sunsky"/>'), "sunsky, whose sun does not move"),
    "bitmap of nothing": (new(texture("bitmap")), "its file is not named"),
    "wrong parts": (new(texture("checkerboard", '<bsdf type="plastic"/>')), "a bsdf cannot be nested here"),
    "sky on a shape": (xml(shape("cube", SKY)), "a light of the kind constant on a shape", 2, 1),
    "light of no shape": (xml('<emitter type="area"/>'), "on none: left out"),
    "no place": (xml(shape("cube", '<float name="to_world" value="2"/>')), "its to_world is no transform", 2, 1),
    "material merged": (xml('<shape type="merge"><bsdf type="diffuse"/></shape>'), "merged shapes"),
    "a property called type": (xml(shape("cube", '<string name="type" value="../evil"/>')), "called 'type'", 2, 1),
}  # fmt: skip


# Each of their scenes takes kernels of its own.
OF_OWN_KERNELS = (
    "a moving sun", "a property called type", "lost sky", "no light", "no place", "roughcoating", "sensor on a shape",
    "shining group", "sky on a shape", "spot without picture", "unknown property", "wrong parts",
)  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_it_is_noted(tmp_path, case):
    content, words, *left = CASES[case]
    shapes, lights = left or (1, 1)
    scene = own(tmp_path, content)
    assert any(words in note for note in scene.notes), scene.notes
    assert len(scene.scene.stock) == shapes and len(scene.scene.lights) == lights
    assert not any("\n" in note or ".cpp" in note for note in scene.notes)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (case in OF_OWN_KERNELS)) for case in CASES]
)
def test_it_is_rendered(tmp_path, case):
    image = rendered(own(tmp_path, CASES[case][0]))
    assert np.isfinite(image).all() and image.max() > 0


@pytest.fixture
def pictures(tmp_path):
    """A texture, a bump map, a shining picture and a sky, each of a file."""
    values = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(values).write(str(tmp_path / "sky.exr"))
    mi.Bitmap(np.uint8(255 * values)).write(str(tmp_path / "tex.png"))
    picture = named("texture", "bitmap", "tex.png", "{}")
    parts = (
        shape("cube", f'<bsdf type="bumpmap">{picture.format("t")}<bsdf type="plastic"/></bsdf>'),
        f'<shape type="disk"><emitter type="area">{picture.format("radiance")}</emitter></shape>',
        f'<shape type="cube"><emitter type="area">{picture.format("radiance")}</emitter></shape>',
    )
    ball = painted(bsdf("diffuse", picture.format("reflectance")))
    return own(tmp_path, xml(*parts, light=named("emitter", "envmap", "sky.exr"), shape=ball))


def test_files_of_pictures(pictures):
    assert pictures.notes == [] and len(pictures.scene.stock) == 4
    assert pictures.scene.stock[1].bsdf["type"] == "bumpmap"


@pytest.mark.slow
def test_files_of_pictures_are_rendered(pictures):
    assert np.isfinite(rendered(pictures)).all()


def test_a_plain_scene_needs_no_words(tmp_path):
    parts = (
        '<integrator type="path"><integer name="max_depth" value="4"/></integrator>',
        f'<bsdf type="twosided" id="b"><bsdf type="diffuse">{CHECKS.format("reflectance")}</bsdf></bsdf>',
        '<shape type="disk"><ref id="b"/></shape>',
        f'<shape type="cube"><emitter type="area">{CHECKS.format("radiance")}</emitter></shape>',
        '<shape type="merge"><shape type="cube"/><shape type="disk"/></shape>',
        GROUP.format('<shape type="sphere"/><shape type="cube"/>'),
        '<emitter type="point"/>',
    )
    film = '<film type="ldrfilm"><rfilter type="gaussian"/></film><sampler type="halton"/></sensor>'
    scene = own(tmp_path, xml(*parts).replace("</sensor>", film))
    assert scene.notes == [] and scene.scene.max_depth == 4
    assert [shape.name for shape in scene.scene.stock] == ["ball", "disk", "cube", "cube-2", "disk-2", "instance"]


def test_phong_is_as_sharp_as_its_plastic():
    """The lobe of exponent n has half its height where cosⁿ is a half; Beckmann's where exp(-tan² / α²) is."""
    for exponent in (30, 100, 1000):
        made, _ = phong({"type": "phong", "exponent": exponent})
        half = np.arccos(0.5 ** (1 / exponent))  # of the normal's angle, in a Phong distribution of normals
        assert np.exp(-((np.tan(half) / made["alpha"]) ** 2)) == pytest.approx(0.5, abs=0.06)


def test_mixtures_weigh_as_they_say():
    colours = [{"type": "rgb", "value": colour} for colour in np.eye(3).tolist()]
    parts = {str(i): {"type": "diffuse", "reflectance": colour} for i, colour in enumerate(colours)}
    mixed, _ = mixture({"type": "mixturebsdf", "weights": "0.5, 0.3, 0.2", **parts})
    bsdf = mi.load_dict(mixed)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(0, 0, 1)
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))).ravel() * np.pi
    np.testing.assert_allclose(value, [0.5, 0.3, 0.2], atol=1e-6)
    bsdf = mi.load_dict(mixture({"type": "mixturebsdf", "weights": "0.5, 0.3, 0.1", **parts})[0])  # the rest is black
    value = np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0, 1))).ravel() * np.pi
    np.testing.assert_allclose(value, [0.5, 0.3, 0.1], atol=1e-6)


def test_a_coat_with_a_texture_covers_a_material():
    inner, _ = coated({"type": "roughcoating", "alpha": {"type": "bitmap"}, "bsdf": {"type": "diffuse"}})
    assert inner == {"type": "diffuse"}


def test_black_bodies_shine_as_planck_says():
    """The peak of 5000 K lies at Wien's 579.6 nm, and is 12.8 kW / (m² sr nm)."""
    table = np.array(black_body({"type": "blackbody", "temperature": 5000.0})[0]["value"])
    assert table[table[:, 1].argmax(), 0] == pytest.approx(579.6, abs=5)
    assert table[:, 1].max() == pytest.approx(12.8e3, rel=0.01)


def test_old_skies_have_their_zenith_at_y():
    made, _ = OLD_PLUGINS["sky"](turned_to_y({"type": "sky", "turbidity": 3.0, "sun_direction": [0.0, 1.0, 0.2]}))
    made["to_world"] = mi.ScalarTransform4f(made["to_world"])
    sky = mi.load_dict({"type": "scene", "sky": made}).emitters()[0]
    si = mi.SurfaceInteraction3f()

    def visible(*direction: float) -> float:
        si.wi = -mi.Vector3f(*direction)
        return float(np.array(sky.eval(si)).max())

    assert visible(0, 0.9, 0.3) > 0 and visible(0.9, 0.1, 0) > 0 and visible(0, -0.9, 0.1) == 0
