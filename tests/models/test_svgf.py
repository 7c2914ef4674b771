"""SVGF and EAW step by step against slow versions in float64 that follow the papers' formulas pixel by pixel."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.bench.synthetic_frames import synthetic_frame
from models.filters import eaw, svgf
from models.filters.eaw import EAW
from models.filters.svgf import SVGF, Integrated
from models.history.accumulation import accumulate
from models.history.geometry import GBuffer
from models.history.running_scale import running_scale
from models.operators import image_luminance
from tests.helpers.frames import play, run
from tests.helpers.windows import window

H = np.array([1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16])
pytestmark = pytest.mark.usefixtures("one_thread")
both_implementations = pytest.mark.usefixtures("implementation")


def surfaces(rng, height, width):
    """Depth, normal and mesh id (numpy, float64) of tilted, rough planes of two meshes beside sky.

    One half of each mesh is farther away; normals are of any length, and some point away.
    """
    y, x = np.mgrid[0:height, 0:width]
    mesh = rng.integers(0, 3, (height // 4 + 1, width // 4 + 1)).repeat(4, 0).repeat(4, 1)[:height, :width]
    plane = 2 + mesh + 1.5 * (x > width // 2) + 0.01 * x - 0.02 * y + 0.005 * rng.random((height, width))
    depth = np.float32(np.where(mesh > 0, plane, 0))
    normal = np.array([0, 0, -1.0])[:, None, None] + 0.1 * rng.standard_normal((3, height, width))
    normal *= rng.choice([1.0, 1.0, 7.0, -1.0], (height, width)) * (mesh > 0)
    return depth.astype(float), np.float32(normal).astype(float), mesh


def to_torch(array, *shape):
    return torch.from_numpy(np.ascontiguousarray(array, np.float32)).view(shape or (1, -1, *array.shape[-2:]))


def packed(depth, normal, mesh):
    return svgf.pack_geometry(to_torch(depth), to_torch(normal), to_torch(mesh.astype(float)))


def level(colour, variance, geometry, step):
    """One level of the à-trous transform."""
    return svgf.svgf_levels(colour, variance, geometry, (step,))[1:]


# --- Slow versions ----------------------------------------------------------------------------------------------------


def naive_slope(depth, mesh, y, x, dy, dx):
    height, width = depth.shape
    slopes = []
    for sign in (1, -1):
        r = y + sign * dy
        c = x + sign * dx
        if 0 <= r < height and 0 <= c < width and mesh[r, c] == mesh[y, x]:
            slopes.append(sign * (depth[r, c] - depth[y, x]))
    return min(slopes, key=abs, default=0.0)


def naive_geometry_weight(depth, normal, mesh, p, q):
    """Eq. 3 and 4, sigma_z = 1, sigma_n = 128."""
    if depth[p] == 0 or depth[q] == 0:
        return 0.0
    gradient = naive_slope(depth, mesh, *p, 0, 1) * (p[1] - q[1]) + naive_slope(depth, mesh, *p, 1, 0) * (p[0] - q[0])
    w_z = math.exp(-abs(depth[p] - depth[q]) / (abs(gradient) + 1e-3 * depth[p]))
    a = normal[:, *p] / np.linalg.norm(normal[:, *p])
    b = normal[:, *q] / np.linalg.norm(normal[:, *q])
    return w_z * max(0.0, a @ b) ** 128


def b3_spline(p, q, step):
    return H[np.subtract(q, p) // step + 2].prod()


def naive_edge_scale(variance, depth, p):
    """sigma_l sqrt(g(Var)) of Eq. 5, sigma_l = 4, of the surfaces around p."""
    g = {q: 2.0 ** -np.abs(np.subtract(p, q)).sum() for q in window(variance.shape, p, 1) if depth[q] > 0}
    return 4 * math.sqrt(sum(w * variance[q] for q, w in g.items()) / sum(g.values())) if g else 1.0


def naive_level(colour, variance, depth, normal, mesh, step):
    """Eq. 1 and the variance's: colour (3, H, W), variance (H, W)."""
    y = np.tensordot([0.2126, 0.7152, 0.0722], colour, 1)
    out = np.zeros_like(colour)
    spread = np.zeros_like(variance)
    for p in np.ndindex(variance.shape):
        total = 0.0
        scale = naive_edge_scale(variance, depth, p)
        for q in window(variance.shape, p, 2, step):
            w = b3_spline(p, q, step)
            if q != p:
                w *= naive_geometry_weight(depth, normal, mesh, p, q) * math.exp(-abs(y[p] - y[q]) / scale)
            total += w
            out[:, *p] += w * colour[:, *q]
            spread[p] += w * w * variance[q]
        out[:, *p] /= total
        spread[p] /= total * total
    return out, spread


def naive_spatial_variance(moments, depth, normal, mesh):
    out = np.zeros(depth.shape)
    for p in np.ndindex(depth.shape):
        total = mean = square = 0.0
        for q in window(depth.shape, p, 3):
            w = 1.0 if q == p else naive_geometry_weight(depth, normal, mesh, p, q)
            total += w
            mean += w * moments[0][q]
            square += w * moments[1][q]
        out[p] = square / total - (mean / total) ** 2
    return out


SIZES = st.tuples(st.integers(1, 11), st.integers(1, 11))
EXAMPLES = settings(max_examples=15, deadline=None)


# --- Temporal filtering (§4.1) and variance (§4.2) --------------------------------------------------------------------


@both_implementations
def test_samples_and_moments_are_accumulated_as_irradiance_is():
    """By C' = α C + (1 - α) C': of direct and indirect light, the colour, its luminance and the square of that."""
    history = None
    expected = [None] * 4
    for frame in (synthetic_frame(index, 24, 32) for index in range(8)):
        samples = svgf.irradiances(frame, "total")
        history = svgf.integrate(frame, samples, history)
        y = [image_luminance(colour) for colour in samples.unbind(1)]
        images = [*samples.unbind(1), *(torch.cat([mean, mean.square(), mean], dim=1) for mean in y)]
        expected = [accumulate(frame, *each) for each in zip(images, expected, strict=True)]
        parts = [*history.colour.unbind(1), *history.moments.unbind(1)]
        for part, accumulated in zip(parts, expected, strict=True):
            torch.testing.assert_close(part, accumulated.irradiance[:, : part.shape[1]])
            torch.testing.assert_close(history.length, accumulated.length)


def integrated(rng, depth, lengths):
    """Random moments of two signals on surfaces of `depth`, with history `lengths` (H, W)."""
    mean = rng.random((2, *depth.shape)) * 3
    square = mean**2 + rng.random(mean.shape)
    moments = to_torch(np.stack([mean, square], axis=1), 1, 2, 2, *depth.shape)
    nothing = torch.zeros(1, 1, *depth.shape)
    where = GBuffer(nothing, nothing, nothing)
    return Integrated(torch.zeros(1, 2, 3, *depth.shape), moments, to_torch(lengths), where)


@EXAMPLES
@given(size=SIZES, seed=st.integers(0, 9999))
@both_implementations
def test_variance_is_temporal_from_four_frames_on_and_spatial_before(size, seed):
    rng = np.random.default_rng(seed)
    depth, normal, mesh = surfaces(rng, *size)
    lengths = rng.choice([1.0, 2.0, 3.0, 3.4, 3.9999998, 4.0, 9.0], size)
    history = integrated(rng, depth, lengths)
    variance = svgf.estimate_variance(history, packed(depth, normal, mesh))[0, :, 0].numpy()
    for s in range(2):
        moments = history.moments[0, s].double().numpy()
        temporal = moments[1] - moments[0] ** 2
        spatial = naive_spatial_variance(moments, depth, normal, mesh) * 4 / np.round(lengths)  # of a few samples
        expected = np.where(lengths < 3.5, spatial, temporal)
        np.testing.assert_allclose(variance[s], expected, rtol=1e-4, atol=1e-5)


# --- The à-trous transform (§4.3) -------------------------------------------------------------------------------------


@EXAMPLES
@given(size=SIZES, step=st.sampled_from([1, 2, 4, 16]), seed=st.integers(0, 9999))
@both_implementations
def test_a_level_is_the_paper_s(size, step, seed):
    rng = np.random.default_rng(seed)
    depth, normal, mesh = surfaces(rng, *size)
    colour = np.float32(rng.random((2, 3, *size)))
    variance = np.float32(rng.random((2, *size)) / 4)
    images = to_torch(colour, 1, 2, 3, *size), to_torch(variance, 1, 2, 1, *size)
    out, spread = level(*images, packed(depth, normal, mesh), step)
    for s in range(2):
        expected = naive_level(colour[s].astype(float), variance[s].astype(float), depth, normal, mesh, step)
        np.testing.assert_allclose(out[0, s].numpy(), expected[0], rtol=1e-4)
        np.testing.assert_allclose(spread[0, s, 0].numpy(), expected[1], rtol=1e-4)


@both_implementations
def test_levels_follow_each_other():
    """Signals of two items of a batch, in an image that is narrower than the last level's window."""
    rng = np.random.default_rng(5)
    depth, normal, mesh = surfaces(rng, 9, 40)
    images = torch.rand(2, 1, 3, 9, 40), torch.rand(2, 1, 1, 9, 40)
    geometry = torch.cat([packed(depth, normal, mesh), packed(depth[::-1], normal[:, ::-1], mesh[::-1])])
    first, last, spread = svgf.svgf_levels(*images, geometry, (1, 2, 16))
    one = level(*images, geometry, 1)
    three = level(*level(*one, geometry, 2), geometry, 16)
    torch.testing.assert_close(first, one[0])
    torch.testing.assert_close((last, spread), three)


def test_five_levels_and_the_first_is_the_history(monkeypatch):
    frame = synthetic_frame(3, 24, 32)
    calls = []
    original = svgf.svgf_levels
    monkeypatch.setattr(
        svgf, "svgf_levels", lambda *inputs: calls.append((inputs[-1], *original(*inputs))) or calls[-1][1:]
    )
    (output,), state = play(SVGF(), [frame])
    ((steps, first, last, _),) = calls
    assert steps == (1, 2, 4, 8, 16)
    assert state.history.colour is first
    torch.testing.assert_close(output, frame.emission + last.sum(dim=1) * frame.albedo.clamp(min=0.01))
    assert [*state.pictures()] == ["history length", "variance direct", "variance indirect"]


# --- EAW --------------------------------------------------------------------------------------------------------------


@EXAMPLES
@given(size=SIZES, step=st.sampled_from([1, 2, 8]), seed=st.integers(0, 9999))
@both_implementations
def test_a_level_of_eaw(size, step, seed):
    rng = np.random.default_rng(seed)
    colour = np.float32(rng.random((3, *size)))
    features = np.float32(rng.random((9, *size)))
    out = eaw.eaw_level(to_torch(colour), to_torch(features), step)[0].numpy()
    for p in np.ndindex(size):
        total = 0.0
        sums = np.zeros(3)
        for q in window(size, p, 2, step):
            w = b3_spline(p, q, step) * math.exp(-np.square(features[:, *p] - features[:, *q]).sum())
            total += w
            sums += w * colour[:, *q]
        np.testing.assert_allclose(out[:, *p], sums / total, rtol=1e-5)


def test_eaw_s_features(monkeypatch):
    """Exposed colour over σ_c, which halves from level to level; normal; position over the median depth."""
    frame = synthetic_frame(2, 20, 30)
    calls = []
    monkeypatch.setattr(eaw, "eaw_level", lambda colour, features, step: calls.append((features, step)) or colour)
    run(EAW(), [frame])
    irradiance = frame.irradiance("total")
    exposure = running_scale(irradiance * frame.divisor, frame.depth, None).exposure()
    assert [step for _, step in calls] == [1, 2, 4, 8, 16]
    median = frame.depth[frame.depth > 0].median()
    hit = (frame.depth > 0)[0, 0]
    for level, (features, _) in enumerate(calls):
        torch.testing.assert_close(features[:, :3], irradiance * exposure * 2**level / eaw.SIGMA_COLOUR)
        torch.testing.assert_close(features[:, 3:6], frame.normal / eaw.EAW_SIGMA_NORMAL)
        positions = features[0, 6:] * eaw.SIGMA_POSITION * median
        torch.testing.assert_close(positions[2, hit], frame.depth[0, 0, hit], rtol=0.02, atol=0)
        # Projected back, positions are where their pixels are.
        pixel = torch.einsum("ij,jn->in", frame.now.K[0].float(), positions[:, hit])
        y, x = torch.nonzero(hit, as_tuple=True)
        torch.testing.assert_close(pixel[0] / pixel[2], x + 0.5, rtol=1e-4, atol=1e-3)
        torch.testing.assert_close(pixel[1] / pixel[2], y + 0.5, rtol=1e-4, atol=1e-3)
        assert (features[0, 6:, ~hit] == eaw.BACKGROUND_POSITION).all()
