"""Tracing a step: one program for images of any size."""

import warnings
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.export import Dim, ExportedProgram

from datasets.frame import Frame
from models import compiled
from models.export.step import HEIGHT, MESHES, WIDTH, Step


def trace(step: Step, frame: Frame) -> ExportedProgram:
    """The step as a program of tensors by name. `frame` is an example, of more than 2 x 2 pixels and one mesh."""
    sizes = {HEIGHT: Dim(HEIGHT, min=2), WIDTH: Dim(WIDTH, min=2), MESHES: Dim(MESHES, min=2)}
    shapes = {
        port.name: {axis: sizes[size] for axis, size in enumerate(port.shape) if isinstance(size, str)}
        for port in step.inputs
    }
    inputs = {**step.feeds(frame), **step.initial(frame)}
    with torch.no_grad(), compiled.disabled():
        return torch.export.export(
            step, ({port.name: inputs[port.name].clone() for port in step.inputs},), dynamic_shapes={"tensors": shapes}
        )
