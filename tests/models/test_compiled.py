"""Which of a kernel and its PyTorch function runs."""

import pytest
import torch
from torch import Tensor

from models import compiled
from provenance import ROOT, sources


def version(name: str):
    def function(image: Tensor, other: Tensor, scale: float = 1.0) -> str:
        return name

    return function


@pytest.fixture
def function():
    """Returns which of its versions ran."""
    return compiled.by(version("processor"))(version("pytorch"))


IMAGE = torch.zeros(2, 2)


def test_kernels_run_on_processors_in_float32(function):
    assert function(IMAGE, IMAGE) == function(IMAGE, other=IMAGE, scale=2.0) == "processor"
    assert function(IMAGE, IMAGE.bfloat16()) == function(IMAGE, IMAGE > 0) == "processor"  # the first is the image
    for dtype in (torch.bfloat16, torch.float16, torch.float64):
        assert function(IMAGE.to(dtype), IMAGE) == "pytorch"
    assert function(IMAGE.to("meta"), IMAGE) == function(IMAGE.to("meta"), IMAGE.to("meta")) == "pytorch"


def test_kernels_have_no_gradients(function):
    weights = torch.zeros(2, 2, requires_grad=True)
    assert function(IMAGE, weights) == function(weights, IMAGE) == "pytorch"
    with torch.no_grad():
        assert function(IMAGE, weights) == "processor"


def test_kernels_can_be_disabled(function):
    with compiled.disabled():
        with compiled.disabled():
            assert function(IMAGE, IMAGE) == "pytorch"
        assert function(IMAGE, IMAGE) == "pytorch"
    assert function(IMAGE, IMAGE) == "processor"


def test_results_follow_from_all_kernels():
    """The sources of a result include the kernels that their import statements name."""
    kernels = {f"models.compiled.{file.stem}" for file in (ROOT / "models" / "compiled").glob("[!_]*.py")}
    assert kernels and kernels <= sources("models.registry").keys()
    assert "models.compiled.svgf" in sources("models.filters.svgf")
    assert "models.compiled.svgf" not in sources("models.filters.eaw")
