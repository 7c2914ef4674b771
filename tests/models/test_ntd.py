"""NTD: warping, the pyramid and Eq. 4 against slow versions in float64, blending, state, precision and invariances."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame, read_frame
from errors import BadInput
from models.networks.convolution import ConvReLU
from models.networks.ntd import NTD, NTDMean, NTDState, NTDTraditional, combine_levels, reconstruct_image, warp
from models.registry import create
from tests.helpers.frames import flat_frame, play, run

OUTPUTS = (26, 26, 51)


@pytest.fixture(scope="module")
def ntd() -> NTD:
    torch.manual_seed(0)
    return NTD().eval()


@pytest.fixture(scope="module")
def frames(moving_clip) -> list[Frame]:
    return [read_frame(moving_clip, index, NTD(signal="total").reads) for index in range(2, 5)]


# --- Operators --------------------------------------------------------------------------------------------------------


def fetched(image: np.ndarray, v: float, u: float) -> np.ndarray:
    """The image (C, H, W) bilinearly at row v and column u; taps outside are the nearest ones inside."""
    top, left = int(np.floor(v)), int(np.floor(u))
    rows, columns = (
        np.clip([first, first + 1], 0, size - 1) for first, size in zip((top, left), image.shape[1:], strict=True)
    )
    return image[:, rows][:, :, columns] @ [left + 1 - u, u - left] @ [top + 1 - v, v - top]


def naive_warp(image: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(C, H, W) fetched at p + motion(p), pixel by pixel."""
    _, height, width = image.shape
    out = np.zeros_like(image)
    inside = np.zeros((height, width), bool)
    for y, x in np.ndindex(height, width):
        u = x + motion[0, y, x]
        v = y + motion[1, y, x]
        inside[y, x] = -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
        out[:, y, x] = fetched(image, v, u)
    return out, inside


@pytest.mark.parametrize("size", [(7, 9), (1, 1), (1, 6), (5, 1)])
def test_warp_equals_the_naive_version(size):
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (3, *size))
    motion = rng.uniform(-4, 4, (2, *size))
    warped, inside = warp(*(torch.from_numpy(a).float()[None] for a in (image, motion)))
    expected, expected_inside = naive_warp(image, motion)
    np.testing.assert_array_equal(inside[0, 0], expected_inside)
    np.testing.assert_allclose(warped[0], expected, atol=1e-5)


def naive_upsampled(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Twice the size, bilinear between pixel centres, the border continued; cut to (C, H, W)."""
    out = np.zeros((len(image), height, width))
    for y, x in np.ndindex(height, width):
        out[:, y, x] = fetched(image, (y + 0.5) / 2 - 0.5, (x + 0.5) / 2 - 0.5)
    return out


def naive_combine(
    fine: np.ndarray, coarse: np.ndarray, alpha: np.ndarray, pool: Callable[..., np.ndarray] = np.max
) -> np.ndarray:
    """Eq. 4 as the paper writes it, D by its `pool`."""
    pooled = np.zeros_like(coarse)
    for y, x in np.ndindex(pooled.shape[1:]):
        pooled[:, y, x] = pool(fine[:, 2 * y : 2 * y + 2, 2 * x : 2 * x + 2], axis=(1, 2))
    size = fine.shape[1:]
    return fine - naive_upsampled(alpha * pooled, *size) + naive_upsampled(alpha * coarse, *size)


@pytest.mark.parametrize("kind, pool", [(NTD, np.max), (NTDMean, np.mean)])
@pytest.mark.parametrize("size", [(8, 6), (7, 5), (1, 1), (1, 4), (3, 2)])
def test_combination_equals_eq_4(size, kind, pool):
    rng = np.random.default_rng(0)
    half = -(-size[0] // 2), -(-size[1] // 2)
    fine = rng.uniform(0, 5, (3, *size))
    coarse = rng.uniform(0, 5, (3, *half))
    alpha = rng.uniform(0, 1, (1, *half))
    result = combine_levels(*(torch.from_numpy(a)[None] for a in (fine, coarse, alpha)), pool=kind().pool)
    np.testing.assert_allclose(result[0], naive_combine(fine, coarse, alpha, pool), atol=1e-12)


def predictions(height: int, width: int, alpha: tuple[float, float, float], kernel: float = 0.0) -> list[Tensor]:
    """Logits at 1/4, 1/2 and full size: `kernel` for the centre tap against 0 for others, `alpha` of each level."""
    result = []
    for level, outputs, a in zip((4, 2, 1), OUTPUTS, alpha, strict=True):
        logits = torch.zeros(1, outputs, -(-height // level), -(-width // level))
        logits[:, 12:outputs:25] = kernel
        logits[:, -1] = a
        result.append(logits)
    return result


def test_reconstruction_equals_eq_4_at_both_levels():
    """The whole of Fig. 6 on an odd size, with kernels that pass pixels through."""
    rng = np.random.default_rng(1)
    noisy, warped = rng.uniform(0, 5, (2, 3, 7, 10))
    half = np.array(
        [[[c[y : y + 2, x : x + 2].mean() for x in range(0, 10, 2)] for y in range(0, 7, 2)] for c in noisy]
    )
    quarter = np.array(
        [[[c[y : y + 2, x : x + 2].mean() for x in range(0, 5, 2)] for y in range(0, 4, 2)] for c in half]
    )
    a4, a2, a_t = (1 / (1 + np.exp(-np.array([0.3, -0.6, 1.2])))).tolist()
    middle = naive_combine(half, quarter, np.full((1, 2, 3), a4))
    fine = naive_combine(noisy, middle, np.full((1, 4, 5), a2))
    maps = predictions(7, 10, (0.3, -0.6, 1.2), kernel=80.0)
    result, alpha = reconstruct_image(*(torch.from_numpy(a).float()[None] for a in (noisy, warped)), maps)
    np.testing.assert_allclose(result[0], a_t * fine + (1 - a_t) * warped, atol=1e-5)
    assert alpha.shape == (1, 1, 7, 10) and alpha.flatten()[0].item() == pytest.approx(a_t)


def test_alpha_t_is_the_weight_of_the_current_frame():
    noisy = torch.rand(1, 3, 9, 11)
    warped = torch.rand(1, 3, 9, 11) + 10
    now, then = (predictions(9, 11, (0, 0, logit)) for logit in (200.0, -200.0))
    torch.testing.assert_close(reconstruct_image(noisy, warped, now), reconstruct_image(noisy, noisy, now))
    mean = F.avg_pool2d(warped, 5, 1, 2, count_include_pad=False)  # what equal logits make of a window
    torch.testing.assert_close(reconstruct_image(noisy, warped, then)[0], mean)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_convolutions_equal_pytorch_s(dtype):
    torch.manual_seed(0)
    layer = ConvReLU(5, 8).to(dtype).to(memory_format=torch.channels_last)
    x = torch.randn(2, 5, 9, 10).to(dtype).contiguous(memory_format=torch.channels_last)
    other = torch.randn(2, 8, 9, 10).to(dtype).contiguous(memory_format=torch.channels_last)
    for extra in (None, other):
        expected = layer(x, extra).detach()
        with torch.no_grad():
            fused = layer(x, None if extra is None else extra.clone())
        assert fused.dtype == dtype and (fused == 0).any() and (fused >= 0).all()
        rounding = 0.02 if dtype == torch.bfloat16 else 1e-5
        torch.testing.assert_close(fused, expected, rtol=rounding, atol=rounding)


@pytest.mark.parametrize("kind, kept", [(NTD, (0.7, 0.95)), (NTDMean, (0.99, 1.01))])
def test_averaging_keeps_the_light_and_maxima_darken(kind, kept):
    """Fresh networks, of kernels and shares near even, on sparse noise as of one sample a pixel."""
    torch.manual_seed(0)
    light = 8 * (torch.rand(1, 3, 64, 64) < 1 / 8).float()
    frame = flat_frame(64, 64).with_channels({"direct": torch.zeros_like(light), "indirect": light})
    brightness = run(kind().eval(), [frame])[0].mean() / light.mean()
    assert kept[0] < brightness < kept[1]


# --- The denoiser -----------------------------------------------------------------------------------------------------


def test_the_network_is_the_one_described(ntd, frames, monkeypatch):
    captured: list[Tensor] = []
    genuine = ntd.network.forward
    monkeypatch.setattr(ntd.network, "forward", lambda x: captured.append(x) or genuine(x))
    _, state = play(ntd, frames[:2])
    assert isinstance(state, NTDState)
    assert [tuple(p.shape[1:]) for p in genuine(captured[1])] == [(26, 16, 16), (26, 32, 32), (51, 64, 64)]
    x = captured[1]
    frame = frames[1]
    exposure = state.scale.exposure()
    assert x.shape == (1, 13, 64, 64)
    torch.testing.assert_close(x[:, :3], torch.log1p(exposure * frame.indirect / frame.divisor))
    torch.testing.assert_close(x[:, 3:6], torch.log1p(exposure * state.warped))
    assert torch.equal(x[:, 6:9], frame.albedo) and torch.equal(x[:, 9:12], frame.normal)
    torch.testing.assert_close(x[:, 12:], state.scale.normalised_depth(frame.depth))
    assert x[:, :6].min() >= 0 and x[:, :6].max() < 12
    with pytest.raises(BadInput, match="float16"):
        NTD().prepare(torch.float16)


def test_what_it_reads(ntd):
    assert set(ntd.reads) == {"indirect", "albedo", "normal", "depth", "motion", "dual_motion"}
    assert set(NTDTraditional.reads) == {"indirect", "albedo", "normal", "depth", "motion"}
    assert {"direct", "emission"} <= set(NTD(signal="total").reads)
    assert [create(name).vectors for name in ("ntd-a", "ntd-b", "ntd")] == ["motion", "dual_motion", "dual_motion"]
    assert create("ntd-mean").vectors == "dual_motion" and create("ntd-mean").signal == "indirect"
    assert {create(name).signal for name in ("ntd-a", "ntd-b", "ntd")} == {"indirect"}


def test_the_previous_output_is_warped_by_the_dual_vectors(ntd, frames):
    now = frames[1].with_channels({"dual_motion": frames[1].dual_motion + 7.3, "motion": frames[1].motion + 7.3})
    _, state = play(ntd, [frames[0], now])
    _, before = play(ntd, frames[:1])
    assert torch.equal(before.warped, frames[0].indirect / frames[0].divisor)  # the first frame's noise
    warped, inside = naive_warp(before.irradiance[0].double().numpy(), now.dual_motion[0].double().numpy())
    noisy = (now.indirect / now.divisor)[0].numpy()
    assert 0.5 < inside.mean() < 1
    np.testing.assert_allclose(state.warped[0], np.where(inside, warped, noisy), rtol=1e-3, atol=1e-4)
    mask = (frames[1].dual_motion - frames[1].motion).abs().amax(dim=1, keepdim=True) > 1 / 64
    pictures = state.pictures()
    assert torch.equal(pictures["disocclusion mask"], mask.float()) and 0 < mask.float().mean() < 0.5
    assert pictures["alpha_t"].shape == (1, 1, 64, 64) and pictures["warped previous"].shape == (1, 3, 64, 64)


def test_equal_vectors_make_it_the_ablation_with_traditional_ones(ntd, frames):
    traditional = NTDTraditional().eval()
    traditional.load_state_dict(ntd.state_dict())
    same = [frame.with_channels({"dual_motion": frame.motion}) for frame in frames]
    torch.testing.assert_close(run(ntd, same), run(traditional, frames), rtol=0, atol=0)
    assert not torch.equal(run(ntd, frames)[1], run(traditional, frames)[1])
    assert "disocclusion mask" not in play(traditional, frames)[1].pictures()


def test_outputs_of_both_signals(ntd, frames):
    """The same irradiance through both: "total" adds emission, untouched, and is filtered from direct + indirect."""
    total = NTD(signal="total").eval()
    total.load_state_dict(ntd.state_dict())
    halved = [frame.with_channels(dict.fromkeys(("direct", "indirect"), frame.indirect / 2)) for frame in frames]
    expected = [output + frame.emission for output, frame in zip(run(ntd, frames), frames, strict=True)]
    torch.testing.assert_close(run(total, halved), expected)


def test_training_sees_what_inference_cuts_off(frames):
    """`predict` returns values below 0 where Eq. 4 makes them, but what is carried on is cut off as it is in use.

    Gradients reach back through the warped output.
    """
    torch.manual_seed(0)
    ntd = NTD()
    with torch.no_grad():  # pass single pixels through, and take the coarse image instead of their maxima
        ntd.network.heads[2].bias[12] = ntd.network.heads[2].bias[50] = ntd.network.heads[1].bias[25] = 9.0
    raw, state = ntd.predict(frames[0], None)
    assert (raw < 0).any() and torch.equal(state.irradiance, raw.clamp(min=0))
    output, after = ntd(frames[0], None)
    assert (output >= 0).all() and torch.equal(after.irradiance, raw.clamp(min=0))
    first = raw.detach().requires_grad_()
    second, _ = ntd.predict(frames[1], replace(state, irradiance=first))
    second.sum().backward()
    assert first.grad is not None and first.grad.abs().sum() > 0
    assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in ntd.parameters())


def test_gain_changes_what_the_network_sees_and_not_the_filtered_light(ntd, frames):
    frame = frames[0]
    gained = replace(frame, colour_gain=torch.tensor([0.5, 1.0, 2.0])[None, :, None, None])
    _, state = play(ntd, [frame])
    light = torch.rand(1, 3, 4, 4)
    plain, tinted = (ntd.compress(light, state.scale, f) for f in (frame, gained))
    torch.testing.assert_close(torch.expm1(tinted), torch.expm1(plain) * gained.gain)
    torch.testing.assert_close(ntd.compress(-light, state.scale, frame), -plain)
    assert torch.equal(play(ntd, [gained])[1].warped, state.warped)
