"""The precision of inference is the one that this processor is faster in, whatever instructions it has."""

import time

import pytest
import torch
from torch.nn import functional as F

from models import registry
from models.fastest import bfloat16_pays


@pytest.fixture(autouse=True)
def forget():
    """What these tests measure holds for them alone."""
    bfloat16_pays.cache_clear()
    yield
    bfloat16_pays.cache_clear()


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
        assert registry.inference_precision("rae") == fast
    assert registry.inference_precision("wskp6+taa") == fast  # remembered
    assert registry.inference_precision("svgf") == torch.float32


def test_without_instructions_nothing_is_measured(monkeypatch):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: False)
    monkeypatch.setattr(torch.cpu, "_is_amx_tile_supported", lambda: False)
    monkeypatch.setattr(F, "conv2d", lambda *_, **__: pytest.fail("measured"))
    assert registry.inference_precision("rae") == torch.float32
