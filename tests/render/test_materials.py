"""Albedo and roughness of materials, compared with Mitsuba's own sampling of the same BSDFs."""

import numpy as np
import pytest
import trimesh

from render.backend import dr, mi
from render.loading import to_mitsuba
from render.stage import Stage
from scenes.animation import Camera, Scene, Shape, Track
from tests.helpers.rendering import first_gbuffer, rgb


def textured_square(bsdf: dict) -> Scene:
    """A unit square visible head-on, with texture coordinates from 0 to 1, v up."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
    mesh = trimesh.Trimesh(np.c_[corners - 0.5, np.zeros(4)], [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=corners)
    fov = np.degrees(2 * np.arctan(0.5 / 4))  # the square fills the image
    camera = Camera(Track.constant([0.0, 0, 4]), Track.constant([0.0, 0, 0]), Track.constant(fov))
    return Scene((Shape("square", mesh, bsdf),), camera)


def reflected(bsdf: dict, count: int = 1 << 17) -> np.ndarray:
    """Share (3,) of light from straight above that Mitsuba's sampling sends back into mirror-like lobes."""
    plugin = mi.load_dict(to_mitsuba(bsdf))
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.wi = mi.Vector3f(0, 0, 1)
    si.t = mi.Float(1)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    random = mi.PCG32(count)
    u = mi.Point2f(random.next_float32(), random.next_float32())
    sample, weight = plugin.sample(mi.BSDFContext(), si, random.next_float32(), u)
    lobe = sample.sampled_type
    mirrored = mi.has_flag(lobe, mi.BSDFFlags.DeltaReflection) | mi.has_flag(lobe, mi.BSDFFlags.GlossyReflection)
    return np.array(dr.select(mirrored & (sample.wo.z > 0), weight, 0)).mean(axis=1)


TINTED = rgb(0.9, 0.5, 0.2)
METAL_BSDFS = [
    {"type": "conductor", "material": "Cu"},
    {"type": "conductor", "material": "none"},
    {"type": "conductor", "eta": rgb(0.2, 0.9, 1.4), "k": rgb(3.0, 2.5, 1.0), "specular_reflectance": TINTED},
    {"type": "roughconductor", "material": "Al", "alpha": 0.02},
    {"type": "roughconductor", "material": "Au", "alpha": 0.05, "specular_reflectance": TINTED},
    {"type": "principled", "base_color": TINTED, "metallic": 1.0, "roughness": 0.1},
]


@pytest.mark.parametrize("bsdf", METAL_BSDFS)
def test_albedo_of_metals_is_what_they_reflect(bsdf):
    albedo = first_gbuffer(textured_square(bsdf), 4, 4)["albedo"]
    np.testing.assert_allclose(albedo, np.broadcast_to(reflected(bsdf), albedo.shape), rtol=0.02)


@pytest.mark.parametrize("bsdf", [{"type": "plastic"}, {"type": "roughplastic", "alpha": 0.05}])
@pytest.mark.parametrize("eta", [1.3, 1.9])
def test_albedo_of_plastics_is_diffuse_plus_specular(bsdf, eta):
    bsdf = {**bsdf, "int_ior": eta, "ext_ior": 1.0, "diffuse_reflectance": rgb(0.1, 0.4, 0.7)}
    albedo = first_gbuffer(textured_square(bsdf), 4, 4)["albedo"][0, 0]
    coat = reflected({**bsdf, "diffuse_reflectance": rgb(0, 0, 0)})
    np.testing.assert_allclose(albedo, np.array([0.1, 0.4, 0.7]) + coat, rtol=0.02)


def test_principled_mixes_by_metallic():
    bsdf = {"type": "principled", "base_color": rgb(0.2, 0.4, 0.6), "metallic": 0.25, "specular": 0.5, "roughness": 0.3}
    buffer = first_gbuffer(textured_square({"type": "twosided", "bsdf": bsdf}), 4, 4)
    base = np.array([0.2, 0.4, 0.6])
    expected = base * 0.75 + (0.08 * 0.5 * 0.75 + base * 0.25)
    np.testing.assert_allclose(buffer["albedo"][0, 0], expected, rtol=1e-5)
    np.testing.assert_allclose(buffer["roughness"], 0.09, rtol=1e-5)


@pytest.mark.parametrize("kind", ["dielectric", "thindielectric", "roughdielectric"])
def test_what_only_transmits_is_white(kind):
    buffer = first_gbuffer(textured_square({"type": kind}), 4, 4)
    assert (buffer["albedo"] == 1).all()
    np.testing.assert_allclose(buffer["roughness"], 0.1 if kind == "roughdielectric" else 0)


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
