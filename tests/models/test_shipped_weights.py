"""The weights that are shipped: small together, each with a card, and each of a network that denoises with them."""

import tomllib
from copy import deepcopy
from fnmatch import fnmatch

import numpy as np
import pytest
import torch

from errors import BadInput
from models import registry
from models.networks.rae import RAE, RecurrentBlock
from models.registry import SHIPPED_FOLDER, require_shipped, shipped_names, shipped_weights
from models.spec import load
from models.weights import read_metadata
from provenance import ROOT
from tests.helpers.frames import flat_frame, run
from tests.helpers.training import tensors

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


@torch.no_grad()
def growth(block: RecurrentBlock, height: int, width: int, frames: int = 30) -> float:
    """By what factor hidden features grow a frame in the end, by power iteration.

    Without biases and input: what large features do, since all that is left is proportional to them.
    """
    block = deepcopy(block)
    for layer in (block.input, block.merge, block.output):
        layer.bias.zero_()
    torch.manual_seed(0)
    hidden = torch.randn(1, block.output.out_channels, height, width)
    norms = []
    for _ in range(frames):
        hidden = block(torch.zeros_like(hidden), hidden / hidden.norm())
        norms.append(float(hidden.norm()))
    return float(np.exp(np.log(norms[-10:]).mean()))


@pytest.mark.parametrize("size", [(2, 2), (12, 20), pytest.param((40, 40), marks=pytest.mark.slow)])
def test_what_rae_carries_fades_at_every_resolution(size):
    """At 640 x 360 the coarsest features are 20 x 12 pixels; of a training crop of 64 x 64, 2 x 2."""
    rae = load("rae", shipped_weights("rae"), torch.float32)
    assert isinstance(rae, RAE)
    for block in rae.network.recurrent:
        factor = growth(block, *size)
        assert factor < 0.95
        block.merge.weight.data *= 3
        assert growth(block, *size) == pytest.approx(3 * factor, rel=0.1)


@pytest.mark.slow
def test_one_neither_drifts_nor_burns_in():
    """1 000 frames of a still wall in a light that fades to one side, as noisy as path tracing: error does not grow."""
    height, width = 48, 64
    light = torch.linspace(0.1, 2.0, width).expand(1, 3, height, width)
    generator = torch.Generator().manual_seed(0)
    noise = (torch.exp(1.5 * torch.randn(1, 3, height, width, generator=generator) - 1.125) for _ in range(1000))
    frames = (flat_frame(height, width, irradiance=light * factor) for factor in noise)
    difference = torch.cat(run(load("one", shipped_weights("one"), torch.float32), frames)) - light
    errors = difference.square().mean(dim=(1, 2, 3))
    assert errors[-200:].sum() <= errors[50:250].sum()
    assert difference[-200:].mean().abs() <= 0.1 * light.mean()


@pytest.mark.parametrize("path", WEIGHTS, ids=lambda path: path.stem)
def test_cards_have_all_their_parts(path):
    """Their facts are those of tests/eval/test_shipped.py."""
    metadata = read_metadata(path)
    card = path.with_suffix(".md").read_text()
    licence = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["license"]
    assert card.startswith(f"# {path.stem}\n") and "## Limitations" in card and f"Licence: {licence}." in card
    assert "constants" not in metadata
    assert metadata["recipe"]["parameters"] == sum(tensor.numel() for tensor in tensors(path).values())
    for name in ("noisy", "accumulated", path.stem, "(noise floor)"):
        assert f"\n| {name} " in card


def test_names_stand_for_their_files(shipped):
    (shipped / "kp.safetensors").write_bytes(b"")
    assert shipped_names() == ["kp"]
    assert shipped_weights("kp") == require_shipped("kp") == shipped / "kp.safetensors"
    assert shipped_weights("svgf") is None and shipped_weights("wskp6-2w") is None
    with pytest.raises(BadInput, match="no weights of 'rae' are shipped; those are kp"):
        require_shipped("rae")
