"""What tests share: compiled kernels, a tiny dataset, and loaded scenes."""

import gc
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import hypothesis
import pytest

import train  # noqa: F401 - sets MKL up, which must come before MKL's first use
from eval.harness import compile_kernels
from models import registry
from models.registry import DENOISERS, prototype
from models.spec import DenoiserSpec
from render.backend import mi
from render.scene_file.load import own_scene
from render.stage import Stage
from scenes.registry import build_scene
from tests.helpers.datasets import generate_tiny
from tests.helpers.rendering import POSED_FRAME
from tests.helpers.shared import made_once

# For tests without a number of examples of their own; `make test-all` takes the thorough profile.
hypothesis.settings.register_profile("quick", max_examples=10, deadline=None)  # busy machines are slow
hypothesis.settings.register_profile("thorough", max_examples=100, deadline=None)
hypothesis.settings.load_profile("quick")


def pytest_collection_finish() -> None:
    """Collections of garbage need not look at what is loaded now: each new scene begins with one."""
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def kernels() -> None:
    """Under pytest-xdist, share out compiling: one process starts with the first denoiser, another with the last.

    Each loads from disk what the other has compiled already; a file marks that all are.
    """
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    all_compiled = Path(os.environ["NUMBA_CACHE_DIR"], "all-compiled")
    if not worker or all_compiled.exists():
        return
    names = [name for name in (*DENOISERS, "eaw+adaptive", "svgf+js") if not prototype(name).unavailable()]
    for name in names if worker == "gw0" else reversed(names):
        compile_kernels(DenoiserSpec.named(name))
    compile_kernels(DenoiserSpec.named("one", precision="bfloat16"))  # kernels: in float32 C does their work
    all_compiled.touch()


@pytest.fixture(scope="module", autouse=True)
def no_scene_is_left() -> Iterator[None]:
    """What is loaded enters all kernels: those of the next file would be compiled anew."""
    yield
    own_scene.cache_clear()


@pytest.fixture(scope="session")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of the test run, which all of its processes use."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def tiny(shared: Path) -> Path:
    """The dataset of profile `tiny`. Read only: tests that damage it copy it first."""
    return made_once(shared / "tiny", generate_tiny)


@pytest.fixture
def tiny_copy(tiny: Path, tmp_path: Path) -> Path:
    """A copy of the tiny dataset, to damage."""
    return Path(shutil.copytree(tiny, tmp_path / "copy"))


@pytest.fixture
def shipped(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of shipped weights, empty here: no test that takes it depends on what is shipped."""
    folder = tmp_path_factory.mktemp("shipped")
    monkeypatch.setattr(registry, "SHIPPED_FOLDER", folder)
    return folder


@pytest.fixture(scope="session", params=[pytest.param("cornell_box", marks=pytest.mark.slow), "cornell_box_moving"])
def stage(request: pytest.FixtureRequest) -> Stage:
    """A built-in scene at 64 x 64, which tests pose."""
    return Stage(build_scene(request.param, seed=3, frames=24), 64, 64)


@pytest.fixture
def rays(stage: Stage) -> mi.Ray3f:
    """Through the pixels of the stage, which is posed for POSED_FRAME."""
    stage.pose(POSED_FRAME)
    return stage.rays(stage.view(POSED_FRAME))
