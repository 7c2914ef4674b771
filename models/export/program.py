"""A step as a file: tracing it for images of any size, writing it as ONNX or PyTorch's pt2, and running it."""

import logging
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from inspect import isroutine
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

from datasets.frame import Frame
from errors import BadInput
from models.export.step import HEIGHT, MESHES, TILE_COLUMNS, TILE_ROWS, WIDTH, Step
from models.history.geometry import GBuffer
from models.history.reprojection import reproject

Tensors = dict[str, Tensor]  # by name
Compute = Callable[[Tensors], Tensors]  # outputs of inputs
Format = Literal["onnx", "pt2"]
OPSET = 20
NEEDED = {"onnx": ("onnx", "onnxscript", "onnxruntime"), "pt2": ()}


def check_installed(to: Format) -> None:
    """Raise BadInput where a package is missing that a format needs."""
    missing = [package for package in NEEDED[to] if find_spec(package) is None]
    if missing:
        raise BadInput(f"exporting to {to} needs {', '.join(missing)}: pip install 'onespp[export]'")


@contextmanager
def quiet() -> Iterator[None]:
    """Suppresses the exporter's irrelevant warnings."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logger.setLevel(level)


def dynamic(step: Step) -> dict[str, dict[int, str]]:
    """The names of each input's sizes that may differ from call to call, by axis."""
    return {p.name: {axis: size for axis, size in enumerate(p.shape) if isinstance(size, str)} for p in step.inputs}


def trace(step: Step, frame: Frame) -> ExportedProgram:
    """The step as a graph. `frame` is an example of at least 2 x 2 pixels and one mesh."""
    sizes = {name: Dim(name, min=2) for name in (HEIGHT, WIDTH, MESHES, TILE_ROWS, TILE_COLUMNS)}
    shapes = {name: {axis: sizes[size] for axis, size in named.items()} for name, named in dynamic(step).items()}
    inputs = {**step.frame_inputs(frame), **step.initial_state(frame)}
    with torch.no_grad(), quiet():
        return torch.export.export(step.eval(), (inputs,), dynamic_shapes={"x": shapes})


def counted(kinds: Iterable[str], branches: dict[str, int]) -> dict[str, Any]:
    """A manifest's count of a graph's operators by kind, and of those in each branch, of which a frame takes one."""
    by_kind = Counter(sorted(kinds))
    return {"total": by_kind.total(), "branches": branches, "kinds": by_kind}


def write_onnx(program: ExportedProgram, step: Step, path: Path) -> dict[str, Any]:
    """Write one file, weights included. Returns its operators, see `counted`."""
    from onnxscript import ir
    from onnxscript.optimizer import remove_unused_nodes

    with quiet():
        written = torch.onnx.export(
            program,
            dynamo=True,
            opset_version=OPSET,
            input_names=[port.name for port in step.inputs],
            output_names=[port.name for port in step.outputs],
            dynamic_shapes={"x": dynamic(step)},
            verbose=False,
        )
        assert written is not None
        for value, port in zip(written.model.graph.outputs, step.outputs, strict=True):
            value.shape = ir.Shape(port.shape)  # with its own names for sizes, not formulas of others
        remove_unused_nodes(written.model)  # the exporter leaves constants in branches, of which runtimes warn
        written.save(path, external_data=False)
    nodes = list(written.model.graph)
    attributes = [attribute for node in nodes for attribute in node.attributes.values()]
    branches = {each.name: len(each.value) for each in attributes if each.type.name == "GRAPH"}
    return counted((node.op_type for node in nodes), branches)


def write_pt2(program: ExportedProgram, step: Step, path: Path) -> dict[str, Any]:
    """See write_onnx."""

    def calls(graph: torch.fx.Graph) -> list[str]:
        targets = [node.target for node in graph.nodes if node.op == "call_function"]
        # Those of Python by name: they print their address in memory. Operators print theirs.
        return [target.__name__ if isroutine(target) else str(target) for target in targets]

    with quiet():
        torch.export.save(program, path)
    children = program.graph_module.named_children()
    branches = {name: len(calls(each.graph)) for name, each in children if isinstance(each, torch.fx.GraphModule)}
    return counted(calls(program.graph), branches)


def run_onnx(path: Path) -> Compute:
    """The file's step on the CPU, with as many threads as PyTorch uses."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3  # errors
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def compute(inputs: Tensors) -> Tensors:
        outputs = session.run(names, {name: tensor.numpy() for name, tensor in inputs.items()})
        return {name: torch.from_numpy(array) for name, array in zip(names, outputs, strict=True)}

    return compute


def run_pt2(path: Path) -> Compute:
    """The file's step in PyTorch."""
    with quiet():
        return torch.no_grad()(torch.export.load(path).module())


WRITE = {"onnx": write_onnx, "pt2": write_pt2}
RUN = {"onnx": run_onnx, "pt2": run_pt2}


def play(step: Step, frames: Iterable[Frame], compute: Compute) -> Iterator[tuple[Tensors, Tensors]]:
    """Inputs and outputs of each frame (B = 1). After a cut the state is the initial one."""
    warped = [port.name for port in step.carried if port.warped]
    previous: Frame | None = None
    state: Tensors = {}
    for frame in frames:
        if previous is None or not frame.follows(previous.moment):
            state = step.initial_state(frame)
        else:
            state |= {name: reproject(frame, state[name], GBuffer.of(previous))[0] for name in warped}
        inputs = {**step.frame_inputs(frame), **state}
        outputs = compute(inputs)
        yield inputs, outputs
        tensors = {**inputs, **outputs}
        state = {port.name: tensors[port.source] for port in step.carried}
        previous = frame
