"""Denoisers as one graph per frame, for inference engines: plain tensors in and out, ONNX or PyTorch's pt2.

- `step.py`: inputs, outputs and state of such a graph.
- `wskp.py`, `one.py`: the graphs, on `history.py` (reprojection and running scale). The arithmetic is that of models/,
  in few operators, and nothing depends on the image size.
- `program.py` traces, writes and runs a graph; `package.py` says which denoisers have one, and adds manifest, golden
  frames and `page.py`'s instructions.
"""
