"""Losses, recipes, and one training loop for all networks."""

import os

# MKL's sums depend on where memory happens to lie unless set otherwise before its first use: PyTorch gives it small
# float32 convolutions of a single item. Without this a resumed training ends with other bits.
os.environ.setdefault("MKL_CBWR", "AUTO,STRICT")
