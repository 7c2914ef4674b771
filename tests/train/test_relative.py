"""The loss for noisy targets: its minimiser is the mean, its value unbiased, and every network can be trained by it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from datasets.clip import Dataset
from datasets.frame import Frame
from models.networks.rae import RAE, raised
from models.networks.wskp import WSKP
from models.registry import create
from tests.helpers.frames import flat_frame
from tests.helpers.training import predict_as, short_task, tensors
from train.crops import Crops
from train.data import items, loader
from train.loop import train_network
from train.losses.network_loss import NetworkLoss
from train.losses.relative import RelativeLoss
from train.losses.wskp import SMAPELoss
from train.recipes import recipe_for
from train.sequences import Batch

SIZE = 64
MEAN = 0.3  # of the noisy targets' radiance


def noisy_frame(sigma: float = 1.0, seed: int = 0) -> Frame:
    """Both buffers of the reference are log-normal noise around MEAN, white and constant in truth."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(1, 2, 3, SIZE, SIZE, generator=generator)
    buffers = MEAN * torch.exp(sigma * normal - sigma**2 / 2)
    frame = flat_frame(SIZE, SIZE)
    light = {"direct_reference": buffers, "indirect_reference": torch.zeros_like(buffers)}
    return replace(frame, channels=frame.channels | light)


def crops_of(frame: Frame) -> Crops:
    return Crops(frame, torch.zeros_like(frame.albedo), torch.tensor([[np.log(0.18), 0.0]]).float())


def fitted(loss: NetworkLoss, batch: Batch | Crops, parameter: torch.nn.Parameter) -> float:
    """What a network that returns one constant, `parameter`, learns from a batch."""
    optimiser = torch.optim.Rprop([parameter], lr=0.02)  # goes by the sign of the slope alone
    for _ in range(100):
        optimiser.zero_grad()
        loss(batch)[0].backward()
        optimiser.step()
    return parameter.item()


def constant(monkeypatch, network: WSKP | RAE, frame: Frame, value: float) -> torch.nn.Parameter:
    """Let a network return one constant, the parameter, whatever the frame."""
    parameter = torch.nn.Parameter(torch.tensor(value))
    if isinstance(network, WSKP):
        monkeypatch.setattr(network, "filter", lambda f, *_: (parameter.expand(f.albedo.shape), None))
    else:
        _, state = network.predict(replace(frame, whole=torch.tensor([[np.log(0.18), 0.0]]).float()), None)
        monkeypatch.setattr(network, "predict", lambda f, _: (parameter.expand(f.albedo.shape), state))
    return parameter


def test_the_minimiser_is_the_mean_of_noisy_targets_unlike_that_of_smape(monkeypatch):
    frame = noisy_frame()
    mean = frame.direct_reference.mean().item()
    wskp = WSKP()
    parameter = constant(monkeypatch, wskp, frame, 0.05)
    assert fitted(NetworkLoss(wskp, RelativeLoss()), crops_of(frame), parameter) == pytest.approx(mean, rel=0.002)
    assert mean == pytest.approx(MEAN, rel=0.02)
    assert fitted(NetworkLoss(wskp, SMAPELoss()), crops_of(frame), parameter) < 0.9 * MEAN


@pytest.mark.parametrize("start", [-0.2, 0.0, 1.5])
def test_rae_s_raw_output_finds_the_mean_from_anywhere(monkeypatch, start):
    """Also from below 0, where the power's own gradient is none."""
    frame = noisy_frame()
    rae = RAE()
    parameter = constant(monkeypatch, rae, frame, start)
    mean = frame.direct_reference.mean().item()
    assert fitted(NetworkLoss(rae, RelativeLoss()), Batch([frame]), parameter) ** 5 == pytest.approx(mean, rel=0.01)


def test_raising_is_the_power_with_a_slope_that_does_not_vanish():
    p = torch.tensor([-3.0, 0.0, 0.1, 0.5, 2.0], dtype=torch.float64, requires_grad=True)
    value = raised(p)
    torch.testing.assert_close(value.detach(), torch.tensor([0, 0, 1e-5, 0.5**5, 32.0], dtype=torch.float64))
    value.sum().backward()
    floor = 5 * 0.01**0.8
    torch.testing.assert_close(p.grad, torch.tensor([floor, floor, floor, 5 * 0.5**4, 80.0], dtype=torch.float64))


@pytest.mark.parametrize("sigma", [0.3, 1.5])
def test_the_value_does_not_count_the_noise_of_the_reference(monkeypatch, sigma):
    """The error of a constant against the truth, though both buffers are noisy; its gradient is that of (f - y)²."""
    guess = 0.25
    values = []
    plain = []
    for seed in range(16):
        frame = noisy_frame(sigma, seed)
        wskp = WSKP()
        parameter = constant(monkeypatch, wskp, frame, guess)
        value, _ = NetworkLoss(wskp, RelativeLoss())(crops_of(frame))
        value.backward()
        target = frame.direct_reference.mean(dim=1)
        squared = (parameter - target) ** 2 / (guess + 0.01) ** 2
        (slope,) = torch.autograd.grad(squared.mean(), parameter)
        assert parameter.grad.item() == pytest.approx(slope.item(), rel=1e-4)
        values.append(value.item())
        plain.append(squared.mean().item())
    true = (guess - MEAN) ** 2 / (guess + 0.01) ** 2
    uncertainty = np.std(values, ddof=1) / len(values) ** 0.5
    assert abs(np.mean(values) - true) < 4 * uncertainty and uncertainty < 0.2 * np.mean(plain)
    assert np.mean(plain) > true + 10 * uncertainty


@pytest.fixture(scope="module")
def batch(tiny, tmp_path_factory) -> Batch:
    recipe = replace(recipe_for("rae", "tiny"), length=3)
    denoiser = create("rae")
    data = items(Dataset(tiny).clips("val"), recipe, denoiser, False, 0, tmp_path_factory.mktemp("cache"))
    return next(iter(loader(data, [[0, 1]])))


def test_the_loss_of_a_sequence_by_hand(batch, monkeypatch):
    """In numpy and float64: radiance with emission, as exposed and gained, weighted by frame, over surfaces."""
    rae = RAE()
    generator = torch.Generator().manual_seed(0)
    gain = torch.tensor([0.5, 1.0, 2.0])[None, :, None, None]
    predicted = predict_as(
        monkeypatch, rae, lambda frame, _: torch.rand(frame.albedo.shape, generator=generator) * 1.5 - 0.2
    )
    frames = [replace(frame, colour_gain=gain.expand(2, 3, 1, 1)) for frame in batch.frames]
    weights = (0.2, 0.5, 1.0)
    value, parts = NetworkLoss(rae, RelativeLoss(temporal=0.7, frames=weights))(Batch(frames))

    spatial = []
    temporal = []
    before = None
    for frame, (p, scale) in zip(frames, predicted, strict=True):
        albedo, emission, p, exposure = (
            x.double().numpy() for x in (frame.albedo.clamp(min=0.01), frame.emission, p, scale.exposure() * gain)
        )
        f = np.maximum(p, 0) ** 5 * albedo + exposure * emission
        buffers = (frame.direct_reference + frame.indirect_reference).double().numpy()
        a, b = (f - exposure * (buffers[:, which] + emission) for which in (0, 1))
        surface = np.broadcast_to(frame.depth.numpy() > 0, f.shape)

        def mean(x: np.ndarray, surface: np.ndarray = surface) -> float:
            return float(np.mean([x[item][surface[item]].mean() for item in range(2)]))

        spatial.append(mean(a * b / (f + 0.01) ** 2))
        if before is not None:
            temporal.append(mean((a - before[0]) * (b - before[1]) / (f + 0.01) ** 2))
        before = a, b
    expected_spatial = np.average(spatial, weights=weights)
    expected_temporal = np.average(temporal, weights=weights[1:])
    assert parts["spatial"].item() == pytest.approx(expected_spatial, rel=1e-4)
    assert parts["temporal"].item() == pytest.approx(expected_temporal, rel=1e-4)
    assert value.item() == pytest.approx(expected_spatial + 0.7 * expected_temporal, rel=1e-4)


def test_what_ntd_makes_negative_still_learns(monkeypatch):
    """The error is that of the output below 0; the scale that divides it is that of what is shown."""
    frame = noisy_frame(0.1)
    wskp = WSKP()
    parameter = constant(monkeypatch, wskp, frame, -0.01)  # where f + epsilon would be 0
    value, _ = NetworkLoss(wskp, RelativeLoss())(crops_of(frame))
    value.backward()
    assert value.item() == pytest.approx((0.31 / 0.01) ** 2, rel=0.01) and parameter.grad < 0


def test_a_training_by_it_ends_with_weights(tiny, tmp_path):
    recipe: dict[str, object] = {"epochs": 1, "loss": RelativeLoss(), "clip": 1.0, "crops": (2, 1)}
    weights = train_network(short_task("wskp6", tiny, tmp_path, **recipe))
    assert all(torch.isfinite(tensor).all() for tensor in tensors(weights).values())
