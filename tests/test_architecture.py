"""docs/architecture.md is true: who imports whom, and its examples work."""

import ast
import re
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from eval.bench.synthetic_frames import synthetic_frame
from eval.comparison import Comparison
from eval.metrics import METRICS, measure
from models.denoiser import State
from models.registry import DENOISERS, create
from provenance import FOLDERS, ROOT, imported_by, source_of
from scenes.registry import SCENES, build_scene

PAGE = ROOT / "docs" / "architecture.md"
MAY_IMPORT = {
    "scenes": {"scenes"},
    "datasets": {"datasets", "scenes.camera"},
    "render": {"render", "scenes", "datasets"},
    "models": {"models", "datasets.frame", "datasets.channels", "datasets.cameras"},
    "train": {"train", "models", "datasets"},
    "eval": {"eval", "train", "models", "datasets"},
    "denoise": {
        *("denoise", "models", "datasets", "scenes.camera"),
        *("eval.comparison", "eval.metrics", "eval.bench.memory"),
    },
}
RENDERING = {"bench", "benchmark", "figures", "tradeoff"}  # folders of eval that render


def modules() -> list[Path]:
    """All source files but tests, relative to the root."""
    return [file.relative_to(ROOT) for folder in FOLDERS for file in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize("file", modules(), ids=str)
def test_arrows_point_one_way(file):
    imported = {name for name in imported_by(ROOT / file) if name.split(".")[0] in FOLDERS and source_of(name)}
    folders = {name for name in imported if name in FOLDERS}
    renders = file.parts[0] == "eval" and file.parts[1] in RENDERING
    prefixes = MAY_IMPORT[file.parts[0]] | ({"render", "scenes"} if renders else set())
    strangers = {name for name in imported - folders if not any(f"{name}.".startswith(f"{p}.") for p in prefixes)}
    assert not strangers, f"{file} may not import {strangers}"


def test_every_file_has_a_docstring():
    for file in modules():
        assert ast.get_docstring(ast.parse((ROOT / file).read_text())), f"{file} has no docstring"


def test_a_class_or_constant_name_is_used_once():
    """Importing a constant is no second definition; top-level files count, too."""
    classes: dict[str, set[str]] = defaultdict(set)
    constants: dict[str, set[str]] = defaultdict(set)
    for file in [*modules(), *(path.relative_to(ROOT) for path in ROOT.glob("*.py"))]:
        tree = ast.parse((ROOT / file).read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                classes[node.name].add(str(file))
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
            for target in targets:
                if isinstance(target, ast.Name) and target.id.isupper():
                    constants[target.id].add(str(file))
    repeated = {name: files for name, files in {**classes, **constants}.items() if len(files) > 1}
    assert not repeated


@pytest.fixture
def examples(monkeypatch):
    """The page's Python, run; what it adds to tables is taken out again."""
    for table in (DENOISERS, SCENES, METRICS):
        for name in list(table):
            monkeypatch.setitem(table, name, table[name])
    before = [(table, set(table)) for table in (DENOISERS, SCENES, METRICS)]
    names: dict[str, object] = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(compile(code, str(PAGE), "exec"), names)
    yield
    for table, names in before:
        for name in set(table) - names:
            del table[name]


def test_the_example_denoiser_denoises(examples):
    frame = synthetic_frame(0, 24, 32)

    def denoised(name: str) -> tuple[torch.Tensor, State]:
        denoiser = create(name)
        return denoiser(replace(frame, channels={read: frame.channels[read] for read in denoiser.reads}), None)

    output, state = denoised("box")
    assert output.shape == (1, 3, 24, 32) and torch.isfinite(output).all()
    again, _ = denoised("box+taa")
    assert again.shape == output.shape and state.moment.shape == (1, 24, 32)
    spread = [(image - frame.emission).div(frame.divisor).std() for image in (output, frame.radiance("total"))]
    assert spread[0] < spread[1] / 2


def test_the_example_scene_is_darker(examples):
    night, day = (build_scene(name, 0, 8) for name in ("cornell_box_at_night", "cornell_box"))
    assert [shape.name for shape in night.shapes] == [shape.name for shape in day.shapes]
    assert (night.shapes[-1].radiance.at(0) < 0.02 * day.shapes[-1].radiance.at(0)).all()
    np.testing.assert_array_equal(night.view(3, 8, 8).camera_to_world, day.view(3, 8, 8).camera_to_world)


def test_the_example_metric_is_measured(examples):
    buffers = torch.zeros(2, 3, 4, 4)
    output = torch.zeros(1, 3, 4, 4)
    output[0, 0, 1, 2] = 0.5
    assert measure(Comparison(output, buffers, 1.0))["largest_error"] == pytest.approx(0.5 ** (1 / 2.2))
