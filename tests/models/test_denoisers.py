"""Requirements on every registered denoiser, baselines and RAE, and weights."""

import numpy as np
import pytest
import torch

from datasets.clip import Dataset
from datasets.frame import Frame, read_frame
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from models import registry
from models.networks.rae import RAE, RAEState
from models.spec import fastest_precision, load, precisions_of
from models.weights import load_weights, save_weights
from tests.helpers.denoisers import each
from tests.helpers.frames import flat_frame, play, run

NAMES = list(registry.DENOISERS)
WRAPPED = [
    *("noisy+taa", "svgf+taa", "wskp6+taa", "ntd+taa"),
    *("eaw+adaptive", "wskp6+adaptive+taa", "svgf+js", "ntd+taa+js", "nfor+js"),
]


@pytest.fixture(scope="module")
def denoisers():
    torch.manual_seed(0)
    return {name: registry.create(name).eval() for name in NAMES}


@pytest.mark.parametrize("name", each(NAMES + WRAPPED))
def test_a_prototype_has_the_attributes_of_the_denoiser(name):
    prototype = registry.prototype(name)
    denoiser = registry.create(name)
    assert type(denoiser) is type(prototype)
    assert (prototype.reads, prototype.signal, prototype.refuses) == (denoiser.reads, denoiser.signal, denoiser.refuses)
    assert prototype.is_network == (denoiser.parameter_count() > 0)
    assert fastest_precision(name) in precisions_of(name)
    assert {registry.create(name, signal).signal for signal in ("total", "indirect")} == {"total", "indirect"}


@pytest.mark.parametrize("name", WRAPPED)
def test_wrappers_have_the_attributes_of_the_denoiser_inside(name):
    wrapper, inside = registry.prototype(name), registry.prototype(name.rpartition("+")[0])
    assert set(inside.reads) <= set(wrapper.reads) and len(set(wrapper.reads)) == len(wrapper.reads)
    for attribute in ("signal", "refuses", "is_network", "offline"):
        assert getattr(wrapper, attribute) == getattr(inside, attribute)


def test_a_prototype_takes_no_memory_for_weights():
    assert all(weight.is_meta for weight in registry.prototype("rae+taa").parameters())
    assert "dual_motion" in registry.channels_read(["ntd"]) and "normal" in registry.channels_read(["noisy+taa"])
    buffers = {name for name in registry.channels_read(["ntd+js"]) if name.endswith("_buffers")}
    assert buffers == {"indirect_buffers"}
    assert registry.prototype("rae+taa").unavailable() is None
    assert fastest_precision("svgf+taa") == "float32"


@pytest.mark.parametrize("name", each(NAMES))
def test_a_change_of_size_resets_the_history(denoisers, name):
    """Also where both sizes are padded alike, and for another batch size."""
    a = flat_frame(20, 20)
    b = flat_frame(30, 30, depth=50.0, irradiance=torch.full((1, 3, 30, 30), 1000.0))
    torch.testing.assert_close(run(denoisers[name], [a, a, b])[2], run(denoisers[name], [b])[0])
    two = Frame.stack([b, b])
    torch.testing.assert_close(run(denoisers[name], [b, two])[1], run(denoisers[name], [two])[0])


@pytest.mark.parametrize("name", each(NAMES))
def test_batch_items_do_not_mix(tiny, denoisers, name):
    """In frames with no more channels than it reads."""
    clips = Dataset(tiny).clips("train")
    count = 1 if denoisers[name].offline else 2
    window = (slice(16, 48), slice(12, 52))
    single = [[read_frame(clip, i, denoisers[name].reads, window=window) for i in range(count)] for clip in clips]
    together = run(denoisers[name], [Frame.stack(step) for step in zip(*single, strict=True)])[-1]
    for item, frames in enumerate(single):
        torch.testing.assert_close(together[item : item + 1], run(denoisers[name], frames)[-1], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", each(NAMES))
def test_radiance_that_demodulation_would_make_infinite(denoisers, name):
    frames = [flat_frame(9, 11).with_channels({"albedo": torch.zeros(1, 3, 9, 11)}) for _ in range(3)]
    frames[1].direct[0, :, 4, 5] = 3e38
    for output in run(denoisers[name], frames):
        assert torch.isfinite(output).all() and (output >= 0).all()


def test_noisy_is_the_sum_of_its_parts(moving_clip, denoisers):
    frame = read_frame(moving_clip, 3, denoisers["noisy"].reads)
    parts = [np.float32(moving_clip.read(name, 3)) for name in ("emission", "direct", "indirect")]
    np.testing.assert_allclose(run(denoisers["noisy"], [frame])[0][0].permute(1, 2, 0), sum(parts), rtol=1e-6)


@pytest.mark.parametrize("name", ["accumulated", "eaw", "svgf", "asvgf", "trmv", "bmfr", "aaf", "sbf", "wskp3", "one"])
def test_indirect_light_alone_is_filtered_as_in_the_total(name):
    frames = [synthetic_frame(index, 24, 32) for index in range(5)]
    dark = [frame.with_channels({"direct": 0 * frame.direct}) for frame in frames]
    torch.manual_seed(0)
    total = registry.create(name, "total")
    alone = registry.create(name, "indirect")
    alone.load_state_dict(total.state_dict())
    indirect = [output + frame.emission for output, frame in zip(run(alone, frames), frames, strict=True)]
    torch.testing.assert_close(indirect, run(total, dark))


@pytest.mark.parametrize(
    "name, share",
    [("svgf", 0.3), ("eaw", 0.3), ("bmfr", 0.02), pytest.param("nfor", 0.3, marks=pytest.mark.slow)],
)
def test_noise_on_a_wall_is_gone(name, share):
    """Of the error after accumulation alone."""
    generator = torch.Generator().manual_seed(0)
    lights = [4.0 * (torch.rand(1, 1, 48, 30, generator=generator) < 0.25).repeat(1, 3, 1, 1) for _ in range(8)]
    frames = [flat_frame(48, 30, irradiance=light) for light in lights]
    outputs = (run(d, frames[-1:] if d.offline else frames) for d in map(registry.create, (name, "accumulated")))
    filtered, accumulated = ((output[-1] - 1).square().mean() for output in outputs)
    assert filtered < share * accumulated


# --- RAE --------------------------------------------------------------------------------------------------------------


def test_rae_has_the_paper_s_36_convolutions(denoisers):
    convolutions = [m for m in denoisers["rae"].modules() if isinstance(m, torch.nn.Conv2d)]
    assert len(convolutions) == 36 and all(m.kernel_size == (3, 3) for m in convolutions)
    assert denoisers["rae"].parameter_count() == 1_951_935
    assert convolutions[0].in_channels == 7


def test_rae_recurrence_is_the_paper_s_equation():
    """h = C(C(C(I) ++ h_prev)), by numpy's slow way through scipy."""
    from scipy.ndimage import correlate

    from models.networks.rae import RecurrentBlock

    torch.manual_seed(1)
    block = RecurrentBlock(2).double()
    x = torch.rand(1, 2, 5, 6).double()
    hidden = torch.rand(1, 2, 5, 6).double()

    def layer(conv, image):
        weight = conv.weight.detach().numpy()
        bias = conv.bias.detach().numpy()
        sums = [sum(correlate(c, k, mode="constant") for c, k in zip(image, w, strict=True)) for w in weight]
        value = np.stack(sums) + bias[:, None, None]
        return np.where(value > 0, value, 0.1 * value)

    merged = np.concatenate([layer(block.input, x[0].numpy()), hidden[0].numpy()])
    expected = layer(block.output, layer(block.merge, merged))
    np.testing.assert_allclose(block(x, hidden)[0].detach().numpy(), expected, atol=1e-12)


def test_rae_state_carries_over(moving_clip, denoisers):
    """Without it the second frame comes out differently."""
    frames = [read_frame(moving_clip, index, denoisers["rae"].reads) for index in (4, 5)]
    outputs, state = play(denoisers["rae"], frames)
    assert isinstance(state, RAEState) and len(state.hidden) == 6
    assert not torch.allclose(outputs[1], run(denoisers["rae"], frames[1:])[0])


def test_rae_inputs_are_the_seven_of_the_paper(moving_clip, denoisers, monkeypatch):
    rae = denoisers["rae"]
    frame = read_frame(moving_clip, 2, rae.reads)
    captured = []
    monkeypatch.setattr(rae.network, "forward", lambda x, h: (captured.append(x), (x[:, :3], (x,) * 6))[1])
    _, state = rae(frame, None)
    (x,) = captured
    irradiance = (frame.direct + frame.indirect) / frame.albedo.clamp(min=0.01)
    torch.testing.assert_close(x[:, :3], (irradiance * state.scale.exposure()) ** 0.2)
    # View-space normals from Mitsuba's frame: x to the right is minus its x.
    local = torch.einsum("ij,jhw->ihw", torch.linalg.inv(frame.now.camera_to_world[0, :3, :3]).float(), frame.normal[0])
    torch.testing.assert_close(x[0, 3], -local[0])
    torch.testing.assert_close(x[0, 4], local[1])
    median = frame.depth[frame.depth > 0].median()
    torch.testing.assert_close(x[:, 5:6], frame.depth / (frame.depth + median), rtol=1e-4, atol=1e-5)
    assert (x[:, 6] == 1).all() and x.shape[1] == 7


# --- Weights ----------------------------------------------------------------------------------------------------------


def test_weights_round_trip(tmp_path, denoisers):
    path = tmp_path / "w.safetensors"
    save_weights(denoisers["rae"], "rae", {"epochs": 3}, path)
    loaded = load("rae", path, torch.float32)
    torch.testing.assert_close(dict(loaded.state_dict()), dict(denoisers["rae"].state_dict()), rtol=0, atol=0)
    assert not loaded.training and list(tmp_path.iterdir()) == [path]


def test_unusable_weights_are_named(tmp_path, denoisers):
    path = tmp_path / "w.safetensors"
    with pytest.raises(BadInput, match="onespp train rae"):
        load("rae", path)
    with pytest.raises(BadInput, match="needs trained weights"):
        load("rae", None)
    path.write_bytes(b"not weights")
    with pytest.raises(BadInput, match="damaged"):
        load("rae", path)
    save_weights(denoisers["rae"], "wskp6", {}, path)
    with pytest.raises(BadInput, match="'wskp6', not of 'rae'"):
        load("rae", path)
    small = RAE()
    small.network = torch.nn.Conv2d(7, 3, 1)
    save_weights(small, "rae", {}, path)
    with pytest.raises(BadInput, match="another shape"):
        load_weights(RAE(), "rae", path)
    with pytest.raises(BadInput, match=r"unknown denoiser 'oidnn'.*accumulated"):
        registry.create("oidnn")
