"""The folder of an exported denoiser: its file, a manifest, golden frames, and a page on how to call it."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from datasets.frame import Frame
from errors import BadInput
from files import read_json, write_json
from models.export.page import page
from models.export.playing import play
from models.export.program import OPSET, Format, Operators, check_installed, trace, write_onnx, write_pt2
from models.export.registry import load_step
from models.export.runtime import run_file
from models.export.step import Port, Step, Tensors, Warp
from models.spec import load
from provenance import file_digest, versions

MANIFEST = "manifest.json"
PRECISIONS = {"float32": torch.float32, "float16": torch.float16}
PACKAGES = ("onespp", "torch", "onnx", "onnxscript", "onnxruntime")


@dataclass(frozen=True)
class Export:
    """What is exported: a denoiser with the weights of a file, as what.

    Attributes:
        precision: of its network, a key of PRECISIONS; images and state are float32.
        warp: whether the step moves the state along with the surfaces itself.
    """

    name: str
    weights: Path
    to: Format
    precision: str
    warp: Warp

    @property
    def file(self) -> str:
        return f"{self.name}.{self.to}"


def largest_difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """max |a - b| / max(1, |b|): relative where numbers are large, absolute where they are small."""
    return float(((a - b).abs() / b.abs().clamp(min=1)).max())


def described(port: Port) -> dict[str, Any]:
    dtype = str(port.dtype).removeprefix("torch.")
    return {"name": port.name, "dtype": dtype, "shape": port.shape, "meaning": port.meaning}


def write_golden(folder: Path, index: int, inputs: Tensors, outputs: Tensors) -> None:
    """One frame: arrays input.NAME and output.NAME."""
    arrays = {f"input.{name}": tensor.numpy() for name, tensor in inputs.items()}
    arrays |= {f"output.{name}": tensor.numpy() for name, tensor in outputs.items()}
    np.savez_compressed(folder / f"{index:03}.npz", **arrays)  # type: ignore[arg-type]  # no array is called so


def measured(export: Export, path: Path, step: Step, frames: Sequence[Frame], golden: Path) -> dict[str, float]:
    """Write golden frames, and by how much at most the file's outputs differ from them and from our denoiser's."""
    ours = load(export.name, export.weights, PRECISIONS[export.precision])
    state = None
    from_golden = from_ours = 0.0
    with torch.no_grad():
        expected = list(play(step, frames, step))
        got = play(step, frames, run_file(path, export.to))
        for index, (frame, (inputs, outputs), (_, theirs)) in enumerate(zip(frames, expected, got, strict=True)):
            write_golden(golden, index, inputs, outputs)
            from_golden = max(from_golden, *(largest_difference(theirs[name], outputs[name]) for name in outputs))
            radiance, state = ours(frame, state)
            from_ours = max(from_ours, largest_difference(theirs[step.outputs[0].name], radiance))
    return {"from_golden": from_golden, "from_onespp": from_ours}


def manifest(export: Export, step: Step, operators: Operators, differences: dict[str, float]) -> dict[str, Any]:
    """All that a caller has to know; the files' hashes are still to come."""
    return {
        "schema": 1,
        "denoiser": export.name,
        "file": export.file,
        "format": export.to,
        "opset": OPSET if export.to == "onnx" else None,
        "precision": export.precision,
        "warp": export.warp,
        "inputs": [described(port) for port in step.inputs],
        "outputs": [described(port) for port in step.outputs],
        "state": [
            {"input": each.port.name, "from": each.source, "warp_first": each.warped, "initial": 0}
            for each in step.carried
        ],
        "weights_sha256": file_digest(export.weights),
        "operators": {"total": operators.total, "branches": operators.branches, "kinds": operators.kinds},
        "largest_difference": differences,
        "versions": versions(PACKAGES),
    }


def fill(folder: Path, export: Export, frames: Sequence[Frame]) -> dict[str, Any]:
    """Write all files of an export into an empty folder. Returns the manifest."""
    step = load_step(export.name, export.weights, PRECISIONS[export.precision], export.warp)
    program = trace(step, frames[0])
    path = folder / export.file
    operators = write_onnx(program, step, path) if export.to == "onnx" else write_pt2(program, path)
    golden = folder / "golden"
    golden.mkdir()
    content = manifest(export, step, operators, measured(export, path, step, frames, golden))
    (folder / "README.md").write_text(page(content))
    files = sorted(file for file in folder.rglob("*") if file.is_file())
    content["sha256"] = {str(file.relative_to(folder)): file_digest(file) for file in files}
    write_json(folder / MANIFEST, content)
    return content


def write_export(export: Export, frames: Sequence[Frame], folder: Path) -> dict[str, Any]:
    """Write an export to `folder`, whole or not at all, in place of one that may be there. Returns the manifest.

    The golden frames are those of the sequence `frames`. Raises BadInput where the denoiser has no step, its weights or
    a package are missing, or something else is in the folder.
    """
    check_installed(export.to)
    if folder.exists() and any(folder.iterdir()) and "sha256" not in read_json_or_nothing(folder / MANIFEST):
        raise BadInput(f"{folder} holds something else than an export: name another --out")
    folder.parent.mkdir(parents=True, exist_ok=True)
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    temporary.mkdir()
    try:
        content = fill(temporary, export, frames)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return content


def read_json_or_nothing(path: Path) -> dict[str, Any]:
    return read_json(path) if path.exists() else {}
