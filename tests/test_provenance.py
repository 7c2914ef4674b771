"""Digests of code change with all code that a result depends on."""

import subprocess
import sys
from pathlib import Path

import pytest

import provenance
from models.compiled.jit import KERNEL_FOLDER, KERNELS
from provenance import DENOISING, RENDERING, ROOT, code_digest, file_digest, imported_by, sources, versions


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A project of three modules, of which models/a.py imports models/b.py within a function."""
    folder = tmp_path / "models"
    folder.mkdir()
    (folder / "__init__.py").write_text("")
    (folder / "a.py").write_text("import numpy\n\ndef f():\n    from models import b\n    return b\n")
    (folder / "b.py").write_text("from models.nowhere import x\nVALUE = 1\n")
    (folder / "c.py").write_text("VALUE = 2\n")
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    code_digest.cache_clear()
    yield folder
    code_digest.cache_clear()


def test_sources_include_indirect_imports(project):
    assert set(sources("models.a")) == {"models", "models.a", "models.b"}
    assert set(sources("models.c", "numpy", "models.nowhere")) == {"models", "models.c"}


@pytest.mark.parametrize(("changed", "same"), [("a", False), ("b", False), ("__init__", False), ("c", True)])
def test_a_digest_changes_with_its_imports_only(project, changed, same):
    before = code_digest("models.a")
    with (project / f"{changed}.py").open("a") as file:
        file.write("MORE = 3\n")
    code_digest.cache_clear()
    assert (code_digest("models.a") == before) == same


@pytest.mark.parametrize("module", ["eval.clip_run", pytest.param("models.filters.svgf", marks=pytest.mark.slow)])
def test_all_modules_that_python_loads_are_sources(module):
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert {name for name in loaded.split() if provenance.source_of(name)} <= set(sources(module))


def test_results_do_not_depend_on_other_denoisers():
    assert "models.networks.rae" not in sources("eval.clip_run", "models.filters.svgf")
    assert "models.filters.svgf" not in sources("eval.clip_run", "models.networks.rae")
    assert {"eval.metrics", "eval.results", "datasets.frame"} <= set(sources("eval.clip_run"))


def test_the_digest_of_kernels_includes_their_imports():
    modules = [f"models.compiled.{file.stem}" for file in sorted(KERNEL_FOLDER.glob("*.py"))]
    assert code_digest(*modules) == KERNELS
    assert {"models.operators", "models.compiled.exponential", "datasets.channels"} <= set(sources(*modules))


def test_imports_are_found_in_both_forms(tmp_path):
    file = tmp_path / "x.py"
    file.write_text("import os.path\nfrom a.b import c, d as e\nif TYPE_CHECKING:\n    import f\n")
    assert {*imported_by(file)} == {"os.path", "a.b", "a.b.c", "a.b.d"}


def test_versions_are_those_of_installed_packages():
    assert versions(["numpy", "no-such-package"]).keys() == {"numpy"}
    assert set(versions(RENDERING)) == set(RENDERING)
    assert {"onespp", "torch"} <= set(versions(DENOISING))


def test_file_digest(tmp_path):
    file: Path = tmp_path / "file"
    file.write_bytes(b"abc")
    assert file_digest(file) == "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
