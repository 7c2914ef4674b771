"""SVGF and EAW step by step against slow versions in float64 that follow the papers' formulas pixel by pixel."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.bench.synthetic_frames import synthetic_frame
from models.filters import eaw, svgf
from models.filters.baselines import Accumulated
from models.filters.bmfr import BMFR
from models.filters.eaw import EAW
from models.filters.svgf import SVGF, Integrated
from models.history.geometry import GBuffer
from models.history.running_scale import running_scale
from tests.helpers.frames import flat_frame, play, run

H = np.array([1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16])
pytestmark = pytest.mark.usefixtures("one_thread")
both_implementations = pytest.mark.usefixtures("implementation")


def surfaces(rng, height, width):
    """Depth, normal and mesh id (numpy, float64) of tilted, rough planes of two meshes beside sky."""
    y, x = np.mgrid[0:height, 0:width]
    mesh = rng.integers(0, 3, (height // 4 + 1, width // 4 + 1)).repeat(4, 0).repeat(4, 1)[:height, :width]
    depth = np.float32(np.where(mesh > 0, 2 + mesh + 0.01 * x - 0.02 * y + 0.005 * rng.random((height, width)), 0))
    normal = np.array([0, 0, -1.0])[:, None, None] + 0.1 * rng.standard_normal((3, height, width))
    return depth.astype(float), np.float32(normal * (mesh > 0)).astype(float), mesh


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


def window(p, size, radius, step=1):
    """Pixels q in the image with their offsets in steps, p included."""
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            q = p[0] + j * step, p[1] + i * step
            if 0 <= q[0] < size[0] and 0 <= q[1] < size[1]:
                yield q, j, i


def naive_edge_scale(variance, depth, p):
    """sigma_l sqrt(g(Var)) of Eq. 5, sigma_l = 4, of the surfaces around p."""
    g = {q: 2.0 ** -(abs(j) + abs(i)) for q, j, i in window(p, variance.shape, 1) if depth[q] > 0}
    return 4 * math.sqrt(sum(w * variance[q] for q, w in g.items()) / sum(g.values())) if g else 1.0


def naive_level(colour, variance, depth, normal, mesh, step):
    """Eq. 1 and the variance's: colour (3, H, W), variance (H, W)."""
    y = np.tensordot([0.2126, 0.7152, 0.0722], colour, 1)
    out = np.zeros_like(colour)
    spread = np.zeros_like(variance)
    for p in np.ndindex(variance.shape):
        total = 0.0
        scale = naive_edge_scale(variance, depth, p)
        for q, j, i in window(p, variance.shape, 2, step):
            w = H[j + 2] * H[i + 2]
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
        total = 0.0
        mean = 0.0
        square = 0.0
        for q, _, _ in window(p, depth.shape, 3):
            w = 1.0 if q == p else naive_geometry_weight(depth, normal, mesh, p, q)
            total += w
            mean += w * moments[0][q]
            square += w * moments[1][q]
        out[p] = square / total - (mean / total) ** 2
    return out


SIZES = st.tuples(st.integers(1, 11), st.integers(1, 11))
EXAMPLES = settings(max_examples=15, deadline=None)


# --- Temporal filtering (§4.1) and variance (§4.2) --------------------------------------------------------------------


def wall(direct, indirect, **kwargs):
    """A flat wall's 4 x 6 frame with grey direct and indirect irradiance."""
    frame = flat_frame(4, 6, irradiance=torch.full((1, 3, 4, 6), direct), **kwargs)
    frame.channels["indirect"] = torch.full((1, 3, 4, 6), indirect)
    return frame


def test_samples_and_moments_are_means_and_later_integrated_with_alpha_a_fifth():
    """C' = α C + (1 - α) C' with α = max(1/5, 1/n) for the n-th sample: of colour, luminance and its square alike."""
    values = [(3.0, 1.0), (1.0, 2.0), (4.0, 0.0), (1.0, 7.0), (2.0, 2.0), (9.0, 1.0), (0.0, 3.0)]
    history = None
    expected = None
    for n, both in enumerate(values):
        frame = wall(*both)
        history = svgf.integrate(frame, svgf.irradiances(frame, "total"), history)
        new = np.array([(v, v, v * v) for v in both])
        alpha = max(0.2, 1 / (n + 1))
        expected = new if expected is None else alpha * new + (1 - alpha) * expected
        for s in range(2):
            torch.testing.assert_close(history.colour[0, s], torch.full((3, 4, 6), expected[s, 0]))
            torch.testing.assert_close(history.moments[0, s, 0], torch.full((4, 6), expected[s, 1]))
            torch.testing.assert_close(history.moments[0, s, 1], torch.full((4, 6), expected[s, 2]))
        assert (history.length == n + 1).all()


def test_disoccluded_pixels_begin_with_their_sample():
    mesh = torch.ones(1, 1, 4, 6)
    mesh[..., 3:] = 2
    before = wall(5.0, 5.0, mesh_id=mesh)
    history = svgf.integrate(before, svgf.irradiances(before, "total"), None)._replace(length=torch.full_like(mesh, 7))
    frame = wall(2.0, 1.0)
    now = svgf.integrate(frame, svgf.irradiances(frame, "total"), history)
    # Column 3 has mesh 1 beside it, within the 3 x 3 box of the second try.
    assert (now.length[..., 4:] == 1).all() and (now.length[..., :4] == 8).all()
    assert (now.colour[0, 0, ..., 4:] == 2).all() and (now.moments[0, 1, :, :, 4:] == 1).all()
    torch.testing.assert_close(now.colour[0, 0, ..., :4], torch.full((3, 4, 4), 0.2 * 2 + 0.8 * 5))


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


# --- Edge-stopping functions (§4.4) -----------------------------------------------------------------------------------


def weight(geometry, p, dy, dx):
    """w_z · w_n between p and p + (dy, dx)."""
    y, x = p
    here = geometry[..., y : y + 1, x : x + 1]
    there = geometry[..., y + dy : y + dy + 1, x + dx : x + dx + 1]
    return svgf.geometry_weight(here, there, dx, dy).item()


def plane(height, width, across=0.0, down=0.0):
    y, x = np.mgrid[0:height, 0:width]
    depth = 50 + across * x + down * y
    return depth, np.array([0, 0, -1.0])[:, None, None] * np.ones_like(depth), np.ones((height, width))


@pytest.mark.parametrize("across, down", [(3.0, 0.0), (0.0, -2.0), (2.0, 1.0), (-1.0, 3.0)])
@both_implementations
def test_on_a_tilted_plane_the_depth_weight_is_1_over_e(across, down):
    """|z(p) - z(q)| is what ∇z · (p - q) expects: w_z = exp(-1), but for ε."""
    geometry = packed(*plane(9, 9, across, down))
    for dy, dx in [(0, 1), (2, 0), (-3, 4), (-1, -1), (4, 3)]:
        expected = abs(across * dx + down * dy)
        z = geometry[0, 0, 3, 4, 4].item()
        assert weight(geometry, (4, 4), dy, dx) == pytest.approx(math.exp(-expected / (expected + 1e-3 * z)), rel=1e-4)


@both_implementations
def test_a_wall_that_faces_the_camera_is_one_surface_and_a_step_in_depth_an_edge():
    depth, normal, mesh = plane(5, 8)
    assert weight(packed(depth, normal, mesh), (2, 2), 2, -2) == pytest.approx(1, abs=1e-4)
    depth[:, 4:] += 2
    same_mesh = packed(depth, normal, mesh)
    other_mesh = packed(depth, normal, mesh + (np.arange(8) > 3))
    for geometry in (same_mesh, other_mesh):  # the slope is that to the neighbour nearer in depth
        for x, dx in [(3, 1), (4, -1), (2, 3)]:
            assert weight(geometry, (2, x), 0, dx) < 1e-10
        assert weight(geometry, (2, 3), 0, -2) == pytest.approx(1, abs=1e-4)


@both_implementations
def test_slopes_ignore_other_meshes_and_the_outside():
    depth, normal, mesh = plane(1, 4, across=1.0)
    mesh[0] = [1, 1, 2, 0]
    depth[0] = [5, 6, 100, 0]
    geometry = packed(depth, normal, mesh)[0, 0]
    assert geometry[4, 0].tolist() == [1, 1, 0, 0]
    assert geometry[5, 0].tolist() == [0, 0, 0, 0]


@pytest.mark.parametrize("degrees", [0, 3, 8, 90, 180])
@both_implementations
def test_normals_weigh_by_the_128th_power_of_their_cosine(degrees):
    depth, normal, mesh = plane(1, 2)
    angle = math.radians(degrees)
    normal[:, 0, 1] = 7 * np.array([math.sin(angle), 0, -math.cos(angle)])  # of any length
    assert weight(packed(depth, normal, mesh), (0, 0), 0, 1) == pytest.approx(max(0, math.cos(angle)) ** 128, rel=1e-3)


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


# --- The whole --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("denoiser, share", [(SVGF, 0.3), (EAW, 0.3), (BMFR, 0.02)])
def test_noise_on_a_wall_is_gone(denoiser, share):
    """Of the error after accumulation alone."""
    generator = torch.Generator().manual_seed(0)
    lights = [4.0 * (torch.rand(1, 1, 48, 30, generator=generator) < 0.25).repeat(1, 3, 1, 1) for _ in range(8)]
    frames = [flat_frame(48, 30, irradiance=light) for light in lights]
    filtered, accumulated = ((run(d, frames)[-1] - 1).square().mean() for d in (denoiser(), Accumulated()))
    assert filtered < share * accumulated


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
        for q, j, i in window(p, size, 2, step):
            w = H[j + 2] * H[i + 2] * math.exp(-np.square(features[:, *p] - features[:, *q]).sum())
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
