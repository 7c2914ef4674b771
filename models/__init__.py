"""From a noisy frame and a state to a denoised image.

- `denoiser.py` is the interface of all denoisers, `registry.py` has their names, `weights.py` keeps networks on disk.
- Without a network: `baselines.py`, `eaw.py` and `svgf.py` (both on `atrous.py`), and OIDN's library in `oidn.py`.
- Networks: `rae.py`; `wskp.py`, made of `repvgg.py`, `features.py`, `fusion.py` and `pixel_kernels.py`; `ntd.py`, made
  of `convolution.py` and `pixel_kernels.py`.
- `taa.py` puts temporal antialiasing after any of them.
- What they share: `reprojection.py` fetches the history of `surfaces.py`, `accumulation.py` averages along it,
  `running_scale.py` estimates exposure and depth; `operators.py` has small functions.
- `compiled/` has kernels for the functions that take most time.
"""
