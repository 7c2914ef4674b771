"""The frames of stress cases: a moving scene under light of irradiance 1."""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from datasets.channels import CHANNELS, SAMPLE_BUFFERS
from datasets.frame import Frame, to_tensor
from eval.bench.sizes import Size
from eval.bench.synthetic_frames import HIT_DIRECT, HIT_INDIRECT, noisy, split_into_buffers, synthetic_frame
from eval.stress.changes import FrameChange

LIGHT_SHARES = {"direct": 0.7, "indirect": 0.3}  # of the irradiance
HIT_SHARES = {"direct": HIT_DIRECT, "indirect": HIT_INDIRECT}  # of the pixels whose one sample finds light
NOISE_PERIOD = 100  # frames until the noise of a long sequence repeats


def lit(frame: Frame, seed: int | None) -> Frame:
    """The frame under light of irradiance 1: with the noise of one sample per pixel, or without noise if no seed."""
    reflected = (frame.divisor * (frame.depth > 0))[0].permute(1, 2, 0).double().numpy()
    light = {name: share * reflected for name, share in LIGHT_SHARES.items()}
    if seed is not None:
        rng = np.random.default_rng(seed)
        light = {name: noisy(rng, mean, HIT_SHARES[name]) for name, mean in light.items()}
        buffers = split_into_buffers(light, (seed, 1))
    else:
        buffers = {SAMPLE_BUFFERS[name]: np.stack([mean, mean]) for name, mean in light.items()}
    channels = light | buffers
    tensors = {name: to_tensor(array, CHANNELS[name].has_buffers) for name, array in channels.items()}
    return replace(frame, channels=frame.channels | tensors)


@lru_cache(maxsize=4 * NOISE_PERIOD)
def lit_frame(surfaces: FrameChange, size: Size, index: int, seed: int | None) -> Frame:
    """Frame `index` of the synthetic sequence, with surfaces changed before they are lit."""
    return lit(surfaces(synthetic_frame(index, *size)), seed)
