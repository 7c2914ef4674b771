"""The precision of inference is the one that this processor is faster in, whatever instructions it has."""

import time

import pytest
import torch
from torch.nn import functional as F

from files import read_json
from models.spec import bfloat16_is_faster, fastest_precision


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    """These tests measure anew and keep their measurements to themselves."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    bfloat16_is_faster.cache_clear()
    yield
    bfloat16_is_faster.cache_clear()


@pytest.mark.parametrize("slow, fast", [(torch.float32, torch.bfloat16), (torch.bfloat16, torch.float32)])
def test_networks_take_the_precision_that_is_faster(monkeypatch, slow, fast):
    """A processor that has the instructions, and computes for long in one precision but waits longer in the other."""
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)

    def conv2d(image: torch.Tensor, *_: torch.Tensor, **__: int) -> None:
        if image.dtype == slow:
            end = time.thread_time() + 0.002
            while time.thread_time() < end:
                pass
        else:
            time.sleep(0.004)

    with monkeypatch.context() as patched:
        patched.setattr(F, "conv2d", conv2d)
        assert fastest_precision("rae") == str(fast).removeprefix("torch.")
    bfloat16_is_faster.cache_clear()  # another process
    monkeypatch.setattr(F, "conv2d", lambda *_, **__: pytest.fail("measured twice"))
    assert fastest_precision("wskp6+taa") == fastest_precision("rae") == str(fast).removeprefix("torch.")
    assert fastest_precision("svgf") == "float32"


def test_a_damaged_cache_is_measured_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: True)
    file = tmp_path / "onespp" / "bfloat16.json"
    file.parent.mkdir()
    file.write_text("{")
    first = fastest_precision("rae")
    assert len(read_json(file)) == 1 and fastest_precision("rae") == first


def test_without_instructions_nothing_is_measured(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    monkeypatch.setattr(F, "conv2d", lambda *_, **__: pytest.fail("measured"))
    assert fastest_precision("rae") == "float32"
