"""What whole frames say of a clip's brightness and depth, for training on crops of them."""

import torch
from torch import Tensor

from datasets.clip import Clip
from datasets.frame import Signal, read_frame
from models.history.running_scale import measure


class WholeFrames:
    """What running_scale measures in the noisy light of `signal`: each frame and realisation once, then remembered.

    A crop of 64 x 64 pixels may be three times brighter or darker than its frame; in use networks see whole frames.
    """

    def __init__(self, signal: Signal):
        self.signal = signal
        self.light = ("indirect",) if signal == "indirect" else ("direct", "indirect")
        self.known: dict[tuple[str, int, int], Tensor] = {}

    @torch.no_grad()
    def __call__(self, clip: Clip, index: int, realisation: int) -> Tensor:
        """Logarithms of luminance and depth of frame `index`, (1, 2)."""
        key = (str(clip.path), index, realisation)
        if key not in self.known:
            frame = read_frame(clip, index, (*self.light, "albedo", "depth"), realisation)
            radiance = frame.irradiance(self.signal).clamp(min=0) * frame.divisor
            self.known[key] = measure(radiance, frame.depth)
        return self.known[key]
