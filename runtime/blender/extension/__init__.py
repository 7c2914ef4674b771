"""Denoise Animation: an extension of Blender that denoises the frames of Cycles with `one`."""

from .interface import register, unregister

__all__ = ["register", "unregister"]
