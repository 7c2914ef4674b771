"""Denoisers on another device than the CPU, as far as a machine without a GPU can show it."""

import numpy as np
import pytest
import torch

import onespp
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from models.registry import DENOISERS
from models.spec import DenoiserSpec
from tests.helpers.frames import run
from tests.helpers.other_device import Other, other_device

WRAPPED = ("svgf+js", "wskp6+adaptive", "ntd+taa")
FRAMES = [synthetic_frame(index, 24, 32) for index in range(2)]


@pytest.mark.parametrize("name", [*(name for name in DENOISERS if "oidn" not in name), *WRAPPED])
def test_every_denoiser_computes_on_the_device_of_its_frames(name):
    spec = DenoiserSpec.named(name, compiled=False)
    with spec.running():
        expected = run(spec.build(), FRAMES)
    frames = FRAMES[: 1 if spec.facts.offline else 2]  # each operator takes 50 µs more
    with other_device() as device, torch.inference_mode():
        denoiser = DenoiserSpec.named(name, device=device).build()
        images = run(denoiser, (frame.to(device) for frame in frames))
        assert all(isinstance(image, Other) for image in images)
        for image, reference in zip(images, expected, strict=False):
            torch.testing.assert_close(image.cpu(), reference, rtol=1e-4, atol=1e-5)


def test_the_library_moves_frames_and_results():
    expected = [*onespp.denoise(onespp.load("svgf"), FRAMES)]
    with other_device() as device:
        images = [*onespp.denoise(onespp.load("svgf", device=device), FRAMES)]
    np.testing.assert_allclose(images, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_named():
    with pytest.raises(BadInput, match="no CUDA device"):
        onespp.load("svgf", device="cuda")
