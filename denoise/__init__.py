"""Frames of other renderers: reading, interpreting, denoising and writing them."""
