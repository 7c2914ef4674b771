"""A real-time Monte Carlo denoiser: `one` of onespp, in C, for arrays of numpy, PyTorch, Dr.Jit and others.

`Denoiser` denoises a sequence frame by frame; `denoise` does the same as a function that is handed its state.
"""

from .arrays import Array
from .denoiser import Denoiser, denoise

__all__ = ["Array", "Denoiser", "denoise"]
