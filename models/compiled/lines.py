"""What several kernels do with lines of pixels."""

from typing import Any

from models.compiled.jit import jit_in_any_order


@jit_in_any_order
def copy_line(line: Any, source: Any) -> None:
    for x in range(line.size):
        line[x] = source[x]
