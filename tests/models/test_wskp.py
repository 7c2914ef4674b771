"""WSKP: RepVGG conversion, inputs, the multi-resolution combination and the baseline, each against slow versions."""

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import read_frame
from eval.bench.synthetic_frames import synthetic_frame
from models import registry
from models.compiled.exponential import exp, log
from models.history.accumulation import accumulate
from models.history.running_scale import running_scale
from models.networks.repvgg import PairedConv2d, RepVGGBlock, merge, repvgg
from models.networks.wskp import combine_resolutions
from tests.helpers.frames import flat_frame, prepared, run
from tests.helpers.unfold import unfold_fuse


@pytest.mark.parametrize("widths", [(10, 24, 24, 12), (10, 24, 24, 24, 24, 24, 12), (3, 3)])
def test_inference_form_equals_training_form(widths):
    torch.manual_seed(0)
    network = repvgg(widths)
    x = torch.rand(2, widths[0], 19, 23)
    with torch.no_grad():
        before = network(x)
        merge(network)
        after = network(x)
    torch.testing.assert_close(before, after, rtol=1e-5, atol=1e-5)
    layers = [m for m in network.modules() if isinstance(m, torch.nn.Conv2d)]
    assert len(layers) == len(widths) - 1 and all(layer.kernel_size == (5, 5) for layer in layers)
    assert after.min() < 0  # the last block is linear


def test_block_is_the_sum_of_its_branches():
    torch.manual_seed(0)
    block = RepVGGBlock(4, 4, relu=True)
    x = torch.randn(1, 4, 9, 9)
    parts = [F.conv2d(x, b.weight, b.bias, padding=b.weight.shape[-1] // 2) for b in block.branches]
    torch.testing.assert_close(block(x), torch.relu(x + sum(parts)))


@pytest.mark.parametrize(("name", "outputs"), [("wskp3", 12), ("wskp6", 12), ("kp", 169)])
def test_networks_have_the_papers_layers(name, outputs):
    layers = [m for m in registry.create(name).modules() if isinstance(m, RepVGGBlock)]
    assert len(layers) == {"wskp3": 3, "wskp6": 6, "kp": 6}[name]
    assert layers[0].branches[0].in_channels == 10 and layers[-1].branches[0].out_channels == outputs


def test_wskp_is_accumulation_network_fusion(moving_clip):
    """The whole frame against its parts written out, with the fusion of the test in float64."""
    torch.manual_seed(3)
    wskp = registry.create("wskp3")
    frames = [read_frame(moving_clip, index, wskp.reads) for index in range(3)]
    outputs = run(wskp, frames)
    history = scale = None
    for frame, output in zip(frames, outputs, strict=True):
        history = accumulate(frame, (frame.direct + frame.indirect) / frame.albedo.clamp(min=0.01), history)
        radiance = history.irradiance * frame.albedo.clamp(min=0.01)
        scale = running_scale(radiance, frame.depth, scale)
        exposed = (radiance * scale.exposure()).clamp(0, 1) ** (1 / 2.2)
        x = torch.cat([exposed, frame.albedo, (frame.normal + 1) / 2, scale.normalised_depth(frame.depth)], dim=1)
        with torch.no_grad():
            predicted = wskp.network(x).double()
        filtered = unfold_fuse(history.irradiance.double(), predicted[:, :6], predicted[:, 6:])
        expected = filtered * frame.albedo.clamp(min=0.01) + frame.emission
        np.testing.assert_allclose(output, expected, rtol=1e-4, atol=1e-5)


def test_combination_of_resolutions_is_equation_7():
    rng = np.random.default_rng(0)
    fine = rng.random((4, 6))
    coarse = rng.random((2, 3))
    alpha = rng.random((4, 6))
    expected = np.empty((4, 6))
    for y in range(4):
        for x in range(6):
            block = fine[y // 2 * 2 : y // 2 * 2 + 2, x // 2 * 2 : x // 2 * 2 + 2].mean()
            expected[y, x] = fine[y, x] - alpha[y, x] * block + alpha[y, x] * coarse[y // 2, x // 2]
    tensors = (torch.from_numpy(a)[None, None] for a in (fine, coarse, alpha))
    np.testing.assert_allclose(combine_resolutions(*tensors)[0, 0], expected, rtol=1e-12)


def test_mr_kp_is_kernels_of_5_by_5_at_three_resolutions():
    """With one large logit at every resolution, each of them is its image shifted by that tap; Eq. 7 follows."""
    denoiser = registry.create("mr-kp")
    image = torch.rand(1, 3, 12, 16, generator=torch.Generator().manual_seed(0))
    dy, dx, alpha = 1, -2, 0.3
    predicted = []
    for level in (2, 1, 0):
        maps = torch.zeros(1, 26, 12 >> level, 16 >> level)
        maps[:, (dy + 2) * 5 + dx + 2] = 200.0
        maps[:, 25] = np.log(alpha / (1 - alpha))
        predicted.append(maps)
    output, mixture = denoiser.reconstruct(image, predicted)
    assert mixture is None

    def shifted(image: Tensor) -> Tensor:
        """What lies dy, dx further; inside the image a tap outside has no weight, so only inner pixels are compared."""
        return torch.roll(image, (-dy, -dx), dims=(-2, -1))

    expected = shifted(F.avg_pool2d(image, 4))
    for size in (2, 1):
        fine = shifted(F.avg_pool2d(image, size))
        up = F.interpolate(expected - F.avg_pool2d(fine, 2), scale_factor=2.0)
        expected = fine + alpha * up
    # At the coarsest resolution the first two columns and the last row have no such tap.
    inner = (slice(0, 8), slice(12, 14))
    torch.testing.assert_close(output[..., *inner], expected.clamp(min=0)[..., *inner], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["wskp3", "wskp6"])
def test_kernel_choice_can_be_seen(name):
    wskp = registry.create(name)
    _, state = wskp(flat_frame(8, 9), None)
    shown = state.pictures()
    assert set(shown) == {"history length", "mean window (px)"}
    assert shown["mean window (px)"].min() >= 3 and shown["mean window (px)"].max() <= 13


def test_compiled_functions_are_the_mathematical_ones():
    x = np.float32(np.concatenate([np.linspace(-80, 80, 999), [0.0, 1e-20, -1e-20]]))
    np.testing.assert_allclose([exp(v) for v in x], np.exp(x.astype(np.float64)), rtol=1e-5)
    positive = np.float32(10 ** np.linspace(-30, 30, 999))
    np.testing.assert_allclose([log(v) for v in positive], np.log(positive.astype(np.float64)), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [(6, 10), (5, 7), (1, 1)])
def test_pairs_of_pixels_are_convolved_as_pixels_are(dtype, size):
    torch.manual_seed(0)
    layer = PairedConv2d(10, 24, 5, padding=2)
    layer.pair()
    layer = layer.to(dtype).to(memory_format=torch.channels_last)
    x = torch.randn(2, 10, *size).to(dtype)
    for image in (x, x.contiguous(memory_format=torch.channels_last)):
        torch.testing.assert_close(layer(image), F.conv2d(x, layer.weight, layer.bias, padding=2))


@pytest.mark.parametrize("name", ["wskp3", "wskp6", "kp", "nbgd"])
@pytest.mark.parametrize("height", [70, 137])
def test_large_frames_are_filtered_in_strips_bit_for_bit(name, height, monkeypatch):
    frame = synthetic_frame(0, height, 90)
    denoiser = prepared(name)
    with torch.inference_mode():
        whole, state = denoiser(frame, None)
        monkeypatch.setattr("models.networks.wskp.MAX_WHOLE_PIXELS", 1)
        monkeypatch.setattr("models.networks.wskp.STRIP_PIXELS", 32 * 90)
        strips, state_of_strips = denoiser(frame, None)
    assert torch.equal(strips, whole)
    torch.testing.assert_close(state_of_strips.pictures(), state.pictures(), rtol=0, atol=0)
