"""From a noisy frame and a state to a denoised image.

- `denoiser.py` is the interface, `registry.py` lists denoisers and wrappers and parses their names, `spec.py` describes
  one way to run one, `weights.py` reads and writes networks.
- `history/`: reprojection, temporal accumulation, running exposure and depth scale. `filters/`: denoisers without a
  network, and OIDN. `networks/`: those with one. `wrappers/`: +accumulated, +adaptive, +taa, +js. `compiled/`: the
  kernels of all. `export/`: one graph per frame for inference engines.
"""
