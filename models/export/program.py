"""Tracing a step, for images of any size, and writing it: ONNX, or PyTorch's pt2."""

import logging
import warnings
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import torch
from torch.export import Dim, ExportedProgram

from datasets.frame import Frame
from errors import BadInput
from models.export.step import HEIGHT, MESHES, WIDTH, Step

Format = Literal["onnx", "pt2"]
OPSET = 20
NEEDED = {"onnx": ("onnx", "onnxscript", "onnxruntime"), "pt2": ()}


def check_installed(to: Format) -> None:
    """Raises BadInput where a package is missing that a format needs."""
    missing = [package for package in NEEDED[to] if find_spec(package) is None]
    if missing:
        raise BadInput(f"exporting to {to} needs {', '.join(missing)}: pip install 'onespp[export]'")


@contextmanager
def quiet() -> Iterator[None]:
    """Without the exporter's remarks on what it does not need."""
    logger = logging.getLogger("torch.onnx")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(before)


def dynamic(step: Step) -> dict[str, dict[int, str]]:
    """The names of each input's sizes that may differ from call to call, by axis."""
    return {
        port.name: {axis: size for axis, size in enumerate(port.shape) if isinstance(size, str)} for port in step.inputs
    }


def trace(step: Step, frame: Frame) -> ExportedProgram:
    """The step as a program of tensors by name. `frame` is an example, of at least 2 x 2 pixels and one mesh."""
    sizes = {HEIGHT: Dim(HEIGHT, min=2), WIDTH: Dim(WIDTH, min=2), MESHES: Dim(MESHES, min=2)}
    shapes = {name: {axis: sizes[size] for axis, size in named.items()} for name, named in dynamic(step).items()}
    inputs = {**step.feeds(frame), **step.initial(frame)}
    with torch.no_grad(), quiet():
        return torch.export.export(step.eval(), (inputs,), dynamic_shapes={"tensors": shapes})


@dataclass(frozen=True)
class Operators:
    """How many operators a file has: by kind, and in all of each branch, of which a frame takes one."""

    kinds: dict[str, int]
    branches: dict[str, int]

    @property
    def total(self) -> int:
        """Outside of branches."""
        return sum(self.kinds.values())

    @staticmethod
    def of_onnx(nodes: Iterable[Any]) -> "Operators":
        nodes = list(nodes)
        attributes = [attribute for node in nodes for attribute in node.attributes.values()]
        branches = {each.name: len(each.value) for each in attributes if each.type.name == "GRAPH"}
        return Operators(dict(Counter(sorted(node.op_type for node in nodes))), branches)

    @staticmethod
    def of_pt2(program: ExportedProgram) -> "Operators":
        def calls(graph: torch.fx.Graph) -> list[str]:
            return sorted(str(node.target) for node in graph.nodes if node.op == "call_function")

        branches = program.graph_module.named_children()
        inner = {name: len(calls(each.graph)) for name, each in branches if isinstance(each, torch.fx.GraphModule)}
        return Operators(dict(Counter(calls(program.graph))), inner)


def write_onnx(program: ExportedProgram, step: Step, path: Path) -> Operators:
    """Write one file with the weights in it. Raises BadInput where packages are missing."""
    check_installed("onnx")
    from onnxscript.optimizer import remove_unused_nodes

    with quiet():
        written = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=OPSET,
            input_names=[port.name for port in step.inputs],
            output_names=[port.name for port in step.outputs],
            dynamic_shapes={"tensors": dynamic(step)},
            verbose=False,
        )
        assert written is not None
        remove_unused_nodes(written.model)  # runtimes warn of constants in branches that the exporter leaves
        written.save(path, external_data=False)
    return Operators.of_onnx(written.model.graph)


def write_pt2(program: ExportedProgram, path: Path) -> Operators:
    """Write one file with the weights in it."""
    with quiet():
        torch.export.save(program, path)
    return Operators.of_pt2(program)
