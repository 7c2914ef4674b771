"""The weights that are shipped: small together, each with a card, and each of a network that denoises with them."""

import hashlib
import json
import tomllib
from fnmatch import fnmatch

import pytest
import torch
from safetensors import safe_open

from errors import BadInput
from models import registry
from models.registry import SHIPPED_FOLDER, require_shipped, shipped_names, shipped_weights
from models.spec import load
from provenance import ROOT
from tests.helpers.frames import flat_frame, run

FILES = sorted(SHIPPED_FOLDER.iterdir())
WEIGHTS = [path for path in FILES if path.suffix == ".safetensors"]
TOGETHER = 20e6  # bytes at most


def test_they_are_small_and_each_has_a_card():
    assert WEIGHTS and sum(path.stat().st_size for path in FILES) <= TOGETHER
    assert {path.name for path in FILES} == {
        path.stem + end for path in WEIGHTS for end in (".safetensors", ".md", ".json")
    }
    assert shipped_names() == [name for name in registry.DENOISERS if SHIPPED_FOLDER / f"{name}.safetensors" in WEIGHTS]
    assert len(shipped_names()) == len(WEIGHTS)


def test_an_installed_package_has_them():
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["models"]
    for path in FILES:
        assert any(fnmatch(str(path.relative_to(ROOT / "models")), pattern) for pattern in patterns)


@pytest.mark.parametrize("path", WEIGHTS, ids=lambda path: path.stem)
def test_they_denoise(path):
    """A grey wall in even light stays finite and about as bright, and history does not spoil it."""
    denoiser = load(path.stem, path, torch.float32)
    frames = [flat_frame(24, 40, irradiance=0.5 * torch.ones(1, 3, 24, 40)) for _ in range(3)]
    for frame in frames:
        frame.channels["indirect"] = frame.channels["direct"]
    for output, frame in zip(run(denoiser, frames), frames, strict=True):
        assert torch.isfinite(output).all() and (output >= 0).all()
        assert output.mean() == pytest.approx(float(frame.radiance(denoiser.signal).mean()), rel=0.5)


@pytest.mark.slow
def test_one_neither_drifts_nor_burns_in():
    """1 000 frames of a still wall in a light that fades to one side, as noisy as path tracing: error does not grow."""
    height, width = 48, 64
    light = torch.linspace(0.1, 2.0, width).expand(1, 3, height, width)
    generator = torch.Generator().manual_seed(0)
    denoiser = load("one", shipped_weights("one"), torch.float32)
    state = None
    errors = []
    biases = []
    for _ in range(1000):
        noise = torch.exp(1.5 * torch.randn(1, 3, height, width, generator=generator) - 1.125)
        frame = flat_frame(height, width, irradiance=light * noise)
        with torch.inference_mode():
            output, state = denoiser(frame, state)
        difference = output - light * frame.divisor
        errors.append(float(difference.square().mean()))
        biases.append(float(difference.mean()))
    assert sum(errors[-200:]) <= sum(errors[50:250])
    assert abs(sum(biases[-200:])) <= 200 * 0.1 * float((light * frame.divisor).mean())


@pytest.mark.parametrize("path", WEIGHTS, ids=lambda path: path.stem)
def test_cards_agree_with_the_files(path):
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
        parameters = sum(file.get_tensor(name).numel() for name in file.keys())  # noqa: SIM118 - it is no dictionary
    recipe = json.loads(metadata["recipe"])
    card = path.with_suffix(".md").read_text()
    words = " ".join(card.split())
    assert metadata["denoiser"] == path.stem and "constants" not in metadata
    assert card.startswith(f"# {path.stem}\n") and "## Limitations" in card
    assert f"{parameters} parameters, {path.stat().st_size} bytes" in words
    assert hashlib.sha256(path.read_bytes()).hexdigest() in words
    assert f"`onespp train {path.stem} --budget {recipe['profile']} --seed {recipe['seed']}`" in words
    assert f"generator version {recipe['data']['generator']}, {len(recipe['data']['scenes'])} scenes" in words
    assert f"of step {recipe['step']}," in words and f"{recipe['validation']:.4g}" in words
    stated = json.loads(card.partition("- Recipe: `")[2].partition("`.\n")[0])
    assert stated.items() <= recipe.items() and {"loss", "rate", "batch", "epochs"} <= stated.keys()
    licence = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    assert f"Licence: {licence}." in words
    for name in ("noisy", "accumulated", path.stem, "(noise floor)"):
        assert f"\n| {name} " in card


def test_names_stand_for_their_files(shipped):
    (shipped / "kp.safetensors").write_bytes(b"")
    assert shipped_names() == ["kp"]
    assert shipped_weights("kp") == require_shipped("kp") == shipped / "kp.safetensors"
    assert shipped_weights("svgf") is None and shipped_weights("wskp6-2w") is None
    with pytest.raises(BadInput, match="no weights of 'rae' are shipped; those are kp"):
        require_shipped("rae")
