"""Light by way of mirrors and glass: Fresnel's equations, no noise, and the mean of Mitsuba's stock integrator."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from render.clip import Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes.animation import Camera, Scene, Shape, Track
from scenes.camera import directions, pixel_centres
from scenes.colours import Bsdf
from scenes.registry import build_scene
from tests.helpers.mirrors import SILVER, mirror, panel, placed
from tests.helpers.rendering import assert_same_mean, first_gbuffer, rgb, stock_images
from tests.render.test_path import realisations

SIZE = 33  # px
ASIDE = (0.37, 0.11)  # so that no ray passes between the two triangles of a square
LAMP = np.array([60.0, 30.0, 10.0])
THIN: Bsdf = {"type": "thindielectric", "int_ior": 1.5, "ext_ior": 1.0}
GLASS: Bsdf = {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}
GOLD: Bsdf = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.9, 0.6, 0.3)}
BLACK: Bsdf = {"type": "diffuse", "reflectance": rgb(0, 0, 0)}


def lamp(z: float) -> Shape:
    """A square that fills the view in the plane z, and shines towards the origin."""
    mesh = panel(20, 20)
    if z > 0:
        mesh.invert()
    return Shape("lamp", placed(mesh, [*ASIDE, z]), BLACK, radiance=Track.constant(LAMP))


def pane(z: float, bsdf: Bsdf = THIN) -> Shape:
    return Shape(f"pane {10 * z:.0f}", placed(panel(20, 20), [*ASIDE, z]), bsdf)


def slab(z: float) -> Shape:
    return Shape(f"slab {z:.0f}", placed(trimesh.creation.box([50, 50, 0.1]), [*ASIDE, z]), GLASS)


def scene_of(*shapes: Shape, max_depth: int = 12) -> Scene:
    """A camera at z = 4 looks at the origin."""
    camera = Camera(Track.constant([0.0, 0, 4]), Track.constant([0.0, 0, 0]), Track.constant(40.0))
    return Scene(shapes, camera, max_depth=max_depth)


def fresnel(cosine: np.ndarray, eta: float) -> np.ndarray:
    """Reflectance of unpolarised light at a dielectric (Fresnel's equations)."""
    inside = np.sqrt(1 - (1 - cosine**2) / eta**2)
    parallel = (eta * cosine - inside) / (eta * cosine + inside)
    perpendicular = (cosine - eta * inside) / (cosine + eta * inside)
    return (parallel**2 + perpendicular**2) / 2


def reflectances(stage: Stage) -> tuple[np.ndarray, np.ndarray]:
    """Of a surface of glass and of a thin pane, for each pixel (H, W)."""
    towards = directions(pixel_centres(stage.height, stage.width), stage.view(0))
    single = fresnel(-towards[..., 2] / np.linalg.norm(towards, axis=-1), 1.5)
    return single, 2 * single / (1 + single)


def through(reflected: np.ndarray) -> np.ndarray:
    """What two surfaces transmit in eight events: directly, and after 1 to 3 pairs of reflections between them."""
    return (1 - reflected) ** 2 * sum(reflected ** (2 * pairs) for pairs in range(4))


CASES = {
    "in a mirror": ((pane(0, SILVER), lamp(6)), lambda single, thin: 1 + 0 * thin),
    "in a pane": ((pane(0), lamp(6)), lambda single, thin: thin),
    "behind a pane": ((pane(0), lamp(-2)), lambda single, thin: 1 - thin),
    "behind two": ((pane(0), pane(0.5), lamp(-2)), lambda single, thin: through(thin)),
    "behind a slab": ((slab(0), lamp(-2)), lambda single, thin: through(single)),
}


def case_of(name):
    return pytest.param(*CASES[name], id=name, marks=[pytest.mark.slow] * (name != "in a mirror"))


@pytest.mark.parametrize(("shapes", "share"), [case_of(case) for case in CASES])
def test_a_lamp_is_as_free_of_noise_as_one_seen_directly(shapes, share):
    """In a black room nothing remains to be sampled, but for reflections back and forth that are too weak to follow."""
    scene = scene_of(*shapes)
    stage = Stage(scene, SIZE, SIZE)
    (frame, _), *_ = render_clip(scene, 1, SIZE, SIZE, Sampling(1, 16, 2), seed=1)
    expected = share(*reflectances(stage))[..., None] * LAMP
    np.testing.assert_allclose(frame["emission"], expected, rtol=2e-4)
    assert (frame["direct"] + frame["indirect"]).max() == 0


def test_mirrors_tint_light():
    emission = first_gbuffer(scene_of(pane(0, mirror(0.9, 0.6, 0.3)), lamp(6)), SIZE, SIZE)["emission"]
    np.testing.assert_allclose(emission, np.broadcast_to(LAMP * [0.9, 0.6, 0.3], emission.shape), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("regularise", [False, True])
def test_paths_that_are_too_short_show_no_light(regularise):
    """As in Mitsuba: paths of three segments do not get through a slab and two surfaces more."""
    stage = Stage(scene_of(slab(0), slab(1), lamp(-2), max_depth=3), SIZE, SIZE)
    assert render_gbuffer(stage, stage.view(0), regularise)["emission"].max() == 0


@pytest.mark.parametrize("max_depth", [4, pytest.param(12, marks=pytest.mark.slow)])
def test_the_mean_is_that_of_the_stock_integrator(max_depth):
    """Of a Cornell box with a ball of tinted glass, a varnished floor, two mirrors and half a mirror."""
    box = build_scene("cornell_box", 3, 24)
    paint = {
        "floor": {"type": "twosided", "bsdf": {"type": "plastic"}},
        "back": {"type": "twosided", "bsdf": GOLD},
        "red-wall": SILVER,
        "tall-block": {"type": "mask", "opacity": 0.5, "bsdf": {"type": "twosided", "bsdf": GOLD}},
    }
    assert paint.keys() < {shape.name for shape in box.shapes}
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    glass = {"type": "dielectric", "specular_transmittance": rgb(0.9, 0.7, 0.5)}
    shapes = tuple(replace(shape, bsdf=paint.get(shape.name, shape.bsdf)) for shape in box.shapes)
    ball = Shape("ball", placed(ball, [0.4, -0.2, 0.6]), glass, smooth=True)
    stage = Stage(replace(box, shapes=(*shapes, ball), max_depth=max_depth), 32, 32)
    emission, direct, indirect = realisations(stage, 300)
    assert_same_mean(emission + direct + indirect, stock_images(stage, max_depth, 40))
