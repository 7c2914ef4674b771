"""Writes the shipped weights of `one` as a C array in half precision, as the matrices that the runtime applies.

`python -m runtime.weights` writes runtime/onespp_weights.h.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from files import write_file
from models.registry import require_shipped

HEADER = Path(__file__).with_name("onespp_weights.h")
LAYERS = (  # in the order in which onespp.c reads them
    *("enter.0", "enter.1", "down_b.0", "down_b.1", "down_c.0", "down_c.1", "down_c.2"),
    *("up_b", "join_b", "up_a", "join_a", "leave", "detail.0", "detail.2"),
)
UPSAMPLING = ("up_b", "up_a", "leave")
NUMBERS_A_LINE = 16

Weights = NDArray[np.float32]


def matrix(name: str, weight: Weights) -> Weights:
    """A layer's weights as a matrix (inputs, outputs).

    The inputs of 3 x 3 taps are in the order of channels, rows, columns; those of 2 x 2 pixels, and the outputs that
    become such, in the order of rows, columns, channels.
    """
    if name in UPSAMPLING:
        return weight.transpose(0, 2, 3, 1).reshape(len(weight), -1)
    if weight.shape[2:] == (2, 2):
        weight = weight.transpose(0, 2, 3, 1)
    return weight.reshape(len(weight), -1).T


def bias(name: str, tensors: Mapping[str, Weights]) -> Weights:
    """A layer's biases, one for each column of its matrix."""
    weight = tensors[f"{name}.weight"]
    values = tensors.get(f"{name}.bias", np.zeros(len(weight), np.float32))
    return np.tile(values, 4) if name in UPSAMPLING else values


def header(weights: Path) -> str:
    """The C header of a weight file of `one`."""
    with safe_open(weights, framework="numpy") as file:
        tensors = {key.removeprefix("network."): file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    parts = [part.ravel() for name in LAYERS for part in (bias(name, tensors), matrix(name, tensors[f"{name}.weight"]))]
    halves = np.concatenate(parts).astype("<f2").view("<u2")
    numbers = [f"0x{half:04x}," for half in halves]
    lines = ["".join(numbers[at : at + NUMBERS_A_LINE]) for at in range(0, len(numbers), NUMBERS_A_LINE)]
    return (
        "/* Weights of `one`, as IEEE half precision: made by runtime/weights.py. */\n"
        f"static const uint16_t onespp_weights[{len(halves)}] = {{\n" + "\n".join(lines) + "\n};\n"
    )


def main() -> None:
    write_file(HEADER, header(require_shipped("one")).encode())


if __name__ == "__main__":
    if sys.argv[1:]:
        sys.exit(__doc__)
    main()
