"""Which denoisers can be exported, and the folder of an export: file, manifest, golden frames, instructions."""

import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from datasets.frame import Frame
from errors import BadInput
from files import read_json, write_json
from models.export.one import OneStep
from models.export.page import instructions
from models.export.program import OPSET, RUN, WRITE, Format, check_installed, play, trace
from models.export.step import Port, Step, Warp
from models.export.wskp import WSKPStep
from models.spec import PRECISIONS, load
from provenance import file_digest, versions

MANIFEST = "manifest.json"
PACKAGES = ("onespp", "torch", "onnx", "onnxscript", "onnxruntime")
EXPORTABLE: dict[str, type[Step]] = {"wskp3": WSKPStep, "wskp6": WSKPStep, "one": OneStep}  # denoisers that have one


def check_exportable(name: str) -> None:
    """Raise BadInput for the name of a denoiser that has no step."""
    if name not in EXPORTABLE:
        raise BadInput(f"'{name}' cannot be exported; {', '.join(EXPORTABLE)} can")


def load_step(name: str, weights: Path, precision: torch.dtype, warp: Warp) -> Step:
    """The step of a named denoiser with the weights of a file. Raises BadInput where either does not fit."""
    check_exportable(name)
    return EXPORTABLE[name](load(name, weights, precision), warp)


@dataclass(frozen=True)
class Export:
    """What to export: a denoiser with the weights of a file, in a format."""

    name: str
    weights: Path
    to: Format
    precision: Literal["float32", "float16"]  # of its network; images and state are float32
    warp: Warp  # whether the step reprojects its history itself


def largest_difference(a: torch.Tensor, b: torch.Tensor) -> float:
    """max |a - b| / max(1, |b|): relative where numbers are large, absolute where they are small."""
    return float(((a - b).abs() / b.abs().clamp(min=1)).max())


def port_entry(port: Port) -> dict[str, Any]:
    dtype = str(port.dtype).removeprefix("torch.")
    return {"name": port.name, "dtype": dtype, "shape": port.shape, "meaning": port.meaning}


def verify(export: Export, path: Path, step: Step, frames: Sequence[Frame], golden: Path) -> dict[str, float]:
    """Write golden frames: arrays input.NAME and output.NAME.

    Returns how much the file's outputs differ at most from them, and from the denoiser's.
    """
    ours = load(export.name, export.weights, PRECISIONS[export.precision])
    state = None
    from_golden = from_ours = 0.0
    with torch.no_grad():
        expected = list(play(step, frames, step))
        actual = play(step, frames, RUN[export.to](path))
        for index, (frame, (inputs, outputs), (_, theirs)) in enumerate(zip(frames, expected, actual, strict=True)):
            arrays = {f"input.{name}": tensor.numpy() for name, tensor in inputs.items()}
            arrays |= {f"output.{name}": tensor.numpy() for name, tensor in outputs.items()}
            np.savez_compressed(golden / f"{index:03}.npz", **arrays)  # type: ignore[arg-type]  # no array is called so
            from_golden = max(from_golden, *(largest_difference(theirs[name], outputs[name]) for name in outputs))
            radiance, state = ours(frame, state)
            from_ours = max(from_ours, largest_difference(theirs[step.outputs[0].name], radiance))
    return {"from_golden": from_golden, "from_onespp": from_ours}


def manifest(export: Export, step: Step, operators: dict[str, Any], differences: dict[str, float]) -> dict[str, Any]:
    """The content of manifest.json without the hashes of files."""
    return {
        "schema": 1,
        "denoiser": export.name,
        "file": f"{export.name}.{export.to}",
        "format": export.to,
        "opset": OPSET if export.to == "onnx" else None,
        "precision": export.precision,
        "warp": export.warp,
        "inputs": [port_entry(port) for port in step.inputs],
        "outputs": [port_entry(port) for port in step.outputs],
        "state": [
            {"input": port.name, "from": port.source, "warp_first": port.warped, "initial": 0} for port in step.carried
        ],
        "weights_sha256": file_digest(export.weights),
        "operators": operators,
        "largest_difference": differences,
        "versions": versions(PACKAGES),
    }


def write_export(export: Export, frames: Sequence[Frame], folder: Path) -> dict[str, Any]:
    """Write an export to `folder` as a whole, replacing an earlier export. Returns the manifest.

    `frames` are the golden frames. Raises BadInput where the denoiser cannot be exported, its weights or a package are
    missing, or the folder is anything else or contains the current one.
    """
    check_installed(export.to)
    folder = folder.resolve()
    if Path.cwd().is_relative_to(folder):
        raise BadInput(f"{folder} is the current folder or contains it: choose another --out")
    earlier = folder / MANIFEST
    is_export = earlier.exists() and "sha256" in read_json(earlier)
    is_empty = folder.is_dir() and not any(folder.iterdir())
    if folder.exists() and not (is_export or is_empty):
        raise BadInput(f"{folder} is not an earlier export: choose another --out")
    temporary = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    golden = temporary / "golden"
    golden.mkdir(parents=True)
    try:
        step = load_step(export.name, export.weights, PRECISIONS[export.precision], export.warp)
        path = temporary / f"{export.name}.{export.to}"
        operators = WRITE[export.to](trace(step, frames[0]), step, path)
        content = manifest(export, step, operators, verify(export, path, step, frames, golden))
        (temporary / "README.md").write_text(instructions(content))
        files = sorted(file for file in temporary.rglob("*") if file.is_file())
        content["sha256"] = {str(file.relative_to(temporary)): file_digest(file) for file in files}
        write_json(temporary / MANIFEST, content)
        shutil.rmtree(folder, ignore_errors=True)
        temporary.rename(folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return content
