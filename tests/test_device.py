"""Denoisers on another device than the CPU, as far as a machine without a GPU can show it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import onespp
from datasets.clip import Dataset
from denoise.job import Job
from denoise.run import denoise
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from eval.harness import compile_kernels, evaluate_clip, named_denoisers
from models.registry import DENOISERS
from models.spec import DenoiserSpec
from tests.helpers import foreign
from tests.helpers.denoisers import each
from tests.helpers.frames import run
from tests.helpers.other_device import Other, other_device

WRAPPED = ("svgf+js", "wskp6+adaptive", "ntd+taa")
FRAMES = [synthetic_frame(index, 24, 32) for index in range(2)]
OFTEN = ("accumulated", "wskp6", "ntd", "rae", "one")
NAMES = [*(name for name in DENOISERS if "oidn" not in name), *WRAPPED]


@pytest.mark.parametrize("name", each(NAMES, *(name for name in NAMES if name not in OFTEN)))
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


def test_denoise_and_its_error_estimate_on_a_device(tmp_path):
    for which, folder in enumerate("ab"):
        foreign.write_sequence(tmp_path / folder, [frame.buffer(which) for frame in FRAMES], foreign.blender)
    patterns = [(str(tmp_path / folder / "*.exr"),) for folder in "ab"]
    job = Job(patterns[0], "eaw+js", tmp_path / "cpu", buffer_b=patterns[1], error=True)
    denoise(job)
    with other_device() as device:
        denoise(replace(job, out=tmp_path / "other", device=device))
    for path in (tmp_path / "cpu").glob("*.exr"):
        found = foreign.read(tmp_path / "other" / path.name)
        for name, plane in foreign.read(path).items():
            np.testing.assert_allclose(found[name], plane, rtol=1e-2, atol=1e-3)


def test_kernels_are_compiled_for_denoisers_of_a_device():
    with other_device() as device:
        compile_kernels(DenoiserSpec.named("wskp3", device=device))


def test_evaluation_on_a_device(tiny, tmp_path):
    clip = Dataset(tiny).clips("test")[0]
    with other_device() as device:
        specs = [DenoiserSpec.named("eaw", device=each) for each in ("cpu", device)]
        results = [evaluate_clip(clip, named_denoisers([spec]), tmp_path, quiet=True)[0] for spec in specs]
    assert results[0].key != results[1].key
    assert results[1].metrics["rmse"] == pytest.approx(results[0].metrics["rmse"], rel=1e-4)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_missing_device_is_named():
    with pytest.raises(BadInput, match="no CUDA device"):
        onespp.load("svgf", device="cuda")
