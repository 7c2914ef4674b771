"""Writes the shipped weights of `one` as a C array in half precision, as the matrices that the runtime applies.

`python -m runtime.weights` writes runtime/onespp_weights.h.
"""

import sys
from pathlib import Path

from safetensors import safe_open

from files import write_file
from models.compiled.one_in_c import in_order
from models.registry import require_shipped

HEADER = Path(__file__).with_name("onespp_weights.h")
NUMBERS_A_LINE = 16


def header(weights: Path) -> str:
    """The C header of a weight file of `one`."""
    with safe_open(weights, framework="numpy") as file:
        tensors = {key.removeprefix("network."): file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    halves = in_order(tensors).astype("<f2").view("<u2")
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
