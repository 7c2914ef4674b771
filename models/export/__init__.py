"""Denoisers as one graph a frame, for engines: plain tensors in and out, ONNX or PyTorch's pt2.

- `step.py` says what such a graph takes, returns and carries; `registry.py` which denoisers have one.
- `wskp.py` and `one.py` are such graphs. Both stand on `recurrent.py`, which moves history by `reprojection.py`, and on
  `scale.py`; WSKP filters by `box_windows.py`, `one` by `neighbours.py`. All are the arithmetic of models/ in few
  operators, with nothing that depends on the size of the image.
- `program.py` traces a step and writes it; `package.py` puts the manifest and golden frames beside it.
- `playing.py` runs a step over frames, by whatever computes it.
"""
