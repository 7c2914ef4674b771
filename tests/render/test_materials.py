"""Albedo and roughness of materials, compared with Mitsuba's own sampling of the same BSDFs."""

import numpy as np
import pytest
import trimesh

from render.backend import dr, mi
from render.loading import to_mitsuba
from render.materials import material_of, mean_of
from render.stage import Stage
from scenes.animation import Camera, Scene, Shape, StockShape, Track
from tests.helpers.rendering import first_gbuffer, rgb

SAMPLES = 1 << 16
TAN = rgb(0.6, 0.4, 0.2)
DIFFUSE = {"type": "diffuse", "reflectance": TAN}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.15, "distribution": "ggx"}
ANISOTROPIC = {"type": "roughconductor", "material": "Au", "alpha_u": 0.1, "alpha_v": 0.2, "distribution": "ggx"}
FLAT = {"type": "uniform", "value": 0.5}
UP = {"type": "bitmap", "raw": True, "data": np.broadcast_to(np.float32([0.5, 0.5, 1.0]), (2, 2, 3)).copy()}
PRINCIPLED = {"type": "principled", "base_color": TAN, "roughness": 0.5, "specular": 0.5}
ETA_AND_K = {"eta": rgb(0.2, 0.9, 1.4), "k": rgb(3.0, 2.5, 1.0)}

METALS = {
    "conductor": {"type": "conductor", "material": "Cu"},
    "mirror": {"type": "conductor", "material": "none"},
    "conductor, eta and k": {"type": "conductor", "specular_reflectance": TAN} | ETA_AND_K,
    "smooth roughconductor": {"type": "roughconductor", "material": "Al", "alpha": 0.02},
    "tinted": {"type": "roughconductor", "material": "Au", "alpha": 0.05, "specular_reflectance": TAN},
    "smooth principled, metallic": PRINCIPLED | {"metallic": 1.0, "roughness": 0.1},
}
# Compared at normal incidence, with all light that is reflected or transmitted.
BSDFS = {
    "diffuse": DIFFUSE,
    "plastic": {"type": "plastic", "diffuse_reflectance": TAN},
    "plastic, nonlinear": {"type": "plastic", "diffuse_reflectance": TAN, "nonlinear": True},
    "roughplastic": {"type": "roughplastic", "diffuse_reflectance": TAN, "alpha": 0.2},
    "roughplastic, nonlinear": {"type": "roughplastic", "diffuse_reflectance": TAN, "nonlinear": True},
    "pplastic": {"type": "pplastic", "diffuse_reflectance": TAN, "alpha": 0.2},
    **METALS,
    "roughconductor": GOLD,
    "roughconductor, anisotropic": ANISOTROPIC,
    "dielectric": {"type": "dielectric"},
    "thindielectric": {"type": "thindielectric"},
    "roughdielectric": {"type": "roughdielectric", "alpha": 0.2, "distribution": "ggx"},
    "principled": PRINCIPLED,
    "principled, metallic": PRINCIPLED | {"metallic": 1.0, "roughness": 0.3},
    "principled, glass": PRINCIPLED | {"spec_trans": 1.0, "base_color": rgb(1, 1, 1)},
    "principledthin": {"type": "principledthin", "base_color": TAN, "roughness": 0.4},
    "mask": {"type": "mask", "opacity": 0.7, "nested": DIFFUSE},
    "blendbsdf": {"type": "blendbsdf", "weight": 0.25, "a": DIFFUSE, "b": GOLD},
    "blendbsdf of blendbsdf": {
        "type": "blendbsdf",
        "weight": 0.5,
        "a": {"type": "blendbsdf", "weight": 0.25, "a": DIFFUSE, "b": GOLD},
        "b": {"type": "blendbsdf", "weight": 0.75, "a": DIFFUSE, "b": PRINCIPLED},
    },
    "twosided": {"type": "twosided", "a": GOLD, "b": DIFFUSE},
    "normalmap": {"type": "normalmap", "normalmap": UP, "nested": DIFFUSE},
    "bumpmap": {"type": "bumpmap", "texture": FLAT, "nested": GOLD},
    "hair": {"type": "hair"},
}


@pytest.fixture(scope="module")
def buffer() -> dict[str, np.ndarray]:
    """Of a row of spheres of radius 1 along x, far away; the centre of a pixel hits each at normal incidence."""
    shapes = [
        StockShape(name, {"type": "sphere", "center": [3.0 * i, 0.0, 0.0], "radius": 1.0}, bsdf)
        for i, (name, bsdf) in enumerate(BSDFS.items())
    ]
    middle = 3.0 * (len(shapes) - 1) / 2
    far = 1e4
    fov = np.degrees(2 * np.arctan(1.5 * len(shapes) / far))
    camera = Camera(Track.constant([middle, 0, far]), Track.constant([middle, 0, 0]), Track.constant(fov))
    return first_gbuffer(Scene((), camera, stock=tuple(shapes)), 1, len(shapes))


def samples_of(bsdf: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of light from straight above: the share (3,) that is not absorbed, and directions (N, 3) that it leaves by."""
    plugin = mi.load_dict(to_mitsuba(bsdf))
    si = dr.zeros(mi.SurfaceInteraction3f, SAMPLES)
    si.wi = mi.Vector3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    si.dp_du = mi.Vector3f(1, 0, 0)
    si.dp_dv = mi.Vector3f(0, 1, 0)
    random = mi.PCG32(SAMPLES, initstate=7)
    u = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = plugin.sample(mi.BSDFContext(mi.TransportMode.Importance), si, random.next_float32(), u)
    weight = np.nan_to_num(np.array(weight).T)
    return weight.mean(axis=0), np.array(sample.wo).T, weight.max(axis=1) > 0


@pytest.mark.parametrize("name", BSDFS)
def test_albedo_is_what_the_material_does_not_absorb(buffer, name):
    """To 0.08: our albedo is by definition the sum of the lobes, without what one takes from the other."""
    albedo = buffer["albedo"][0, list(BSDFS).index(name)]
    tolerance = {"rtol": 0.02} if name in METALS else {"atol": 0.08}
    np.testing.assert_allclose(albedo, np.minimum(samples_of(BSDFS[name])[0], 1), **tolerance)


@pytest.mark.parametrize("name", ["roughconductor", "principled, metallic", "roughconductor, anisotropic"])
def test_roughness_is_how_far_reflections_spread(buffer, name):
    """GGX half vectors at normal incidence: the median of tan² is alpha², in the mean of both directions."""
    _, towards, valid = samples_of(BSDFS[name])
    half = np.add(towards, [0, 0, 1])[valid & (towards[:, 2] > 0)]
    spread = np.median((half[:, :2] ** 2).sum(axis=1) / half[:, 2] ** 2)
    assert buffer["roughness"][0, list(BSDFS).index(name), 0] == pytest.approx(np.sqrt(spread), rel=0.1)


def test_what_is_diffuse_is_rough_and_what_mirrors_is_not(buffer):
    roughness = dict(zip(BSDFS, buffer["roughness"][0, :, 0], strict=True))
    albedo = dict(zip(BSDFS, buffer["albedo"][0], strict=True))
    assert roughness["diffuse"] == roughness["normalmap"] == 1
    assert roughness["conductor"] == roughness["dielectric"] == roughness["thindielectric"] == roughness["plastic"] == 0
    assert 0 < roughness["hair"] <= 1 and roughness["roughdielectric"] == pytest.approx(0.2)
    assert all((albedo[name] == 1).all() for name in ("dielectric", "thindielectric", "roughdielectric"))


def test_normals_of_spheres_face_the_camera(buffer):
    """But for the angle at which the ends of the row are seen, 0.0042."""
    np.testing.assert_allclose(buffer["normal"][0], np.broadcast_to([0, 0, 1], (len(BSDFS), 3)), atol=5e-3)


def textured_square(bsdf: dict) -> Scene:
    """A unit square visible head-on, with texture coordinates from 0 to 1, v up."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    mesh = trimesh.Trimesh(np.c_[corners - 0.5, np.zeros(4)], [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=corners)
    fov = np.degrees(2 * np.arctan(0.5 / 4))  # the square fills the image
    camera = Camera(Track.constant([0.0, 0, 4]), Track.constant([0.0, 0, 0]), Track.constant(fov))
    return Scene((Shape("square", mesh, bsdf),), camera)


@pytest.mark.parametrize(
    "bsdf",
    [{"type": "plastic"}, {"type": "roughplastic", "alpha": 0.05}, {"type": "plastic", "specular_reflectance": 0.3}],
)
@pytest.mark.parametrize("eta", [1.3, 1.9])
def test_albedo_of_plastics_is_diffuse_plus_specular(bsdf, eta):
    bsdf = {**bsdf, "int_ior": eta, "ext_ior": 1.0, "diffuse_reflectance": rgb(0.1, 0.4, 0.7)}
    albedo = first_gbuffer(textured_square(bsdf), 4, 4)["albedo"][0, 0]
    coat, *_ = samples_of({**bsdf, "diffuse_reflectance": rgb(0, 0, 0)})
    np.testing.assert_allclose(albedo, np.array([0.1, 0.4, 0.7]) + coat, rtol=0.02)


def test_principled_mixes_by_metallic():
    bsdf = {"type": "principled", "base_color": rgb(0.2, 0.4, 0.6), "metallic": 0.25, "specular": 0.5, "roughness": 0.3}
    buffer = first_gbuffer(textured_square({"type": "twosided", "bsdf": bsdf}), 4, 4)
    base = np.array([0.2, 0.4, 0.6])
    expected = base * 0.75 + (0.08 * 0.5 * 0.75 + base * 0.25)
    np.testing.assert_allclose(buffer["albedo"][0, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(buffer["roughness"], 0.09, rtol=1e-5)


def test_textures_are_read_where_they_are_seen():
    """4 x 4 texels: the first row of a bitmap lies at v = 0, which is the bottom row of the image."""
    ramp = np.linspace(0.1, 0.5, 16).reshape(4, 4, 1)
    colour = np.concatenate([ramp, 2 * ramp * 0.9, 0.6 - ramp], axis=-1)

    def bitmap(data: np.ndarray) -> dict:
        return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest"}

    bsdf = {"type": "roughconductor", "alpha": bitmap(ramp), "specular_reflectance": bitmap(colour)}
    buffer = first_gbuffer(textured_square(bsdf), 4, 4)
    np.testing.assert_allclose(buffer["roughness"], ramp[::-1], rtol=1e-5)
    np.testing.assert_allclose(buffer["albedo"], colour[::-1], rtol=1e-5)


def test_anisotropic_roughness_is_the_mean_of_its_textures():
    halves = {"type": "bitmap", "data": np.float32([0.1, 0.3, 0.3, 0.1]).reshape(1, 4, 1), "raw": True}
    bsdf = mi.load_dict(to_mitsuba({"type": "roughconductor", "alpha_u": halves, "alpha_v": 0.2}))
    assert mean_of(material_of(bsdf).roughness) == pytest.approx(0.2, rel=1e-5)


def test_every_shape_has_its_own_material():
    """Materials are looked up by shape, whatever order Mitsuba keeps its instances in."""
    kinds = [
        {"type": "diffuse", "reflectance": rgb(0.1, 0.2, 0.3)},
        {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.3, 0.2, 0.1)},
        {"type": "roughplastic", "alpha": 0.25, "diffuse_reflectance": rgb(0.5, 0.5, 0.5)},
        {"type": "diffuse", "reflectance": rgb(0.9, 0.8, 0.7)},
    ]
    assert len(Stage(textured_square(kinds[0]), 2, 2).materials.materials) == 1
    base = textured_square(kinds[0])
    shapes = []
    for i, bsdf in enumerate(kinds):
        mesh = base.shapes[0].mesh.copy()
        mesh.vertices[:, 0] = (mesh.vertices[:, 0] + 0.5 + i) / len(kinds) - 0.5
        shapes.append(Shape(f"shape-{9 - i}", mesh, bsdf))
    buffer = first_gbuffer(Scene(tuple(shapes), base.camera), 4, 4)
    np.testing.assert_allclose(buffer["roughness"][0, :, 0], [1, 0, 0.25, 1])
    np.testing.assert_allclose(buffer["albedo"][0, :, 0], [0.1, 0.3, 0.5 + (0.49 / 2.49) ** 2, 0.9], rtol=2e-3)


def test_an_attribute_of_a_mesh_is_no_mirrors_roughness():
    """Mitsuba does not know its mean."""
    assert mean_of(mi.load_dict({"type": "mesh_attribute", "name": "vertex_alpha"})) == np.inf
