"""Types of what kernels take and return: for readers and mypy, for Numba infers its own.

Arrays of float32 are contiguous. C: channels, S: signals (direct and indirect light), H: rows, W: columns, N = H W.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

f32 = np.float32  # in kernels, arithmetic with plain Python numbers would be in double precision

Row: TypeAlias = NDArray[np.float32]  # (W,) or part of a row
Rows: TypeAlias = NDArray[np.float32]  # (C, W) or (C, N)
Plane: TypeAlias = NDArray[np.float32]  # (H, W)
Image: TypeAlias = NDArray[np.float32]  # (C, H, W)
Signals: TypeAlias = NDArray[np.float32]  # (S, C, H, W), or a batch of images
RGB: TypeAlias = tuple[Row, Row, Row]  # parts of three rows: red, green and blue, or x, y and z
Matrix: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]  # (H, W)
Doubles: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int32]
Indices: TypeAlias = NDArray[np.int64]
Index: TypeAlias = int | np.int64
Scalar: TypeAlias = float | np.float32
