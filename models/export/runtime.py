"""Running an exported file: by onnxruntime, or by PyTorch."""

from pathlib import Path

import torch
from torch import Tensor

from models.export.playing import Compute
from models.export.program import Format, quiet


def run_onnx(path: Path, threads: int | None = None) -> Compute:
    """The file's step on the processor, by default with as many threads as PyTorch takes."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads or torch.get_num_threads()
    options.log_severity_level = 3  # errors
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]

    def compute(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        outputs = session.run(names, {name: tensor.numpy() for name, tensor in inputs.items()})
        return {name: torch.from_numpy(array) for name, array in zip(names, outputs, strict=True)}

    return compute


def run_pt2(path: Path) -> Compute:
    """The file's step in PyTorch."""
    with quiet():
        module = torch.export.load(path).module()

    def compute(inputs: dict[str, Tensor]) -> dict[str, Tensor]:
        with torch.no_grad():
            outputs: dict[str, Tensor] = module(inputs)
        return outputs

    return compute


def run_file(path: Path, to: Format) -> Compute:
    return run_onnx(path) if to == "onnx" else run_pt2(path)
