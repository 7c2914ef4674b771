"""Losses by hand, the schedule, and that training learns, resumes and refuses as it should."""

import math
import resource
import shutil
import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from scipy.ndimage import gaussian_laplace

from datasets.clip import Dataset
from datasets.sequences import Augmentation, Batch, TrainingSequences, collate
from errors import BadInput
from models.rae import RAE
from train.loop import Training, run_folder, train
from train.losses import RAELoss, laplacian_of_gaussian
from train.recipes import RECIPES, recipe_for


def batch_of(tiny, count: int = 2, crop: int = 32) -> Batch:
    clips = Dataset(tiny).clips("train")
    data = TrainingSequences(clips, RAE.reads, 7, crop, Augmentation(), seed=0)
    return collate([data[index] for index in range(count)])


def test_log_kernel_is_that_of_scipy():
    """The response to an impulse, away from truncation, and to a picture."""
    kernel = laplacian_of_gaussian().numpy()
    impulse = np.zeros((31, 31))
    impulse[15, 15] = 1
    scipy = gaussian_laplace(impulse, 1.5, truncate=8)[8:23, 8:23]
    np.testing.assert_allclose(kernel, scipy, atol=2e-4 * np.abs(scipy).max() + 1e-4)
    assert abs(kernel.sum()) < 1e-12
    picture = np.random.default_rng(0).uniform(0, 1, (40, 50))
    ours = RAELoss(RAE()).edges(torch.from_numpy(picture).float().expand(2, 3, 40, 50))[1, 2].numpy()
    np.testing.assert_allclose(ours, gaussian_laplace(picture, 1.5, mode="nearest"), atol=2e-3)


def test_rae_loss_by_hand(tiny, monkeypatch):
    """With a network that returns known outputs, every term follows from §4.4's equations, in numpy and float64."""
    batch = batch_of(tiny)
    rae = RAE()
    loss = RAELoss(rae)
    outputs, targets = [], []
    generator = torch.Generator().manual_seed(0)
    genuine = RAE.predict

    def predict(frame, state):
        _, state = genuine(rae, frame, state)
        outputs.append(torch.rand(frame.albedo.shape, generator=generator))
        reference = (frame.direct_reference + frame.indirect_reference).mean(dim=1) / frame.albedo.clamp(min=0.01)
        targets.append((state.scale.exposure() * reference) ** 0.2)
        return outputs[-1], state

    monkeypatch.setattr(rae, "predict", predict)
    value, parts = loss(batch)
    weights = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)
    p, t = (torch.stack(x).double().numpy() for x in (outputs, targets))
    error = p - t
    spatial = sum(w * np.abs(e).mean() for w, e in zip(weights, error, strict=True))
    log = np.array([[[gaussian_laplace(c, 1.5, mode="nearest") for c in item] for item in e] for e in error])
    gradient = sum(w * np.abs(e).mean() for w, e in zip(weights, log, strict=True))
    dp, dt = np.diff(p, axis=0), np.diff(t, axis=0)
    temporal = sum(w * np.abs(a - b).mean() for w, a, b in zip(weights[1:], dp, dt, strict=True))
    assert parts["spatial"].item() == pytest.approx(spatial, rel=1e-5)
    assert parts["gradient"].item() == pytest.approx(gradient, rel=5e-3)
    assert parts["temporal"].item() == pytest.approx(temporal, rel=1e-5)
    assert value.item() == pytest.approx(0.8 * spatial + 0.1 * gradient + 0.1 * temporal, rel=1e-3)


def test_gains_scale_input_and_target_alike(tiny):
    batch = batch_of(tiny, 1)
    rae = RAE()
    frame = batch.frames[0]
    _, state = rae.predict(frame, None)
    tinted = replace(frame, gain=torch.tensor([0.5, 1.0, 2.0])[None, :, None, None])
    reference = frame.reference_irradiance("total")
    plain, gained = (rae.compress(reference, state.scale, f) for f in (frame, tinted))
    torch.testing.assert_close(gained, plain * torch.tensor([0.5, 1.0, 2.0])[None, :, None, None] ** 0.2)


@pytest.mark.parametrize("level", [0.0, 1e-7, 1.0, 65504.0])
@pytest.mark.parametrize("gain", [0.0, 1.0, 2.0])
def test_loss_and_gradients_are_finite_at_the_extremes(tiny, level, gain):
    batch = batch_of(tiny, 1)
    for frame in batch.frames:
        for name in ("direct", "indirect", "direct_reference", "indirect_reference"):
            frame.channels[name] = torch.full_like(frame.channels[name], level)
        frame.gain.fill_(gain)
    loss = RAELoss(RAE())
    value, _ = loss(batch)
    value.backward()
    assert torch.isfinite(value)
    assert all(torch.isfinite(p.grad).all() for p in loss.parameters())


def test_gradients_through_time_equal_finite_differences(tiny):
    """The loss of the last frame alone, in float64, along a random change of the first frame's light."""
    batch = batch_of(tiny, 1)
    torch.manual_seed(2)
    loss = RAELoss(RAE()).double()
    loss.denoiser.precision = torch.float64
    loss.frame_weights = (0.0,) * 6 + (1.0,)
    loss.temporal = 0.0  # it would reach one frame back without any recurrence
    for frame in batch.frames:
        frame.channels.update({name: tensor.double() for name, tensor in frame.channels.items()})
        frame.gain.data = frame.gain.double()
        frame.channels["direct"] = frame.direct + 0.1  # away from zero, where the power's slope is infinite
    first = batch.frames[0]
    light = first.direct
    direction = torch.randn_like(light) * light

    def value(step: float) -> torch.Tensor:
        first.channels["direct"] = light + step * direction
        return loss(batch)[0]

    step = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(value(step), step)
    with torch.no_grad():
        # Small, lest it crosses kinks of the rectifiers and of the absolute values; float64 leaves six digits.
        difference = (value(1e-7) - value(-1e-7)) / 2e-7
    assert abs(slope) > 1e-7
    assert slope.item() == pytest.approx(difference.item(), rel=1e-3)


def test_learning_rate_is_the_paper_s():
    recipe = RECIPES["rae", "paper"]
    assert recipe.learning_rate(0) == pytest.approx(1e-4)
    assert recipe.learning_rate(5) == pytest.approx(1e-4 * 10**0.5)
    assert recipe.learning_rate(10) == pytest.approx(1e-3)
    assert recipe.learning_rate(40) == pytest.approx(5e-4)
    assert (recipe.batch, recipe.length, recipe.crop, recipe.epochs, recipe.betas) == (4, 7, 128, 500, (0.9, 0.99))
    assert recipe.augmentation == Augmentation(True, True, True, True)


@pytest.fixture
def short(monkeypatch):
    """A recipe of four short epochs in the tiny profile."""
    monkeypatch.setitem(RECIPES, ("rae", "tiny"), replace(RECIPES["rae", "tiny"], epochs=4, batch=4))


def tensors(path) -> dict[str, torch.Tensor]:
    with safe_open(path, "pt") as file:
        return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118


def test_interrupted_training_resumes_to_equal_weights(tiny, tmp_path, short, monkeypatch):
    """Interrupted in the middle of the third epoch; the weights equal those of an undisturbed run bit for bit."""
    whole = train("rae", tiny, tmp_path / "whole", "tiny", precision="32-true")
    genuine, calls = Training.steps, 0

    def interrupted(self):
        for step in genuine(self):
            nonlocal calls
            calls += 1
            if calls == 2 * len(self.train_data) + 1:
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(Training, "steps", interrupted)
    with pytest.raises(KeyboardInterrupt):
        train("rae", tiny, tmp_path / "resumed", "tiny", precision="32-true")
    folder = run_folder(tmp_path / "resumed", "rae", "tiny")
    assert not (folder / "weights.safetensors").exists()  # unfinished does not look finished
    monkeypatch.setattr(Training, "steps", genuine)
    resumed = train("rae", tiny, tmp_path / "resumed", "tiny", precision="32-true")
    a, b = tensors(whole), tensors(resumed)
    assert a.keys() == b.keys() and all(torch.equal(a[key], b[key]) for key in a)
    # A finished training is left as it is, and another recipe or seed is refused.
    before = resumed.stat().st_mtime_ns
    assert train("rae", tiny, tmp_path / "resumed", "tiny") == resumed and resumed.stat().st_mtime_ns == before
    with pytest.raises(BadInput, match="another recipe, seed or data set"):
        train("rae", tiny, tmp_path / "resumed", "tiny", seed=1)
    with pytest.raises(BadInput, match="a training in 32-true"):
        train("rae", tiny, tmp_path / "resumed", "tiny", precision="bf16-mixed")
    resumed.unlink()
    with pytest.raises(BadInput, match="no weights"):
        train("rae", tiny, tmp_path / "resumed", "tiny")
    checkpoint = folder / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(BadInput, match=r"checkpoint.pt is damaged"):
        train("rae", tiny, tmp_path / "resumed", "tiny")


def test_training_writes_recipe_and_curves(tiny, tmp_path, short):
    weights = train("rae", tiny, tmp_path, "tiny", precision="bf16-mixed")
    with safe_open(weights, "pt") as file:
        metadata = file.metadata()
    assert metadata["denoiser"] == "rae" and '"epochs": 4' in metadata["recipe"] and '"crop": 32' in metadata["recipe"]
    assert list(weights.parent.glob("events.out.tfevents.*"))
    assert all(t.dtype == torch.float32 and torch.isfinite(t).all() for t in tensors(weights).values())


def test_rae_learns_one_batch(tiny):
    """Eighty steps on one batch bring the loss below a third of where it began."""
    torch.manual_seed(0)
    loss = RAELoss(RAE())
    optimiser = torch.optim.Adam(loss.parameters(), 1e-3, betas=(0.9, 0.99))
    batch = batch_of(tiny, 1)
    values = []
    for _ in range(80):
        value, _ = loss(batch)
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        values.append(value.item())
    assert np.mean(values[-5:]) < values[0] / 3


def test_non_finite_losses_are_skipped_counted_and_finally_refused(tiny, tmp_path, short, monkeypatch):
    genuine = RAELoss.forward
    broken: set[int] = {1}
    calls = 0

    def forward(self, batch):
        nonlocal calls
        calls += 1
        value, parts = genuine(self, batch)
        return (value * math.nan if calls in broken or not broken else value), parts

    monkeypatch.setattr(RAELoss, "forward", forward)
    monkeypatch.setattr("train.loop.MOST_SKIPPED_IN_A_ROW", 3)
    training = Training("rae", tiny, tmp_path / "one", "tiny", 0, "32-true")
    training.folder.mkdir(parents=True)
    for _ in training.steps():
        pass
    assert training.skipped == 1
    assert all(torch.isfinite(p).all() for p in training.loss.parameters())
    # A finite loss with a gradient that is not is skipped too.
    before = [p.clone() for p in training.loss.parameters()]
    hook = next(training.loss.parameters()).register_hook(lambda gradient: gradient * math.nan)
    next(training.steps())
    hook.remove()
    assert training.skipped == 2
    assert all(torch.equal(p, q) for p, q in zip(before, training.loss.parameters(), strict=True))
    training.keep_best(math.nan)
    assert not (training.folder / "best.safetensors").exists()
    broken.clear()
    with pytest.raises(BadInput, match="not finite in 3 steps in a row"):
        train("rae", tiny, tmp_path / "all", "tiny", precision="32-true")


def test_unusable_input_is_named(tiny, tmp_path):
    with pytest.raises(BadInput, match="'accumulated' is not a network"):
        recipe_for("accumulated", "tiny")
    with pytest.raises(BadInput, match=r"unknown profile 'huge'.*quick"):
        recipe_for("rae", "huge")
    copy = shutil.copytree(tiny, tmp_path / "copy")
    shutil.rmtree(copy / "val" / "cornell_box")
    with pytest.raises(BadInput, match="'val' are missing"):
        train("rae", copy, tmp_path, "tiny")
    assert not (tmp_path / "train").exists()


def test_full_disk_is_one_clear_line_and_keeps_the_earlier_checkpoint(tiny, tmp_path, short):
    """A limit on file size stands in for a full disk."""
    training = Training("rae", tiny, tmp_path, "tiny", 0, "32-true")
    training.folder.mkdir(parents=True)
    training.save()
    checkpoint = training.folder / "checkpoint.pt"
    before = checkpoint.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))
        with pytest.raises(OSError, match="File too large"):
            training.save()
        with pytest.raises(OSError, match="File too large"):
            training.keep_best(0.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert checkpoint.read_bytes() == before
    assert not [path for path in training.folder.iterdir() if path.name.startswith(".") or "safetensors" in path.name]
