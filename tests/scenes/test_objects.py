"""Things stand as described, are closed unless they are sheets, and keep the space above their supports free."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.furnishing import DECOR, FURNITURE, GLAZING
from scenes.meshes import blob, circle, disc, gem, hollow, lathe, leaf, silhouette, slab, solid, superellipsoid, tube
from scenes.objects.fittings import make_blind, make_curtain, make_pendant, make_picture
from scenes.objects.thing import Thing
from tests.helpers.scenes import SEEDS

STANDING = {maker.__name__.removeprefix("make_"): maker for maker in (*FURNITURE, *DECOR, *GLAZING)}
HANGING = {"picture": make_picture, "pendant": make_pendant}
HANGING |= {"blind": lambda rng: make_blind(rng, 1.2, 1.4), "curtain": lambda rng: make_curtain(rng, 1.1, 2.3)}
THIN = ("leaf", "shade", "print", "fabric")  # sheets rather than bodies, in some things


def build(maker, seed) -> Thing:
    return maker(np.random.default_rng(seed))


def vertices(thing):
    return np.concatenate([surface.points for surface in thing.parts.values()])


def is_closed(mesh):
    """Whether every edge is run through as often one way as the other, with volume inside; bodies may touch."""
    _, index = np.unique(mesh.vertices.round(9), axis=0, return_inverse=True)
    edges = index.ravel()[mesh.edges]
    _, edge = np.unique(np.sort(edges, axis=1), axis=0, return_inverse=True)
    balance = np.bincount(edge.ravel(), np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return not balance.any() and mesh.volume > 0


def shading_agreement(mesh):
    """Smallest cosine between a triangle's normal and those of its corners."""
    return np.einsum("fi,fki->fk", mesh.face_normals, mesh.vertex_normals[mesh.faces]).min()


@settings(max_examples=4)
@given(seed=SEEDS)
@pytest.mark.parametrize("name", [*STANDING, *HANGING])
def test_every_thing(name, seed):
    maker = {**STANDING, **HANGING}[name]
    thing, same, other = (build(maker, each) for each in (seed, seed, seed + 1))
    assert thing.name == name and np.array_equal(vertices(thing), vertices(same))
    assert vertices(thing).shape != vertices(other).shape or not np.allclose(vertices(thing), vertices(other))
    assert 0 < sum(len(surface.faces) for surface in thing.parts.values()) < 6000
    for slot, surface in thing.parts.items():
        mesh = surface.mesh()
        assert mesh.visual.uv.shape == (len(mesh.vertices), 2) and np.isfinite(mesh.visual.uv).all()
        assert np.linalg.norm(mesh.vertex_normals, axis=1) == pytest.approx(1)
        assert (mesh.area_faces > 0).all()
        assert shading_agreement(mesh) > (0.05 if surface.smooth else 0.999), slot
        if slot not in THIN:
            assert is_closed(mesh), slot


@settings(max_examples=6)
@given(seed=SEEDS)
@pytest.mark.parametrize("name", STANDING)
def test_stands_centred_and_leaves_its_supports_free(name, seed):
    thing = build(STANDING[name], seed)
    low, high = thing.bounds
    weights = np.random.default_rng(0).dirichlet([0.5] * 3, 40)  # so that large faces count and not only their corners
    points = np.concatenate([(weights @ part.points[part.faces]).reshape(-1, 3) for part in thing.parts.values()])
    assert np.array_equal([low, high], [vertices(thing).min(axis=0), vertices(thing).max(axis=0)])
    assert low[1] == pytest.approx(0, abs=1e-9)
    assert low[[0, 2]] == pytest.approx(-high[[0, 2]], abs=1e-9)
    if STANDING[name] in DECOR:
        assert 0.01 < (high - low).max() <= 0.55
    else:
        assert 0.3 < (high - low).max() < 3
    for support in thing.supports:
        at_low, at_high = support[:, [0, 2]]
        height, ceiling = support[:, 1]
        assert (at_low < at_high).all() and ceiling > height + 0.1
        assert (at_low >= low[[0, 2]]).all() and (at_high <= high[[0, 2]]).all()
        assert 0 < height <= high[1] + 1e-9
        beside = ((points[:, [0, 2]] <= at_low) | (points[:, [0, 2]] >= at_high)).any(axis=1)
        y = points[:, 1] - height
        assert (beside | (y <= 1e-6) | (y >= ceiling - height - 1e-6)).all()
        assert np.abs(y[~beside]).min() < 1e-4  # something is there to stand on


def test_furniture_offers_supports():
    for name in ("table", "shelf", "cabinet", "desk", "bench", "column"):
        assert build(STANDING[name], 1).supports, name
    assert len(build(STANDING["shelf"], 1).supports) > 2


@settings(max_examples=10)
@given(seed=SEEDS, width=st.floats(0.5, 2.5), height=st.floats(0.6, 2.6))
def test_window_dressings_fit(seed, width, height):
    for maker, thickness in ((make_blind, 0.03), (make_curtain, 0.45)):
        low, high = maker(np.random.default_rng(seed), width, height).bounds
        assert [-low[0], high[0]] == pytest.approx([width / 2] * 2) and low[1] == pytest.approx(0, abs=1e-9)
        assert high[1] == pytest.approx(height) and max(-low[2], high[2]) < thickness


def test_picture_hangs_on_a_wall():
    thing = build(make_picture, 3)
    assert thing.bounds[0, 1:] == pytest.approx(0, abs=1e-9)
    front = thing.parts["print"].mesh()
    np.testing.assert_allclose(front.vertex_normals, np.broadcast_to([0, 0, 1.0], front.vertices.shape), atol=1e-12)
    assert front.visual.uv.min() == 0 and front.visual.uv.max() == 1


RNG = np.random.default_rng(0)
BODIES = {
    "slab": (slab(1, 2, 3), 6.0),
    "lying slab": (slab(1, 2, 3).turned(0.7, axis=0).at(1, 2, 3), 6.0),
    "ball": (superellipsoid(2, 2, 2, 2, 4), 4 / 3 * np.pi),
    "torus": (lathe(circle(1, 0.3, 64), 128), 2 * np.pi**2 * 0.3**2),
    "cylinder": (lathe(solid([(0.5, 0), (0.5, 2)]), 256), np.pi / 2),
    "vessel": (lathe(hollow(np.array([(0.5, 0), (0.5, 0.2), (0.5, 1)]), 0.1, 0.199), 256), np.pi * (0.25 - 0.16 * 0.8)),
    "tube": (tube([(0, 0, 0), (1, 1, 1)], 0.1, 128), np.pi * 0.01 * np.sqrt(3)),
    "disc": (disc(0.5, 0.02, 128), np.pi / 4 * 0.02),
    "blob": (blob(RNG, 0.1, 0.2, 3), None),
    "gem": (gem(RNG, 0.1, 1), None),
    "stem": (tube([(0, 0, 0), (0, 0.5, 0), (0.2, 0.8, 0.1), (0.5, 0.9, 0.3)], [0.03, 0.02, 0.02, 0.01]), None),
    "vase": (lathe(hollow(silhouette([0.05, 0.12, 0.04, 0.08], 0.3), 0.005, 0.01)), None),
}


@pytest.mark.parametrize("name", BODIES)
def test_bodies_are_closed_with_outward_normals(name):
    surface, volume = BODIES[name]
    mesh = surface.mesh()
    assert is_closed(mesh)
    if volume is not None:
        assert mesh.volume == pytest.approx(volume, rel=0.02)
    assert np.linalg.norm(mesh.vertex_normals, axis=1) == pytest.approx(1)
    assert shading_agreement(mesh) > 0.6


def test_lathe_is_exact_on_a_sphere():
    """Normals and texture of a turned sphere are those of the sphere; sharp edges of a cylinder stay sharp."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 33)
    profile = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    profile[[0, -1], 0] = 0
    ball = lathe(profile, 64)
    used = np.unique(ball.faces)
    np.testing.assert_allclose(ball.normals[used], ball.points[used], atol=1e-9)
    np.testing.assert_allclose(ball.uv[used, 1] * 2 * np.pi / 6, np.arcsin(ball.points[used, 1]) + np.pi / 2, rtol=2e-3)
    assert ball.uv[:, 0].min() == 0 and ball.uv[:, 0].max() == 6  # a whole number of metres around the seam
    assert set(np.unique(lathe(solid([(1, 0), (1, 1)])).normals[:, 1].round(9))) == {-1, 0, 1}


def test_slab_is_textured_by_the_metre():
    mesh = slab(1, 2, 3).mesh()
    edges = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, 1, axis=1)]
    on_texture = mesh.visual.uv[mesh.faces] - mesh.visual.uv[np.roll(mesh.faces, 1, axis=1)]
    np.testing.assert_allclose(np.linalg.norm(edges, axis=2), np.linalg.norm(on_texture, axis=2), atol=1e-12)


def test_leaf_is_thin_and_looks_up():
    t = np.linspace(0, 1, 8)
    surface = leaf(np.stack([t, 0.5 * t - 0.4 * t**2, 0 * t], axis=1), 0.2, 0.3)
    assert (surface.normals[:, 1] > 0).all()
    assert np.ptp(surface.points[:, 2]) == pytest.approx(0.2, rel=0.05)
    assert not trimesh.Trimesh(surface.points, surface.faces).is_watertight
