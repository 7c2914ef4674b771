"""AAF: widths against similar triangles, and its two passes against Gaussians in float64."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from datasets.channels import HIT_CHANNELS
from datasets.frame import to_tensor
from eval.bench.synthetic_frames import synthetic_frame
from models.filters.aaf import AAF, band_limit, filter_lines, pack_geometry, penumbra, widths
from models.registry import create
from tests.helpers import foreign
from tests.helpers.frames import FOCAL_LENGTH, chain, flat_frame, run
from tests.helpers.plates import SIZE, TO_THE_EYE, TO_THE_WALL, frames_of, plate

pytestmark = pytest.mark.usefixtures("implementation")
DEPTH = 2.0
PIXEL = DEPTH / FOCAL_LENGTH  # on the wall of flat_frame


def lit_frame(height=5, width=7, indirect=0.0, blocked=0.0, light=0.0, angle=0.0, roughness=1.0, **others):
    """A wall whose samples all hit the same."""
    frame = flat_frame(height, width, depth=DEPTH, **others)

    def image(*values):
        return torch.tensor(values)[None, :, None, None].expand(1, -1, height, width).contiguous()

    hits = {"hit_distance": image(indirect, blocked), "light_distance": image(light), "light_angle": image(angle)}
    return replace(frame, channels=frame.channels | hits | {"roughness": image(roughness)})


def width_of(**hits):
    """Of direct and of indirect light, in the middle of a wall, in world units."""
    direct, indirect = widths(lit_frame(**hits))[0, :, 0, 2, 3].tolist()
    return direct, indirect


# --- Widths -----------------------------------------------------------------------------------------------------------


def test_the_penumbra_from_rendered_samples():
    """Of a square lamp at 2, with its side foreshortened; its blocker stands at 1.2."""
    wall = plate("a wall", 20, (0, 0, 0), faces=TO_THE_EYE)
    lamp = plate("c lamp", 0.8, (2.5, 0, 2.0), radiance=50, faces=TO_THE_WALL)
    (rendered,) = frames_of(wall, plate("b blocker", 1.2, (1.6, 0, 1.2)), lamp, frames=1)
    channels = {name: to_tensor(rendered[name][0]) for name in HIT_CHANNELS}
    frame = replace(flat_frame(SIZE, SIZE), channels=channels)
    on_wall = (rendered["mesh_id"][..., 0] == 1) & (channels["hit_distance"][0, 1].numpy() > 0)
    cosine = 2.0 / channels["light_distance"][0, 0].numpy()[on_wall]
    expected = 0.8 * np.sqrt(cosine) * 1.2 / (2.0 - 1.2) / math.sqrt(12)
    assert len(expected) > 20
    np.testing.assert_allclose(penumbra(frame)[0, 0].numpy()[on_wall], expected, rtol=2e-3)


def test_the_sun_s_penumbra_grows_with_the_distance_of_the_blocker():
    width = penumbra(lit_frame(blocked=3.0, light=0.0, angle=0.01))
    torch.testing.assert_close(width, torch.full_like(width, 0.03))


def test_widths_are_those_of_the_papers():
    large = 0.9 / 2.0  # angle of a lamp at 2 with σ = 0.9: σ s = 0.9 at half of the way
    assert width_of(blocked=1.0, light=2.0, angle=large)[0] == pytest.approx(0.9 / 3)
    assert width_of(blocked=1e-3, light=2.0, angle=large)[0] == pytest.approx(PIXEL / 3)  # 1 / Ω
    assert width_of(light=2.0, angle=large)[0] == pytest.approx(2.0 / 5.6)  # nothing blocks it
    assert width_of(blocked=1.9, light=2.0, angle=large)[0] == pytest.approx(2.0 / 5.6)  # a wide penumbra
    assert width_of(indirect=0.7)[1] == pytest.approx(0.7 / 5.6)
    assert width_of(indirect=0.7, roughness=0.5)[1] == pytest.approx(0.7 / (2 * (3.5 + 0.2 * 1.5)))
    assert width_of(indirect=0.7, roughness=0.0)[1] < 1e-4
    limit = 50 * PIXEL / math.sqrt(8)
    for far in ({}, {"indirect": 1e3, "light": 1e3}):
        assert width_of(**far) == pytest.approx((limit, limit))


def test_smoother_surfaces_reflect_finer_detail():
    bands = band_limit(torch.tensor([1.0, 0.9, 0.5, 0.1, 0.0]))
    assert bands[0] == pytest.approx(2.8) and (bands.diff() > 0).all() and torch.isfinite(bands).all()


def test_the_nearest_hit_of_the_same_mesh_counts():
    mesh = torch.ones(1, 1, 6, 9)
    mesh[..., 5:] = 2
    frame = lit_frame(6, 9, indirect=2.0, mesh_id=mesh)
    frame.channels["hit_distance"][0, 0, 2, 2] = 0.5
    frame.channels["hit_distance"][0, 0, 2, 5] = 0.1
    frame.channels["hit_distance"][0, 0, 4, 3] = 0.0  # no hit
    nearest = 5.6 * widths(frame)[0, 1, 0]
    expected = torch.full((6, 9), 2.0)
    expected[1:4, 1:4] = 0.5
    expected[1:4, 5:7] = 0.1
    torch.testing.assert_close(nearest, expected)


def test_positions_are_where_the_camera_s_rays_end():
    frame = synthetic_frame(7, 20, 30)
    expected = np.moveaxis(foreign.positions(frame) - foreign.view(frame).camera_to_world[:3, 3], -1, 0)
    hit = frame.depth[0, 0].numpy() > 0
    np.testing.assert_allclose(pack_geometry(frame)[0, 0, :3].numpy()[:, hit], expected[:, hit], atol=1e-5)


# --- The filter -------------------------------------------------------------------------------------------------------


def naive_weight(geometry, width, p, q):
    if p == q:
        return 1.0
    difference = geometry[:3, *q] - geometry[:3, *p]
    exponent = (difference @ difference - (difference @ geometry[3:, *p]) ** 2) / (2 * width**2)
    cosine, distance = geometry[3:, *p] @ geometry[3:, *q], math.sqrt(difference @ difference)
    limit = math.cos(math.radians(5))
    # Where rounding decides whether a tap counts, single precision may differ.
    assume(abs(cosine - limit) > 1e-6 and abs(exponent - 4) > 1e-3 and abs(distance - 5.6 * width) > 1e-4 * width)
    return math.exp(-exponent) if cosine > limit and exponent <= 4 and distance < 5.6 * width else 0.0


def naive_pass(image, width, max_width, geometry, down):
    """filter_lines of (3, H, W), (H, W), (H, W) and (6, H, W), pixel by pixel in float64."""
    out = np.zeros_like(image)
    for p in np.ndindex(width.shape):
        line = [(y, p[1]) for y in range(width.shape[0])] if down else [(p[0], x) for x in range(width.shape[1])]
        weights = [naive_weight(geometry, min(width[p], max_width[q]), p, q) for q in line]
        out[:, *p] = sum(w * image[:, *q] for w, q in zip(weights, line, strict=True)) / sum(weights)
    return out


@settings(max_examples=8, deadline=None)
@given(size=st.tuples(st.integers(1, 12), st.integers(1, 12)), seed=st.integers(0, 999), down=st.booleans())
@example(size=(12, 9), seed=318, down=False)  # a cosine at its limit
def test_passes_are_gaussians_of_world_distances(size, seed, down):
    rng = np.random.default_rng(seed)
    frame = synthetic_frame(seed % 20, *size)
    frame.channels["normal"] = frame.normal + 0.05 * torch.from_numpy(np.float32(rng.normal(size=(1, 3, *size))))
    geometry = pack_geometry(frame)
    image, width, max_width = (np.float32(rng.random((c, *size))) for c in (3, 1, 1))
    tensors = [torch.from_numpy(array)[None, None] for array in (image, width, max_width)]
    filtered = filter_lines(*tensors, geometry, down)[0, 0]
    floats = [np.float64(array) for array in (image, width[0], max_width[0], geometry[0, 0].numpy())]
    np.testing.assert_allclose(filtered, naive_pass(*floats, down), rtol=1e-4)


def test_shadows_do_not_leak_to_where_filters_are_wide():
    """A lit wall beside one in a hard shadow: within a pixel of the edge nothing changes."""
    shaded = torch.arange(40) < 20
    light = torch.where(shaded, 0.0, 1.0).expand(1, 3, 9, 40).contiguous()
    frame = lit_frame(9, 40, light=5.0, angle=0.01, irradiance=light)
    frame.channels["hit_distance"][0, 1, :, :20] = 0.01
    (output,) = run(AAF(), [frame])
    torch.testing.assert_close(output[..., :19], light[..., :19])
    torch.testing.assert_close(output[..., 21:], light[..., 21:])


@settings(max_examples=20, deadline=None)
@given(
    hits=st.tuples(*[st.sampled_from([0.0, 1e-30, 1e-7, 1.0, 65504.0, 3e38])] * 4),
    depth=st.sampled_from([1e-4, 1.0, 1e6, 3e38]),
    level=st.sampled_from([0.0, 1e-7, 6e4, 3e38]),
)
def test_extremes_stay_within_the_range_of_the_input(hits, depth, level):
    frame = lit_frame(7, 9, *hits, irradiance=torch.full((1, 3, 7, 9), level))
    frame.channels["depth"] = torch.full((1, 1, 7, 9), depth)
    frame.direct[0, :, 3, 4] = 1.0
    (output,) = run(AAF(), [frame])
    low, high = sorted((min(level, 1e16), 1.0))
    assert torch.isfinite(output).all()
    assert low * (1 - 1e-5) <= output.min() and output.max() <= high * (1 + 1e-5)


def test_accumulated_light_is_filtered():
    """The second of two frames at rest is that of one whose light is their mean."""
    lights = torch.rand(2, 1, 3, 12, 14, generator=torch.Generator().manual_seed(0))
    frames = chain([flat_frame(12, 14, irradiance=light) for light in lights])
    _, second = run(create("aaf"), frames)
    (expected,) = run(create("aaf"), [flat_frame(12, 14, irradiance=lights.mean(dim=0))])
    (alone,) = run(create("aaf"), [flat_frame(12, 14, irradiance=lights[1])])
    torch.testing.assert_close(second, expected)
    assert not torch.allclose(second, alone, atol=1e-2)
