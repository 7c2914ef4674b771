"""Rendering a dataset: which clips it has, and how they get to disk."""
