"""What is written: precision, constant channels, damage control, and all or nothing."""

import json
from pathlib import Path

import numpy as np
import pytest

from datasets.channels import CHANNELS
from datasets.clip import Clip
from datasets.tonemap import clip_exposure, display
from datasets.writer import ClipWriter

LENGTHS = {"F": 4, "S": 2, "H": 3, "W": 5, "M": 2}  # of the axes of the channel table


def random_frames(seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Arrays of every channel, of plausible size; colours between 0.1 and 2."""
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(LENGTHS["F"]):
        frame = {}
        for name, channel in CHANNELS.items():
            shape = channel.shape(**LENGTHS)[1:]
            frame[name] = rng.uniform(0.1, 2, shape) if channel.dtype != "<u2" else rng.integers(0, 9, shape)
        frames.append(frame)
    return frames


def write(path: Path, frames: list[dict[str, np.ndarray]], derived: dict[str, str] | None = None) -> Clip:
    with ClipWriter(path) as writer:
        for frame in frames:
            writer.add(frame, {"step": 0.5})
        writer.finish({"noisy_spp": 1, "reference_spp": 8, "meshes": ["a", "b"]}, derived or {})
    return Clip(path)


def test_round_trip_of_every_channel(tmp_path):
    frames = random_frames()
    clip = write(tmp_path / "clip", frames)
    for name, channel in CHANNELS.items():
        entry = clip.channels[name]
        assert entry["dtype"] == channel.dtype and entry["shape"] == channel.shape(**LENGTHS)
        raw = np.load(tmp_path / "clip" / f"{name}.npy")
        assert raw.dtype == np.dtype(channel.dtype)
        expected = np.stack([frame[name] for frame in frames]).astype(channel.dtype)
        np.testing.assert_array_equal(raw, expected)
        if channel.is_image:
            for realisation in range(LENGTHS["S"] if "S" in channel.axes else 1):
                got = clip.read(name, 2, realisation=realisation)
                want = expected[2, realisation] if "S" in channel.axes else expected[2]
                np.testing.assert_array_equal(got, want)
    assert isinstance(clip.map("direct"), np.memmap)
    assert not list(tmp_path.glob(".*")) and not list((tmp_path / "clip").glob("*.raw"))


def test_windows_cut_every_kind_of_storage_alike(tmp_path):
    frames = random_frames()
    for frame in frames:
        frame["roughness"][:] = 0.25
        frame["direct_reference"][:] = 0.5
    clip = write(tmp_path / "clip", frames)
    window = (slice(1, 3), slice(2, 5))
    for name, channel in CHANNELS.items():
        if channel.is_image:
            np.testing.assert_array_equal(clip.read(name, 1, window), clip.read(name, 1)[..., 1:3, 2:5, :])


def test_constant_channels_are_one_value(tmp_path):
    frames = random_frames()
    for frame in frames:
        frame["albedo"][:] = [0.1, 0.2, 0.3]
    for frame in frames[2:]:
        frame["roughness"][:] = 1
    clip = write(tmp_path / "clip", frames)
    assert clip.channels["albedo"] == {"value": [float(np.float16(x)) for x in (0.1, 0.2, 0.3)]}
    everywhere = np.broadcast_to(np.float16([0.1, 0.2, 0.3]), (LENGTHS["H"], LENGTHS["W"], 3))
    np.testing.assert_array_equal(clip.read("albedo", 1), everywhere)
    assert "file" in clip.channels["roughness"]  # constant in two frames is not constant


@pytest.mark.parametrize(
    ("value", "dtype"), [(65504.0, "<f2"), (65520.0, "<f4"), (1e30, "<f4"), (1e-8, "<f4"), (3e-6, "<f4"), (1e-3, "<f2")]
)
def test_radiance_is_float32_where_float16_would_lose(tmp_path, value, dtype):
    frames = random_frames()
    for frame in frames:
        frame["indirect"] *= value / 2 if value > 1 else value
    frames[1]["indirect"][0, 0, 0] = value
    clip = write(tmp_path / "clip", frames)
    assert clip.channels["indirect"]["dtype"] == dtype
    np.testing.assert_allclose(clip.read("indirect", 1)[0, 0], value, rtol=1e-3)
    assert clip.facts["clamped"]["indirect"] == 0


@pytest.mark.parametrize("value", [1e-8, 0.25, 65504.0, 1e5])
def test_constant_radiance_keeps_its_value(tmp_path, value):
    frames = random_frames()
    for frame in frames:
        frame["emission"][:] = value
    clip = write(tmp_path / "clip", frames)
    assert "value" in clip.channels["emission"]
    np.testing.assert_allclose(clip.read("emission", 1), value, rtol=1e-6)


@pytest.mark.parametrize(("where", "factor", "dtype"), [((2,), 1e-7, "<f4"), ((0, 0, 0), 1e-9, "<f2")])
def test_a_dark_frame_needs_float32_and_a_few_tiny_values_do_not(tmp_path, where, factor, dtype):
    frames = random_frames()
    frame, *pixels = where
    frames[frame]["direct"][tuple(pixels)] *= factor
    assert write(tmp_path / "clip", frames).channels["direct"]["dtype"] == dtype


def test_what_is_not_finite_is_zeroed_and_what_is_too_large_clamped(tmp_path):
    frames = random_frames()
    frames[0]["direct"][1, 0, 0, :2] = [np.nan, np.inf]
    frames[2]["indirect_reference"][0, 1, 1, 1] = -np.inf
    frames[0]["normal"][0, 0] = [1e5, -1e5, 0]
    clip = write(tmp_path / "clip", frames)
    assert {name: n for name, n in clip.facts["nonfinite"].items() if n} == {"direct": 2, "indirect_reference": 1}
    assert {name: n for name, n in clip.facts["clamped"].items() if n} == {"normal": 2}
    np.testing.assert_array_equal(clip.read("direct", 0, realisation=1)[0, 0, :2], 0)
    np.testing.assert_array_equal(clip.read("normal", 0)[0, 0], [65504, -65504, 0])
    assert np.isfinite(clip.exposure) and np.isfinite(clip.facts["floor_mse"])


def test_leaving_early_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="renderer"), ClipWriter(tmp_path / "split" / "clip") as writer:
        writer.add(random_frames()[0], {})
        raise RuntimeError("renderer")
    assert list((tmp_path / "split").iterdir()) == []


def test_facts(tmp_path):
    frames = random_frames()
    clip = write(tmp_path / "clip", frames)
    facts = json.loads((tmp_path / "clip" / "clip.json").read_text())
    assert facts["complete"] is True and (facts["frames"], facts["height"], facts["width"]) == (4, 3, 5)
    assert json.loads((tmp_path / "clip" / "timing.json").read_text()) == {"step": 2.0}
    total = np.stack([f["direct_reference"].mean(0) + f["indirect_reference"].mean(0) for f in frames]).astype("<f4")
    y = total @ [0.2126, 0.7152, 0.0722]
    assert clip.exposure == pytest.approx(min(0.18 / np.exp(np.log(y).mean()), 1 / np.percentile(y, 95)), rel=1e-6)
    a, b = ([f["direct_reference"][h] + f["indirect_reference"][h] + f["emission"] for f in frames] for h in (0, 1))
    shown = [np.clip(clip.exposure * np.stack(x), 0, 1) ** (1 / 2.2) for x in (a, b)]
    assert clip.facts["floor_mse"] == pytest.approx(((shown[0] - shown[1]) ** 2).mean() / 4, rel=1e-5)


def test_exposure_by_hand():
    assert clip_exposure(np.zeros((2, 3))) == 1
    assert clip_exposure(np.full((2, 3), 0.18)) == pytest.approx(1)
    assert clip_exposure(np.full((2, 3), 1e-7)) == pytest.approx(1.8e6)
    # A dark room with one lamp: a tenth of the pixels at 100. The geometric mean alone would clip the lamp.
    assert clip_exposure(np.array([0.01] * 90 + [100.0] * 10)) == pytest.approx(1 / 100)
    # Zeros count as 1e-4 of the mean.
    assert clip_exposure(np.array([0.0, 2.0] * 50)) == pytest.approx(min(0.18 / np.sqrt(1e-4 * 2), 1 / 2))
    np.testing.assert_allclose(display(np.array([-1.0, 0, 0.25, 0.5, 9]), 2.0), [0, 0, 0.5 ** (1 / 2.2), 1, 1])
