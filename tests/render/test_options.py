"""The papers' options: Halton cycles are unbiased; regularised paths are biased by glossy things and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from render.backend import mi
from render.clip import Options, Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.regularise import BlurredTable, blurred
from render.sampler import CYCLE
from render.stage import Stage
from scenes.animation import StockShape, frozen
from scenes.cornell import repaint
from scenes.registry import build_scene
from tests.helpers.rendering import POSED_FRAME, assert_same_mean, rgb, stock_images


@pytest.mark.slow
def test_every_point_of_the_halton_cycle_is_unbiased(stage, rays):
    tracer = PathTracer(stage, halton=True)
    images = np.stack([np.add(*tracer.radiance(rays, seed, 1, first=seed)) for seed in range(50 * CYCLE)])
    emission = render_gbuffer(stage, stage.view(POSED_FRAME))["emission"]
    assert_same_mean(emission + images, stock_images(stage, 3, 30))


@pytest.mark.slow
def test_a_halton_cycle_is_less_noisy_than_independent_frames(stage, rays):
    halton, owen = PathTracer(stage, halton=True), PathTracer(stage)
    truth = np.add(*owen.radiance(rays, 999, 2048))
    cycles = [np.mean([np.add(*halton.radiance(rays, s, 1, first=f)) for f in range(CYCLE)], axis=0) for s in range(4)]
    seeds = [range(1000 * s, 1000 * s + CYCLE) for s in range(4)]
    independent = [np.mean([np.add(*owen.radiance(rays, seed, 1)) for seed in each], axis=0) for each in seeds]
    errors = [np.mean((np.stack(images) - truth) ** 2) for images in (cycles, independent)]
    assert errors[0] < 0.8 * errors[1]


@pytest.mark.slow
def test_a_clip_walks_through_the_cycle():
    scene = frozen(build_scene("cornell_box", 3, 2))
    frames = [arrays for arrays, _ in render_clip(scene, CYCLE + 2, 16, 16, Sampling(2, 1, 8, Options(halton=True)), 1)]
    for frame in (0, 1):
        assert np.array_equal(frames[frame]["direct"], frames[frame + CYCLE]["direct"])
        assert not np.array_equal(frames[frame]["direct_reference"], frames[frame + CYCLE]["direct_reference"])
    assert not np.array_equal(frames[0]["direct"], frames[1]["direct"])
    assert not np.array_equal(frames[0]["direct"][0], frames[0]["direct"][1])


def test_rarely_sampled_lights_change_noisy_frames_alone():
    scene = build_scene("cornell_box", 3, 2)
    often, rarely = ([a for a, _ in render_clip(scene, 2, 16, 16, Sampling(1, 1, 8, rarity=r), 1)] for r in (1, 9))
    for one, other in zip(often, rarely, strict=True):
        changed = {name for name in one if not np.array_equal(one[name], other[name])}
        assert {"direct", "indirect"} <= changed
        assert not changed & {"direct_reference", "indirect_reference", "emission"}


@pytest.mark.slow
def test_regularisation_changes_nothing_where_nothing_is_glossy(stage, rays):
    plain = PathTracer(stage).radiance(rays, 1, 4)
    regular = PathTracer(stage, regularise=True).radiance(rays, 1, 4)
    assert all(np.array_equal(a, b) for a, b in zip(plain, regular, strict=True))


@pytest.mark.slow
def test_regularisation_trades_bias_for_noise():
    """Direct light is untouched. Indirect light has less variance, and a bias of a few percent.

    In the Cornell box with blocks of rough metal: they throw blurred reflections of the light on floor and walls.
    """
    metal = {"type": "roughconductor", "material": "Ag", "alpha": 0.05}
    scene = repaint(build_scene("cornell_box", 3, 24), lambda s: metal if "block" in s.name else s.bsdf)
    glossy = Stage(scene, 64, 64)
    glossy.pose(POSED_FRAME)
    ray = glossy.rays(glossy.view(POSED_FRAME))
    plain, regular = (
        np.stack([PathTracer(glossy, regularise=r).radiance(ray, seed, 64) for seed in range(8)]).astype(float)
        for r in (False, True)
    )
    assert np.array_equal(plain[:, 0], regular[:, 0])
    noise = [images[:, 1].var(axis=0, ddof=1).mean() for images in (plain, regular)]
    assert noise[1] < 0.7 * noise[0]
    bias = regular[:, 1].mean() / plain[:, 1].mean() - 1
    assert 1e-4 < abs(bias) < 0.1


def test_blurred_materials_are_rough_and_others_unchanged():
    rgb = {"type": "rgb", "value": [0.1, 0.2, 0.3]}
    assert blurred({"type": "diffuse", "reflectance": rgb}) == {"type": "diffuse", "reflectance": rgb}
    gold = blurred({"type": "conductor", "material": "Au"})
    assert gold == {"type": "roughconductor", "material": "Au", "alpha": 0.3}
    assert blurred({"type": "roughplastic", "alpha": 0.4})["alpha"] == 0.4
    nested = blurred({"type": "twosided", "bsdf": {"type": "principled", "roughness": 0.1}})
    assert nested["bsdf"]["roughness"] == pytest.approx(0.3**0.5)
    ramp = np.linspace(0, 1, 16).reshape(4, 4, 1)
    rough = blurred({"type": "roughconductor", "alpha": {"type": "bitmap", "data": ramp}})
    np.testing.assert_array_equal(rough["alpha"]["data"], np.maximum(ramp, 0.3))
    assert blurred({"type": "roughconductor", "alpha": {"type": "bitmap", "filename": "a.png"}})["alpha"] == 0.3
    brushed = {"type": "roughconductor", "alpha_u": 0.05, "alpha_v": 0.5}
    assert blurred(brushed) == {"type": "roughconductor", "alpha_u": 0.3, "alpha_v": 0.5}


def test_a_material_with_a_property_of_another_renderer_is_blurred():
    """As it is loaded: without what Mitsuba does not have."""
    bsdf = {"type": "roughplastic", "alpha": 0.1, "shininess": 3.0}
    shape = StockShape("ball", {"type": "sphere"}, {"type": "twosided", "bsdf": bsdf})
    stage = Stage(replace(build_scene("cornell_box", 0, 2), stock=(shape,)), 8, 8)
    assert len(BlurredTable(stage).bsdfs) == len(stage.bsdfs) and "shininess" in stage.notes[0]


def test_materials_are_blurred_at_any_depth():
    """Whatever they are nested in; what is not glossy there stays as it is."""
    checks = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}

    def material(kind, **roughness):
        metal = {"type": kind, "material": "Au", **roughness}
        relief = {"type": "bumpmap", "texture": checks, "bsdf": metal}
        shaded = {"type": "normalmap", "normalmap": checks, "bsdf": metal}
        blend = {"type": "blendbsdf", "weight": checks, "a": relief, "b": shaded}
        return {"type": "twosided", "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": blend}}

    assert blurred(material("conductor")) == material("roughconductor", alpha=0.3)
    assert blurred(material("roughconductor", alpha=0.1)) == material("roughconductor", alpha=0.3)
    assert blurred(material("diffuse")) == material("diffuse")


def stage_with_instance(bsdf):
    """The Cornell box and a ball that is an instance."""
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.5, **({"bsdf": bsdf} if bsdf else {})}}
    ball = StockShape("ball", {"type": "instance", "group": group, "to_world": np.eye(4)}, None)
    box = build_scene("cornell_box", 3, 2)
    return Stage(replace(box, stock=(*box.stock, ball)), 32, 32)


BALLS = pytest.mark.parametrize("bsdf", [None, {"type": "diffuse", "reflectance": rgb(0.9, 0.1, 0.1)}])


@BALLS
def test_instances_keep_their_material(bsdf):
    stage = stage_with_instance(bsdf)
    si = stage.mitsuba_scene.ray_intersect(stage.rays(stage.view(0)))
    table = BlurredTable(stage)
    bsdfs = (si.bsdf(), table.after_first(si, mi.UInt32(2)))
    colours = [stage.image(bsdf.eval_diffuse_reflectance(si)) for bsdf in bsdfs]
    assert np.array_equal(*colours)
    assert np.isclose(colours[0], bsdf["reflectance"]["value"] if bsdf else 0.5).all(axis=-1).sum() > 50


@pytest.mark.slow
@BALLS
def test_instances_of_diffuse_balls_keep_their_light(bsdf):
    stage = stage_with_instance(bsdf)
    ray = stage.rays(stage.view(0))
    plain, regular = (PathTracer(stage, regularise=r).radiance(ray, 1, 16) for r in (False, True))
    assert all(np.array_equal(a, b) for a, b in zip(plain, regular, strict=True))


def test_relief_of_tiny_scenes_is_that_of_their_own_materials():
    relief = {"type": "bitmap", "raw": True, "data": np.random.default_rng(0).random((4, 4, 1), np.float32)}
    material = {"type": "bumpmap", "texture": relief, "scale": 1e-3, "bsdf": {"type": "roughplastic", "alpha": 0.1}}
    ball = StockShape("ball", {"type": "sphere", "radius": 1e-3, "to_world": np.eye(4)}, material)
    stage = Stage(replace(build_scene("cornell_box", 0, 1), shapes=(), stock=(ball,)), 8, 8)
    own, table = (
        [mi.traverse(bsdf)["scale"] for bsdf in each if bsdf.class_name() == "BumpMap"]
        for each in (stage.bsdfs.values(), BlurredTable(stage).bsdfs)
    )
    assert stage.unit < 0.1 and own == table


def test_materials_of_instances_are_blurred():
    table = BlurredTable(stage_with_instance({"type": "conductor"}))
    assert [bsdf.class_name() for bsdf in table.bsdfs].count("RoughConductor") == 1
