"""Exported folders, run as their own page describes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


def check_page(folder: Path, convert: Callable[[np.ndarray], Any], tolerance: float) -> None:
    """The page's Python plays the golden frames: state and radiance are those that are stored, frame by frame.

    `convert` makes of an array what the format takes.
    """
    code = (folder / "README.md").read_text().partition("```python\n")[2].partition("```")[0]
    names: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        exec(code, names)
    state = None
    for file in sorted((folder / "golden").glob("*.npz")):
        arrays = np.load(file)
        inputs = {key.removeprefix("input."): arrays[key] for key in arrays.files if key.startswith("input.")}
        if state is None:
            state = names["first_state"](*inputs["noisy"].shape[-2:])
        for name, tensor in state.items():
            array = np.asarray(tensor)
            assert array.dtype == inputs[name].dtype
            np.testing.assert_allclose(array, inputs[name], rtol=tolerance, atol=tolerance)
        frame = {name: convert(array) for name, array in inputs.items() if name not in state}
        radiance, state = names["step"](frame, state)
        np.testing.assert_allclose(np.asarray(radiance), arrays["output.radiance"], rtol=tolerance, atol=tolerance)
    assert state is not None
