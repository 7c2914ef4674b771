"""A sphere of every kind of material in Mitsuba, compared with samples of its BSDF."""

import numpy as np
import pytest

from render.backend import dr, mi
from render.gbuffer import render_gbuffer
from render.loading import StockLoader
from render.stage import Stage
from scenes.animation import Camera, Scene, StockShape, Track
from tests.helpers.rendering import rgb

SAMPLES = 1 << 16


TAN = rgb(0.6, 0.4, 0.2)
DIFFUSE = {"type": "diffuse", "reflectance": TAN}
GOLD = {"type": "roughconductor", "material": "Au", "alpha": 0.15, "distribution": "ggx"}
FLAT = {"type": "uniform", "value": 0.5}
UP = {"type": "bitmap", "raw": True, "data": np.broadcast_to(np.float32([0.5, 0.5, 1.0]), (2, 2, 3)).copy()}
PRINCIPLED = {"type": "principled", "base_color": TAN, "roughness": 0.5, "specular": 0.5}

# Compared at normal incidence, with all light that is reflected or transmitted.
BSDFS = {
    "diffuse": DIFFUSE,
    "plastic": {"type": "plastic", "diffuse_reflectance": TAN},
    "plastic, nonlinear": {"type": "plastic", "diffuse_reflectance": TAN, "nonlinear": True},
    "roughplastic": {"type": "roughplastic", "diffuse_reflectance": TAN, "alpha": 0.2},
    "roughplastic, nonlinear": {"type": "roughplastic", "diffuse_reflectance": TAN, "nonlinear": True},
    "pplastic": {"type": "pplastic", "diffuse_reflectance": TAN, "alpha": 0.2},
    "conductor": {"type": "conductor", "material": "Cu"},
    "roughconductor": GOLD,
    "roughconductor, anisotropic": GOLD | {"alpha_u": 0.1, "alpha_v": 0.2} | {"alpha": None},
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
BSDFS = {name: {key: value for key, value in bsdf.items() if value is not None} for name, bsdf in BSDFS.items()}


def spheres() -> Stage:
    """A row of spheres of radius 1 along x, far away; the centre of a pixel hits each at normal incidence."""
    shapes = [
        StockShape(name, {"type": "sphere", "center": [3.0 * i, 0.0, 0.0], "radius": 1.0}, bsdf)
        for i, (name, bsdf) in enumerate(BSDFS.items())
    ]
    middle = 3.0 * (len(shapes) - 1) / 2
    far = 1e4
    fov = np.degrees(2 * np.arctan(1.5 * len(shapes) / far))
    camera = Camera(Track.constant([middle, 0, far]), Track.constant([middle, 0, 0]), Track.constant(fov))
    return Stage(Scene((), camera, stock=tuple(shapes)), 1, len(shapes))


@pytest.fixture(scope="module")
def buffer() -> dict[str, np.ndarray]:
    stage = spheres()
    return render_gbuffer(stage, stage.view(0))


def samples_of(bsdf: dict) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of light from straight above: the share (3,) that is not absorbed, and directions (N, 3) that it leaves by."""
    plugin = StockLoader().load(bsdf)
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
    np.testing.assert_allclose(albedo, np.minimum(samples_of(BSDFS[name])[0], 1), atol=0.08)


@pytest.mark.parametrize("name", ["roughconductor", "principled, metallic", "roughconductor, anisotropic"])
def test_roughness_is_how_far_reflections_spread(buffer, name):
    """GGX half vectors at normal incidence: the median of tan² is alpha², in the mean of both directions."""
    _, towards, valid = samples_of(BSDFS[name])
    half = np.add(towards, [0, 0, 1])[valid & (towards[:, 2] > 0)]
    spread = np.median((half[:, :2] ** 2).sum(axis=1) / half[:, 2] ** 2)
    assert buffer["roughness"][0, list(BSDFS).index(name), 0] == pytest.approx(np.sqrt(spread), rel=0.1)


def test_what_is_diffuse_is_rough_and_what_mirrors_is_not(buffer):
    roughness = dict(zip(BSDFS, buffer["roughness"][0, :, 0], strict=True))
    assert roughness["diffuse"] == roughness["normalmap"] == 1
    assert roughness["conductor"] == roughness["dielectric"] == roughness["thindielectric"] == roughness["plastic"] == 0
    assert 0 < roughness["hair"] <= 1


def test_normals_of_spheres_face_the_camera(buffer):
    np.testing.assert_allclose(buffer["normal"][0], np.broadcast_to([0, 0, 1], (len(BSDFS), 3)), atol=4e-3)
