"""Albedo of few samples at random places of the pixel, averaged along motion."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from datasets.frame import Frame
from denoise.job import Job
from denoise.run import denoise
from denoise.supersampling import MOST_BEFORE, AlbedoMean
from tests.helpers import foreign
from tests.helpers.frames import flat_frame

SIZE = (16, 32)
SPEED = 0.3  # pixels per frame, to the right
DARK, BRIGHT = 0.2, 0.8


def edge(frame: int) -> float:
    """Where dark becomes bright, in pixels from the left."""
    return 10.4 + SPEED * frame


def frame_of_edge(number: int, albedo: torch.Tensor) -> Frame:
    """A wall in constant light that moves to the right, with that albedo (H, W)."""
    given = albedo.expand(1, 3, *SIZE).float().contiguous()
    frame = flat_frame(*SIZE, (-SPEED, 0.0))
    return frame.with_channels({"albedo": given, "direct": 2 * given, "indirect": torch.zeros_like(given)})


def sampled(number: int, rng: np.random.Generator) -> torch.Tensor:
    places = np.arange(SIZE[1]) + rng.random(SIZE)
    return torch.from_numpy(np.where(places < edge(number), DARK, BRIGHT))


def coverage(number: int) -> torch.Tensor:
    bright = np.clip(np.arange(SIZE[1]) + 1 - edge(number), 0, 1)
    return torch.from_numpy(DARK + (BRIGHT - DARK) * np.tile(bright, (SIZE[0], 1)))


def test_edges_become_antialiased_and_light_stays_what_it_is():
    rng = np.random.default_rng(0)
    average = AlbedoMean()
    errors = []
    for number in range(24):
        noisy = frame_of_edge(number, sampled(number, rng))
        frame = average.add(noisy)
        torch.testing.assert_close(frame.direct / frame.albedo, torch.full_like(frame.direct, 2.0))
        assert frame.albedo.min() >= DARK - 1e-6 and frame.albedo.max() <= BRIGHT + 1e-6
        truth = coverage(number)
        errors.append([float((each.albedo[0, 0] - truth).square().mean()) for each in (noisy, frame)])
    alone, averaged = np.array(errors)[8:].mean(axis=0)
    # A mean of so many frames, with weights 1 / (MOST_BEFORE + 1) for the newest, has at best this share of the noise.
    assert averaged < 0.5 * alone and averaged > 0.5 * alone / (2 * MOST_BEFORE + 1)


def test_an_exact_albedo_at_rest_stays_exact():
    average = AlbedoMean()
    exact = coverage(0)
    for _ in range(5):
        frame = frame_of_edge(0, exact).with_channels({"motion": torch.zeros(1, 2, *SIZE)})
        torch.testing.assert_close(average.add(frame).albedo, frame.albedo)


def test_what_was_hidden_begins_anew_and_background_is_left_alone():
    average = AlbedoMean()
    before = frame_of_edge(0, torch.full(SIZE, DARK))
    average.add(before)
    depth = before.depth.clone()
    depth[..., :4] = 0
    now = frame_of_edge(1, torch.full(SIZE, BRIGHT)).with_channels({"depth": depth})
    frame = average.add(now)
    # Neighbours show nothing dark: the old albedo is clamped to theirs.
    torch.testing.assert_close(frame.albedo, now.albedo)
    torch.testing.assert_close(frame.direct, now.direct)


def test_all_reflected_light_follows_the_albedo():
    """Sample buffers and parts of the light, too: what is divided by the new albedo must contain it."""
    average = AlbedoMean()
    rng = np.random.default_rng(0)
    for number in range(3):
        frame = frame_of_edge(number, sampled(number, rng))
        buffers = torch.stack([0.5 * frame.direct, 1.5 * frame.direct], dim=1)
        parts = torch.cat([0.25 * frame.direct, 0.75 * frame.direct], dim=1)
        frame = average.add(replace(frame.with_channels({"direct_buffers": buffers}), parts=parts))
    assert not torch.equal(frame.albedo, frame_of_edge(2, coverage(2)).albedo)
    torch.testing.assert_close(frame.direct_buffers.mean(dim=1), frame.direct)
    torch.testing.assert_close(frame.parts[:, :3] + frame.parts[:, 3:], frame.direct)
    torch.testing.assert_close(frame.direct, 2 * frame.albedo)


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 2)])
def test_extremes(size):
    average = AlbedoMean()
    for motion in (0.0, 1e30, -65504.0):
        frame = flat_frame(*size).with_channels({"motion": torch.full((1, 2, *size), motion)})
        frame.albedo[:] = torch.tensor([0.0, 1.0, 0.5]).view(1, 3, 1, 1)
        torch.testing.assert_close(average.add(frame).albedo, frame.albedo)


def test_without_motion_nothing_is_averaged_nor_said_to_be(spheres, tmp_path, capsys):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    for albedo in ("sampled", "exact"):
        denoise(Job((str(tmp_path / "in" / "*.exr"),), "noisy", tmp_path / albedo, albedo=albedo))
    assert "averaged" not in capsys.readouterr().out
    for path in sorted((tmp_path / "exact").glob("*.exr")):
        expected, actual = foreign.read(path), foreign.read(tmp_path / "sampled" / path.name)
        assert all(np.array_equal(actual[name], plane, equal_nan=True) for name, plane in expected.items())


def test_lights_of_a_sampled_albedo_add_up(spheres, tmp_path):
    """Two light groups beside Cycles' passes, denoised with the colour."""
    for index, frame in enumerate(spheres):
        layers = foreign.blender(frame)
        image = layers["ViewLayer.Noisy Image.RGBA"][..., :3]
        lights = {"ViewLayer.Key.RGB": 0.25 * image, "ViewLayer.Fill.RGB": 0.75 * image}
        rng = np.random.default_rng(index)
        layers["ViewLayer.Denoising Albedo.RGB"] *= rng.uniform(0.8, 1, (*image.shape[:2], 1))
        foreign.write(tmp_path / "in" / f"{index}.exr", layers | lights)
    job = Job((str(tmp_path / "in" / "*.exr"),), "one", tmp_path / "out", aov=("ViewLayer.Key", "ViewLayer.Fill"))
    denoise(job)
    for path in sorted((tmp_path / "out").glob("*.exr")):
        planes = foreign.read(path)
        for c in "RGB":
            summed = planes[f"ViewLayer.Key.{c}"] + planes[f"ViewLayer.Fill.{c}"]
            np.testing.assert_allclose(summed, planes[f"ViewLayer.Combined.{c}"], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("albedo", "is_averaged"), [(None, True), ("sampled", True), ("exact", False)])
def test_the_albedo_of_cycles_is_averaged_unless_it_is_exact(spheres, tmp_path, capsys, albedo, is_averaged):
    foreign.write_sequence(tmp_path / "in", spheres, foreign.blender)
    denoise(Job((str(tmp_path / "in" / "*.exr"),), "svgf", tmp_path / "out", albedo=albedo))
    assert ("averaged along the motion" in capsys.readouterr().out) == is_averaged
