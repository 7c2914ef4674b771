"""What tests of denoisers share: both implementations of a function, and few threads for small images."""

import contextlib

import pytest
import torch

from datasets.clip import Clip, Dataset
from models import compiled

IMPLEMENTATIONS = {"kernels": contextlib.nullcontext, "PyTorch": compiled.disabled}


# Scope "class" is a single test for functions outside of classes. Hypothesis refuses "function", because it does not
# set up such fixtures anew for every example.
@pytest.fixture(scope="class", params=IMPLEMENTATIONS)
def implementation(request):
    """The test runs with compiled kernels, and again in PyTorch alone."""
    with IMPLEMENTATIONS[request.param]():
        yield request.param


# In place of the fixture's parameters, for what takes long without kernels.
MOSTLY_KERNELS = pytest.mark.parametrize(
    "implementation", ["kernels", pytest.param("PyTorch", marks=pytest.mark.slow)], indirect=True, scope="class"
)


@pytest.fixture(scope="session")
def moving_clip(tiny) -> Clip:
    """Eight rendered frames in which a mesh and the camera move."""
    return Dataset(tiny).clips("test")[1]


@pytest.fixture(scope="class")
def one_thread():
    """Images are tiny: threads would only wait for each other, for long where other processes keep a core busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
