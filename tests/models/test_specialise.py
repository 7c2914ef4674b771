"""Specialised networks: the general ones' output where a channel does not vary, and a clear word where it does."""

from collections.abc import Collection
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from datasets.frame import Frame
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from models import compiled, registry
from models.denoiser import Denoiser, drop_inputs
from models.history.running_scale import running_scale
from models.networks.wskp import network_features
from models.spec import load
from models.weights import read_metadata, save_weights
from tests.helpers.denoisers import each
from tests.helpers.frames import chain, flat_frame, run

GREY = [0.25, 0.5, 0.75]
CONSTANTS = {"albedo": GREY, "normal": [0.0, 0.0, -1.0], "roughness": [1.0], "depth": [2.0]}
LEFT_OUT = {name: {"albedo", "normal"} for name in ("wskp3", "wskp6", "wskp-mr", "kp", "mr-kp", "nbgd", "ntd")}
LEFT_OUT |= {"rae": {"roughness"}}
FEWER = {"wskp3": 6 * 24 * (1 + 9 + 25), "wskp-mr": 6 * 32 * 9, "rae": 32 * 9, "ntd": 6 * 32 * 9}  # weights


def frames(height: int, width: int, count: int = 2) -> list[Frame]:
    """A wall of one colour in noisy light, with the camera sliding along it."""
    noise = torch.Generator().manual_seed(1)
    albedo = torch.tensor(GREY)[None, :, None, None].repeat(1, 1, height, width)
    shifted = []
    for _ in range(count):
        light = torch.rand(1, 3, height, width, generator=noise) * 3
        frame = flat_frame(height, width, motion=(1.0, 0.0), irradiance=light * albedo)
        shifted.append(replace(frame, channels=frame.channels | {"albedo": albedo, "indirect": light * albedo / 2}))
    return chain(shifted)


def without_border(denoiser: Denoiser, names: Collection[str]) -> None:
    """Let the network see these channels through the middle of its kernels only, so that zeros around do not matter."""
    start = 0
    for name, count in denoiser.inputs.items():
        if name in names:
            for layer in denoiser.first_layers():
                middle = layer.kernel_size[0] // 2
                kept = layer.weight.data[:, start : start + count, middle, middle].clone()
                layer.weight.data[:, start : start + count] = 0
                layer.weight.data[:, start : start + count, middle, middle] = kept
        start += count


def pair(name: str, borderless: Collection[str] = ()) -> tuple[Denoiser, Denoiser]:
    """A network with random weights, and the same one specialised; see `without_border`."""
    torch.manual_seed(0)
    general = registry.create(name)
    without_border(general, borderless)
    special = registry.create(name)
    special.load_state_dict(general.state_dict())
    special.specialise(CONSTANTS)
    return general, special


@torch.no_grad()
def test_a_convolution_without_an_input_that_is_constant():
    torch.manual_seed(0)
    layer = nn.Conv2d(4, 5, 3, padding=1)
    x = torch.randn(1, 4, 8, 9)
    x[:, 1:3] = torch.tensor([2.0, -3.0])[:, None, None]
    before = layer(x)
    weight, bias = layer.weight.clone(), layer.bias.clone()
    drop_inputs(layer, 1, torch.tensor([2.0, -3.0]))
    after = layer(x[:, [0, 3]])
    torch.testing.assert_close(after[..., 1:-1, 1:-1], before[..., 1:-1, 1:-1])
    assert layer.in_channels == 2 and not torch.allclose(after, before)
    # Outside of the image, what was dropped goes on, as if it alone were padded with its value.
    outside = torch.zeros(1, 4, 10, 11)
    outside[:, 1:3] = torch.tensor([2.0, -3.0])[:, None, None]
    outside[..., 1:-1, 1:-1] = x
    torch.testing.assert_close(after, F.conv2d(outside, weight, bias))


@pytest.mark.parametrize("name, border", [("wskp3", 3 * 2 + 6), ("wskp6", 6 * 2 + 6), ("kp", 6 * 2 + 6)])
def test_the_output_is_the_general_one_s_but_near_the_border(name, border):
    """How far the border reaches: two pixels a convolution, and half of the largest window."""
    general, special = pair(name)
    sequence = frames(48, 51)
    for a, b in zip(run(general, sequence), run(special, sequence), strict=True):
        inner = (..., slice(border, -border), slice(border, -border))
        torch.testing.assert_close(a[inner], b[inner], rtol=1e-4, atol=1e-5)
        assert not torch.allclose(a, b, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", each(LEFT_OUT))
def test_every_network_can_do_without_what_does_not_vary(name, tmp_path):
    """Also after a way through a file, in the form for inference, compiled and not."""
    general, special = pair(name, LEFT_OUT[name])
    assert special.constants == {channel: CONSTANTS[channel] for channel in sorted(LEFT_OUT[name])}
    if name in FEWER:
        assert special.parameter_count() == general.parameter_count() - FEWER[name]
    path = tmp_path / "w.safetensors"
    save_weights(special, name, {}, path)
    loaded = load(name, path, torch.float32)
    sequence = frames(40, 37, 3)
    expected = run(general, sequence)
    for output in (run(special, sequence), run(loaded, sequence)):
        torch.testing.assert_close(output, expected, rtol=1e-4, atol=1e-5)
    with compiled.disabled():
        torch.testing.assert_close(run(loaded, sequence), expected, rtol=1e-3, atol=1e-4)


VARYING = [("colour", "depth"), ("colour", "normal", "depth"), ("colour", "albedo", "depth")]


@pytest.mark.parametrize("varying", [*VARYING, ("colour", "albedo", "normal", "depth")])
def test_varying_features_are_part_of_all(varying):
    """By kernels and in PyTorch, of two items of a batch with gains."""
    frame = Frame.stack([synthetic_frame(index, 19, 23) for index in range(2)])
    frame = replace(frame, colour_gain=torch.tensor([[0.5, 1.0, 2.0], [1.0, 1.0, 0.0]])[..., None, None])
    irradiance = frame.irradiance("total")
    scale = running_scale(irradiance * frame.divisor, frame.depth, None)
    places = {"colour": [0, 1, 2], "albedo": [3, 4, 5], "normal": [6, 7, 8], "depth": [9]}
    with compiled.disabled():
        everything = network_features(frame, irradiance, scale)
        slow = network_features(frame, irradiance, scale, varying)
    assert torch.equal(slow, everything[:, [i for name in varying for i in places[name]]])
    torch.testing.assert_close(network_features(frame, irradiance, scale, varying), slow, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("name, channel", [("rae", "roughness"), ("wskp3", "albedo"), ("wskp3+taa", "normal")])
def test_a_frame_in_which_such_a_channel_varies_is_refused(name, channel, tmp_path):
    plain = registry.parse_name(name).base
    _, special = pair(plain)
    path = tmp_path / "w.safetensors"
    save_weights(special, plain, {}, path)
    denoiser = load(name, path, torch.float32)
    [frame] = frames(8, 8, 1)

    def varied(change: float) -> Frame:
        values = frame.channels[channel].clone()
        values[..., 3, 4] += change
        return frame.with_channels({channel: values})

    run(denoiser, [frame, varied(2e-4)])  # as float16 rounds
    run(denoiser, [varied(torch.nan)])  # as any pixel that is not finite
    with pytest.raises(BadInput, match=f"test: {channel} is not .* specialised: use general weights"):
        run(denoiser, [varied(0.01)])


def test_weights_say_what_they_do_without(tmp_path):
    general, special = pair("rae")
    save_weights(general, "rae", {}, tmp_path / "general")
    save_weights(special, "rae", {}, tmp_path / "special")
    assert "constants" not in read_metadata(tmp_path / "general")
    assert read_metadata(tmp_path / "special")["constants"] == {"roughness": [1.0]}
