"""OIDN as a denoiser: its inputs and outputs, settings and errors."""

import sys

import pytest
import torch

from datasets.clip import Dataset
from datasets.frame import Frame, read_frame
from errors import BadInput
from models import registry
from models.filters.oidn import OIDN, OIDNAccumulated, OIDNFast, OIDNIrradiance
from models.spec import load
from tests.helpers.frames import flat_frame, run

pytest.importorskip("pyoidn")

CHANNELS = (*OIDNAccumulated.reads, "direct_reference", "indirect_reference")


def error(radiance: torch.Tensor, frame: Frame) -> float:
    truth = frame.remodulate(frame.reference_irradiance("total"), "total")
    return float((radiance.clamp(max=2) - truth.clamp(max=2)).square().mean())


def noisy_wall(height: int, width: int, level: float = 1.0) -> Frame:
    """One pixel in four lit, `level` in the mean."""
    lit = torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(0)) < 0.25
    return flat_frame(height, width, irradiance=(4 * level * lit).repeat(1, 3, 1, 1).clamp(max=65504.0))


def test_denoises_and_accumulation_helps(tiny):
    still = Dataset(tiny).clips("test")[0]
    frames = [read_frame(still, index, CHANNELS) for index in range(6)]
    noisy, plain, accumulated = (run(registry.create(n), frames)[-1] for n in ("noisy", "oidn", "oidn-accumulated"))
    assert error(plain, frames[-1]) < 0.2 * error(noisy, frames[-1])
    assert error(accumulated, frames[-1]) < error(plain, frames[-1])


def test_quality_is_a_setting(moving_clip):
    frame = read_frame(moving_clip, 0, CHANNELS)
    high, fast = (denoiser(frame, None)[0] for denoiser in (OIDN(), OIDNFast()))
    assert not torch.equal(high, fast)
    assert error(fast, frame) < 0.3 * error(frame.radiance("total"), frame)


@pytest.mark.parametrize("kind", [OIDN, OIDNFast])
def test_any_level_of_light(kind):
    """A noisy wall comes out at its mean level, from almost no light to the most that float16 holds."""
    denoiser = kind()
    for level in (1e-7, 1e-3, 1.0, 65504.0):
        frame = noisy_wall(64, 64, level / 4)
        output, _ = denoiser(frame, None)
        assert torch.isfinite(output).all() and (output >= 0).all()
        assert output.mean().item() == pytest.approx(frame.direct.mean().item(), rel=0.25)


def test_brightness_scales(moving_clip):
    frame = read_frame(moving_clip, 0, CHANNELS)
    bright = frame.with_channels({name: 1000 * frame.channel(name) for name in ("direct", "indirect", "emission")})
    output, thousandfold = (OIDN()(f, None)[0] for f in (frame, bright))
    torch.testing.assert_close(1000 * output, thousandfold, rtol=1e-2, atol=1e-2)


def test_it_gets_the_beauty_or_irradiance():
    """With the lamp; irradiance does not depend on texture."""
    lamp = noisy_wall(16, 16)
    lamp.emission[..., 8:] = 50.0
    inputs = []
    for kind in (OIDN, OIDNIrradiance):
        denoiser = kind()
        denoiser(lamp, None)
        inputs.append([denoiser.filter.images[name].permute(2, 0, 1)[None] for name in ("color", "albedo")])
    (beauty, albedo), (irradiance, ones) = inputs
    torch.testing.assert_close(beauty, lamp.direct + lamp.emission)
    torch.testing.assert_close(albedo, lamp.albedo)
    torch.testing.assert_close(irradiance, lamp.direct / lamp.albedo + lamp.emission)
    assert (ones == 1).all()
    assert (OIDN(signal="indirect")(lamp, None)[0] < 0.1).all()  # all light is direct


def test_pixels_below_zero_count_as_black():
    black = noisy_wall(20, 24)
    poisoned = noisy_wall(20, 24)
    black.direct[0, :, 5, 6] = 0
    poisoned.direct[0, :, 5, 6] = -5.0
    for denoiser in (OIDN(), OIDNAccumulated()):
        torch.testing.assert_close(denoiser(poisoned, None)[0], denoiser(black, None)[0])


def test_the_filter_is_made_once_a_size_and_thread_count(monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    denoiser = OIDNFast()
    filters = []
    for size in ((20, 30), (20, 30), (30, 20), (30, 20)):
        denoiser(flat_frame(*size), None)
        filters.append(denoiser.filter)
    assert filters[0] is filters[1] and filters[2] is filters[3] and filters[1] is not filters[2]
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    denoiser(flat_frame(30, 20), None)
    assert denoiser.filter is not filters[3] and denoiser.filter.device.get_int("numThreads") == 1


def test_outputs_are_not_overwritten_by_the_next_frame():
    denoiser = OIDNFast()
    first, _ = denoiser(noisy_wall(16, 16), None)
    kept = first.clone()
    denoiser(noisy_wall(16, 16, 9.0), None)
    assert torch.equal(first, kept)


def test_native_objects_are_released(monkeypatch):
    import pyoidn

    released = []
    for kind in (pyoidn.Device, pyoidn.Filter):
        monkeypatch.setattr(kind, "release", lambda self, kind=kind, r=kind.release: (released.append(kind), r(self)))
    denoiser = OIDNFast()
    denoiser(flat_frame(4, 4), None)
    del denoiser
    assert released == [pyoidn.Filter, pyoidn.Device]


def test_missing_or_broken_oidn_is_a_clear_error(monkeypatch):
    assert registry.prototype("oidn").unavailable() is None and registry.prototype("noisy").unavailable() is None
    monkeypatch.setattr("pyoidn.Device.get_error", lambda self: "unsupported hardware")
    assert "unsupported hardware" in registry.prototype("oidn").unavailable()
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    for name in ("oidn", "oidn-accumulated"):
        assert "pip install 'onespp[oidn]'" in registry.prototype(name).unavailable()
        with pytest.raises(BadInput, match=r"pip install 'onespp\[oidn\]'"):
            load(name, None)
        with pytest.raises(BadInput, match=r"pip install 'onespp\[oidn\]'"):
            registry.create(name)(flat_frame(4, 4), None)
    assert registry.channels_read(["oidn"])
