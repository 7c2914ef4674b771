"""Files of Mitsuba 0.6, plugin by plugin and parameter by parameter of its manual: honoured, or listed and replaced."""

import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh

from errors import BadInput
from render.backend import mi
from render.path import PosedFrame
from render.scene_file import load
from render.scene_file.convert import SceneFile
from render.scene_file.xml import ParsedFile
from render.stage import Stage
from tests.helpers.scene_files import BALL, LOOK, SKY, old_xml, own, painted

PICTURE = '<string name="filename" value="picture.png"/>'
BITMAP = f'<texture {{}} type="bitmap">{PICTURE}</texture>'
TO_WORLD = '<transform name="toWorld"><scale value="2"/><rotate x="1" angle="90"/><translate y="2"/></transform>'
IORS = (
    "vacuum, helium, hydrogen, air, carbon dioxide, water, acetone, ethanol, carbon tetrachloride, glycerol, benzene, "
    "silicone oil, bromine, water ice, fused quartz, pyrex, acrylic glass, polypropylene, bk7, sodium chloride, amber, "
    "pet, diamond"
)
METALS = (
    "a-C Ag Al AlAs AlSb Au Be Cr CsI Cu Cu2O CuO d-C Hg HgTe Ir K Li MgO Mo Na_palik Nb Ni_palik Rh Se SiC SnTe Ta Te "
    "ThF4 TiC TiN TiO2 VC V_palik VN W none"
)


def values(tag: str, **named: object) -> str:
    return "".join(f'<{tag} name="{name}" value="{value}"/>' for name, value in named.items())


def element(tag: str, kind: str, *parts: str) -> str:
    return f'<{tag} type="{kind}">{"".join(parts)}</{tag}>'


floats, strings, spectra = (partial(values, tag) for tag in ("float", "string", "spectrum"))
bsdf, shape, light, integrator = (partial(element, tag) for tag in ("bsdf", "shape", "emitter", "integrator"))


METAL = bsdf("roughconductor", strings(material="Cu"), floats(alpha=0.3))
# (material, what its note says; "" for none)
BSDFS = {
    "diffuse": (bsdf("diffuse", spectra(reflectance="0.1, 0.2 0.3")), ""),
    "black": (bsdf("diffuse", spectra(reflectance="0,0,0")), ""),
    "30 bands": (bsdf("diffuse", spectra(reflectance=" ".join(["0.5"] * 30))), "rendered as red, green and blue"),
    "wavelengths": (bsdf("diffuse", spectra(reflectance="400:0.5, 700:0.2")), "rendered as red, green and blue"),
    "intent": (bsdf("diffuse", '<rgb name="reflectance" intent="reflectance" value="#ff8000"/>'), ""),
    "roughdiffuse": (bsdf("roughdiffuse", spectra(reflectance=0.5), floats(alpha=0.7)), "a diffuse surface"),
    "named iors": (bsdf("dielectric", strings(intIOR="water", extIOR="air")), ""),
    "tinted": (bsdf("dielectric", spectra(specularTransmittance=0.9, specularReflectance="0.9,0.8,0.7")), ""),
    "thindielectric": (bsdf("thindielectric", floats(intIOR=1.3), strings(extIOR="vacuum")), ""),
    **{f"rough glass, {kind}": (bsdf("roughdielectric", strings(distribution=kind), floats(alpha=0.1)), words)
       for kind, words in {"beckmann": "", "ggx": "", "phong": "Beckmann", "as": "Beckmann"}.items()},
    "brushed": (bsdf("roughconductor", strings(distribution="as"), floats(alphaU=0.05, alphaV=0.3)), "Beckmann"),
    "sampleVisible": (bsdf("roughplastic", values("boolean", sampleVisible="false"), floats(alpha=0.2)), ""),
    "eta and k": (bsdf("conductor", spectra(eta="0.2,0.9,1.1", k="3.9,2.4,2.1")), ""),
    "ext_eta": (bsdf("conductor", strings(material="Cu", extEta="water")), "(scene.xml line 1): this Mitsuba does not"),
    "unknown metal": (bsdf("conductor", strings(material="Unobtainium")), "a perfect mirror instead"),
    "plastic": (bsdf("plastic", strings(intIOR="pet"), spectra(diffuseReflectance=".1,.27,.36")), ""),
    "nonlinear": (bsdf("roughplastic", floats(intIOR=1.6, alpha=0.2), values("boolean", nonlinear="true")), ""),
    "coating": (bsdf("coating", floats(intIOR=1.7, thickness=1), spectra(sigmaA=0.1), METAL), "under the coat"),
    "roughcoating": (bsdf("roughcoating", floats(alpha=0.1), METAL), "under the coat"),
    "bump": (bsdf("bump", BITMAP.format(""), bsdf("plastic")), "bumpmap"),
    "phong": (bsdf("phong", floats(exponent=50), spectra(specularReflectance=0.3)), "rough plastic"),
    "ward": (bsdf("ward", strings(variant="balanced"), floats(alphaU=0.1, alphaV=0.2)), "rough plastic"),
    "mixturebsdf": (bsdf("mixturebsdf", strings(weights="0.7, 0.3"), bsdf("diffuse"), METAL), "the same mixture"),
    "blendbsdf": (bsdf("blendbsdf", BITMAP.format('name="weight"'), bsdf("diffuse"), METAL), ""),
    "mask": (bsdf("mask", spectra(opacity=0.3), bsdf("diffuse")), ""),
    "twosided": (bsdf("twosided", bsdf("diffuse"), METAL), ""),
    "difftrans": (bsdf("difftrans", spectra(transmittance=0.5)), "a diffuse surface"),
    "hk": (bsdf("hk", strings(material="skin1"), floats(thickness=5)), "a diffuse surface"),
    "irawan": (bsdf("irawan", strings(filename="cloth.wv")), "a diffuse surface"),
}  # fmt: skip


def texture(kind: str, *parts: str) -> str:
    return bsdf("diffuse", f'<texture name="reflectance" type="{kind}">{"".join(parts)}</texture>')


def bitmap(**parameters: object) -> str:
    return texture("bitmap", PICTURE, strings(**parameters))


TEXTURES = {
    **{f"filter {kind}": (bitmap(filterType=kind), words)
       for kind, words in {"ewa": "bilinearly", "trilinear": "bilinearly", "nearest": ""}.items()},
    **{f"wrap {kind}": (bitmap(wrapMode=kind), words)
       for kind, words in {"repeat": "", "mirror": "", "clamp": "", "zero": "'clamp'", "one": "'clamp'"}.items()},
    "wrap axes alike": (bitmap(wrapModeU="mirror", wrapModeV="mirror"), ""),
    "wrap axes apart": (bitmap(wrapModeU="clamp", wrapModeV="repeat"), "'clamp'"),
    "gamma": (texture("bitmap", PICTURE, floats(gamma=2.2)), "not with a gamma of 2.2"),
    "linear": (texture("bitmap", PICTURE, floats(gamma=1, maxAnisotropy=8), values("boolean", cache="true")), ""),
    "placement": (texture("bitmap", PICTURE, floats(uoffset=0.5, voffset=0.1, uscale=2, vscale=-1)), ""),
    "channel": (bitmap(channel="r"), "'channel': left out"),
    "checkerboard": (texture("checkerboard", spectra(color0=0.1, color1=".1,.2,.3"), floats(uscale=9)), ""),
    "gridtexture": (texture("gridtexture", spectra(color0=0.1), floats(lineWidth=0.1)), "a checkerboard"),
    "scale": (texture("scale", floats(scale=0.5), BITMAP.format("")), "at its own brightness"),
    **{kind: (texture(kind), "grey") for kind in ("vertexcolors", "wireframe", "curvature")},
}  # fmt: skip


FLIP = values("boolean", flipNormals="true")
MESH = values("boolean", faceNormals="true") + floats(maxSmoothAngle=30)
SHAPES = {
    **{kind: (shape(kind, TO_WORLD, FLIP), "") for kind in ("cube", "sphere", "rectangle", "disk")},
    "centre": (shape("sphere", '<point name="center" x="1" y="0" z="0"/>', floats(radius=2)), ""),
    "cylinder": (shape("cylinder", '<point name="p0" x="0" y="0" z="0"/><point name="p1" x="1" y="1" z="0"/>'), ""),
    "obj": (shape("obj", strings(filename="mesh.obj"), MESH), "'max_smooth_angle': left out"),
    "ply": (shape("ply", strings(filename="mesh.ply"), values("boolean", faceNormals="true", srgb="true")), "'srgb'"),
    "serialized": (shape("serialized", strings(filename="mesh.serialized"), values("integer", shapeIndex=0)), ""),
    "gone": (shape("serialized", strings(filename="gone.serialized")), "gone.serialized is missing"),
    **{kind: (shape(kind, strings(filename="picture.png")), "nothing instead") for kind in ("heightfield", "hair")},
    "subsurface": (shape("sphere", '<subsurface type="dipole"/>'), "the surface alone"),
    "medium": (shape("sphere", '<medium name="interior" type="homogeneous"/>', bsdf("dielectric")), "a medium"),
    "lookAt": (shape("cube", '<transform name="toWorld"><lookAt origin="1, 1, 1" target="1, 2, 1" up="0, 0, 1"/>'
                             "</transform>"), ""),
    "matrix": (shape("cube", '<transform name="toWorld"><matrix value="1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1"/></transform>'),
               ""),
    "animation": (shape("cube", '<animation name="toWorld"><transform time="0"/></animation>'), "first transform"),
    "area": (shape("sphere", '<emitter type="area">', spectra(radiance="10,8,6"), "</emitter>"), ""),
    "blackbody": (shape("sphere", '<emitter type="area"><blackbody name="radiance" temperature="3200K"/></emitter>'),
                  "rendered as red, green and blue"),
    "luminaire": ('<luminaire type="point"><point name="position" x="1" y="5" z="1"/></luminaire>', ""),
}  # fmt: skip


SUN = '<vector name="sunDirection" x="1" y="2" z="0"/>'
LIGHTS = {
    "point": (light("point", TO_WORLD, spectra(intensity="10,5,1"), floats(samplingWeight=1)), ""),
    "spot": (light("spot", LOOK.format("toWorld"), floats(cutoffAngle=20, beamWidth=10)), ""),
    "directional": (light("directional", '<vector name="direction" x="0" y="-1" z="0"/>', spectra(irradiance=1)), ""),
    "collimated": (light("collimated", spectra(power=1)), "nothing instead"),
    "constant": (light("constant", spectra(radiance=1)), ""),
    "envmap": (light("envmap", strings(filename="sky.exr"), floats(scale=3, gamma=-1), TO_WORLD), "'gamma': left out"),
    "sky": (light("sky", SUN, floats(turbidity=3, scale=2, stretch=1.2)), "the sky of sunsky"),
    "hour": (light("sky", floats(hour=15, latitude=35.7, longitude=139.7, timezone=9)), "the sky of sunsky"),
    "sun": (light("sun", SUN, floats(sunRadiusScale=15, scale=0.5)), "the sun of sunsky"),
    "sunsky": (light("sunsky", SUN, floats(turbidity=3, skyScale=2, sunScale=1.5)), ""),
}


def sensor(kind: str, *parts: str) -> str:
    return element("sensor", kind, *parts, LOOK.format("toWorld"))


FILM = '<film type="{}">' + strings(pixelFormat="rgb") + '<rfilter type="{}"/></film>'
SENSORS = {
    "focal length": (sensor("perspective", strings(focalLength="35mm")), ""),
    "millimetres": (sensor("perspective", floats(focalLength=35)), ""),
    **{f"axis {axis}": (sensor("perspective", floats(fov=30), strings(fovAxis=axis)), "")
       for axis in ("x", "y", "diagonal", "smaller", "larger")},
    "clipping": (sensor("perspective", floats(nearClip=1, farClip=9, shutterOpen=0, focusDistance=6)), "clipped"),
    "thinlens": (sensor("thinlens", floats(apertureRadius=0.1, focusDistance=6)), "a pinhole"),
    "perspective_rdist": (sensor("perspective_rdist", strings(kc="0.1, 0.2")), "without distortion"),
    **{kind: (sensor(kind), "not a perspective camera") for kind in ("orthographic", "telecentric", "spherical")},
    **{film: (sensor("perspective", FILM.format(film, "catmullrom")), "") for film in ("hdrfilm", "ldrfilm", "mfilm")},
    **{kind: (sensor("perspective", f'<sampler type="{kind}">', values("integer", sampleCount=16), "</sampler>"), "")
       for kind in ("independent", "stratified", "ldsampler", "halton", "hammersley", "sobol")},
    "camera": ('<camera type="perspective"><transform name="toWorld"><lookAt origin="0 0 5" target="0 0 0" up="0 1 0"/>'
               "</transform></camera>", ""),
}  # fmt: skip


DEPTH = values("integer", maxDepth=8, rrDepth=5)
OTHER_INTEGRATORS = "ao volpath bdpt photonmapper ppm sppm pssmlt mlt erpt ptracer adaptive irrcache vpl field"
OTHERS = {
    "path": (integrator("path", DEPTH, values("boolean", strictNormals="true")), ""),
    "hideEmitters": (integrator("path", values("boolean", hideEmitters="true")), "lights stay visible"),
    **{kind: (integrator(kind, DEPTH), "path tracing instead") for kind in OTHER_INTEGRATORS.split()},
    "default": ('<default name="n" value="4"/>' + integrator("path", values("integer", maxDepth="$n")), ""),
    "alias": ('<bsdf type="diffuse" id="a"/><alias id="a" as="b"/>' + shape("cube", '<ref id="b"/>'), ""),
}
NAMED = {
    "iors": [bsdf("dielectric", strings(intIOR=ior)) for ior in IORS.split(", ")],
    "metals": [bsdf("conductor", strings(material=metal)) for metal in METALS.split()],
}
CASES: dict[str, tuple[str, str]] = {
    name: (old_xml(*map(partial(shape, "sphere"), parts)), "") for name, parts in NAMED.items()
}
for cases in (BSDFS, TEXTURES):
    CASES |= {name: (old_xml(shape=painted(part)), words) for name, (part, words) in cases.items()}
for cases in (SHAPES, OTHERS):
    CASES |= {name: (old_xml(part), words) for name, (part, words) in cases.items()}
CASES |= {name: (old_xml(light=part), words) for name, (part, words) in LIGHTS.items()}
for name, (part, words) in SENSORS.items():
    CASES[name] = (f'<scene version="0.6.0">{part}{SKY}{BALL}</scene>', words)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the files lie that the scenes name."""
    folder = tmp_path_factory.mktemp("scene")
    mi.Bitmap(np.full((4, 4, 3), 0.5, np.float32)).write(str(folder / "sky.exr"))
    mi.Bitmap(np.full((4, 4, 3), 127, np.uint8)).write(str(folder / "picture.png"))
    box = trimesh.creation.box()
    for kind in ("obj", "ply"):
        box.export(folder / f"mesh.{kind}")
    # A file of version 4 with one mesh: single precision, no normals or texture coordinates.
    counts = struct.pack("<I5sQQ", 0x1000, b"mesh\0", len(box.vertices), len(box.faces))
    content = zlib.compress(counts + np.float32(box.vertices).tobytes() + np.uint32(box.faces).tobytes())
    whole = struct.pack("<HH", 0x041C, 4) + content + struct.pack("<QI", 0, 1)
    (folder / "mesh.serialized").write_bytes(whole)
    return folder


def rendered(scene) -> np.ndarray:
    """A frame's light (H, W, 3), with what is visible directly."""
    posed = PosedFrame(Stage(scene.clip("test", 0, 2, 0), 24, 32), 1)
    return np.add(*posed.tracer.radiance(posed.ray, 0, 2)) + posed.emission


@pytest.mark.parametrize("name", CASES)
def test_it_is_honoured_or_listed(folder, name, monkeypatch):
    monkeypatch.setattr(load, "note_on_depth", lambda *_: [])  # it renders; test_load.py has tests of it
    content, words = CASES[name]
    notes = own(folder, content).notes
    assert any(words in note for note in notes) if words else notes == []


@pytest.mark.slow  # its kernels take half a minute to compile
def test_all_materials_and_lights_are_rendered_together(folder):
    materials = [part for part, _ in [*BSDFS.values(), *TEXTURES.values()]]
    place = '<point name="center" x="{}" y="{}" z="0"/>'
    balls = [
        shape("sphere", floats(radius=0.2), place.format(0.45 * (index % 8) - 1.6, 0.4 * (index // 8) - 1.2), material)
        for index, material in enumerate(materials)
    ]
    image = rendered(own(folder, old_xml(*balls, *(part for part, _ in LIGHTS.values()))))
    assert np.isfinite(image).all() and image.max() > 0


def described(folder: Path, content: str) -> dict[str, dict]:
    """What is made of the first object of each kind: its dictionary, without nested ones but colours."""
    (folder / "scene.xml").write_text(content)
    file = SceneFile(folder / "scene.xml")
    return {"bsdf": file.shapes[0].bsdf or {}, "light": file.lights[0].emitter, "sensor": file.sensor or {}}


def test_numbers_mean_what_they_meant(tmp_path):
    def colour(value: str, tag: str = "spectrum") -> list[float]:
        material = bsdf("diffuse", values(tag, reflectance=value))
        return described(tmp_path, old_xml(shape=painted(material)))["bsdf"]["reflectance"]["value"]

    assert colour("0.1, 0.2 0.3") == pytest.approx([0.1, 0.2, 0.3])
    assert colour("#ff8000", "rgb") == pytest.approx([1, 128 / 255, 0], abs=1e-6)
    assert colour("#ff8000", "srgb") == pytest.approx([1, 0.2158605, 0], abs=1e-6)
    assert colour("0.5, 0 1", "srgb") == pytest.approx([0.2140411, 0, 1], abs=1e-6)
    camera = sensor("perspective", floats(focalLength=35))
    lens = described(tmp_path, f'<scene version="0.6.0">{camera}{SKY}{BALL}</scene>')
    assert lens["sensor"]["focal_length"] == "35.0mm"
    sky = described(tmp_path, old_xml(light=light("sky", floats(scale=2))))["light"]
    assert (sky["type"], sky["sky_scale"], sky["sun_scale"]) == ("sunsky", 2, 0)
    sun = described(tmp_path, old_xml(light=light("sun", floats(scale=3, sunRadiusScale=2))))["light"]
    assert (sun["sky_scale"], sun["sun_scale"], sun["sun_aperture"]) == (0, 3, pytest.approx(2 * 0.5358))


def test_scaled_textures(tmp_path):
    """Of relief in its own scale, of a constant colour in that."""
    (tmp_path / "picture.png").touch()
    relief = element("texture", "scale", floats(scale=0.1), element("texture", "bitmap", PICTURE))
    bumps = old_xml(shape=painted(bsdf("bumpmap", floats(scale=0.5), relief, bsdf("plastic"))))
    assert described(tmp_path, bumps)["bsdf"]["scale"] == pytest.approx(0.05)
    plain = old_xml(shape=painted(texture("scale", floats(scale=0.5), values("rgb", value=0.2))))
    assert described(tmp_path, plain)["bsdf"]["reflectance"]["value"] == pytest.approx([0.1] * 3)


def test_a_file_without_version_is_old(tmp_path):
    notes = own(tmp_path, old_xml().replace(' version="0.6.0"', "")).notes
    assert notes == ["the file names no version: read as one of Mitsuba 0.6"]


def test_included_files_are_upgraded_too(tmp_path):
    material = bitmap(filterType="ewa").replace("<bsdf ", '<bsdf id="a" ', 1).replace("picture.png", "gone.png")
    (tmp_path / "part.xml").write_text(f'<scene version="0.6.0">\n{material}</scene>')
    place = '<transform name="toWorld"><lookAt origin="0 0 0" target="0 0 1"/></transform>'
    cube = shape("cube", '<ref id="a"/>', place)
    (tmp_path / "scene.xml").write_text(old_xml('<include filename="part.xml"/>', cube))
    assert ParsedFile(tmp_path / "scene.xml").notes == []
    for version in (' version="0.5.0"', ""):  # other old ones
        (tmp_path / "part.xml").write_text(f"<scene{version}>\n{material}</scene>")
        assert ParsedFile(tmp_path / "scene.xml").notes == []
    notes = SceneFile(tmp_path / "scene.xml").notes
    assert notes == ["gone.png (part.xml line 2): the file gone.png is missing: grey instead of this texture"]


def test_spectra_lie_where_paths_say(tmp_path):
    (tmp_path / "spd").mkdir()
    (tmp_path / "spd" / "x.spd").write_text("400 0.25\n700 0.25\n")
    material = '<bsdf type="diffuse"><spectrum name="reflectance" filename="x.spd"/></bsdf>'
    (tmp_path / "scene.xml").write_text(old_xml('<path value="spd"/>', shape("cube", material)))
    assert not any("x.spd" in note for note in SceneFile(tmp_path / "scene.xml").notes)
    (tmp_path / "spd" / "x.spd").unlink()
    (tmp_path / "spd" / "x.spd").symlink_to("/etc/hostname")
    with pytest.raises(BadInput, match="leaves the scene's folder"):
        SceneFile(tmp_path / "scene.xml")
