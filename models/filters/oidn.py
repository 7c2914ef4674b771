"""OIDN: Intel Open Image Denoise, the denoiser that renderers ship, for comparison."""

import weakref
from typing import Any, Literal

import torch
from torch import Tensor

from datasets.frame import Frame, Signal
from errors import BadInput
from models.denoiser import Denoiser, State, matching_state
from models.filters.baselines import AccumulatedState, Accumulating

OIDNQuality = Literal["high", "balanced", "fast"]

OIDN_IMAGES = ("color", "albedo", "normal", "output")


def open_device(threads: int) -> Any:
    """A committed CPU device of pyoidn. Raises BadInput, with what to install, where OIDN does not run."""
    try:
        import pyoidn

        device = pyoidn.Device()
        device.set_int("numThreads", threads)
        # By default OIDN pins its threads to cores, where PyTorch's and other processes' threads get in their way.
        device.set_bool("setAffinity", False)
        device.commit()
        problem = device.get_error()
    except (ImportError, OSError) as error:  # the library itself is loaded at the first call
        problem = str(error)
    if problem:
        raise BadInput(f"OIDN does not run here ({problem}); get it with `pip install 'onespp[oidn]'`")
    return device


class RayTracingFilter:
    """OIDN's filter "RT" for images of one size. OIDN reads and writes the tensors of `images` in place.

    Settings are those that OIDN's documentation recommends for the best quality: HDR; noise-free albedo and normals as
    auxiliary images (`cleanAux`); automatic exposure (`inputScale` not set).
    """

    def __init__(self, height: int, width: int, threads: int, quality: OIDNQuality):
        device = open_device(threads)
        import pyoidn

        self.device = device
        self.filter = pyoidn.Filter(device)
        weakref.finalize(self, device.release)  # at the latest at exit, where the last one is called first
        weakref.finalize(self, self.filter.release)
        with torch.inference_mode(False):  # else they could not be written outside of it
            self.images = {name: torch.zeros(height, width, 3) for name in OIDN_IMAGES}
        for name, image in self.images.items():
            self.filter.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
        self.filter.set_bool("hdr", True)
        self.filter.set_bool("cleanAux", True)
        self.filter.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
        self.filter.commit()
        self.check()

    def check(self) -> None:
        """Raise BadInput where OIDN reports an error, such as too little memory."""
        if problem := self.device.get_error():
            raise BadInput(f"OIDN failed: {problem}")

    def __call__(self, colour: Tensor, albedo: Tensor, normal: Tensor) -> Tensor:
        """Denoised radiance (3, H, W) from `colour` >= 0, `albedo` in [0, 1] and `normal` in [-1, 1], all (3, H, W)."""
        for name, value in zip(OIDN_IMAGES, (colour, albedo, normal), strict=False):
            self.images[name].copy_(value.permute(1, 2, 0))
        self.filter.execute()
        self.check()
        output = self.images["output"].permute(2, 0, 1)
        return output.to(colour.device, memory_format=torch.contiguous_format, copy=True)


class OIDN(Denoiser):
    """Denoises the beauty, direct + indirect + emission, frame by frame, as its documentation asks.

    Runs on as many CPU threads as PyTorch. `quality` is "high" (OIDN's default, for final frames), "balanced" or "fast"
    (for interactive previews). Raises BadInput when it is prepared, or first used, where pyoidn does not run.
    """

    made_from = "the library"
    reads: tuple[str, ...] = ("direct", "indirect", "emission", "albedo", "normal", "depth")
    refuses = dict.fromkeys((torch.bfloat16, torch.float16), "OIDN chooses its own precision")
    has_kernels = False
    filters_emission = True
    blends_layers = True
    baseline_for: tuple[Signal, ...] = ("total",)
    evaluated_with: tuple[str, ...] = ("accumulated", "accumulated+adaptive")

    quality: OIDNQuality = "high"
    key: tuple[int, int, int] | None = None  # (H, W, threads) of the filter

    def unavailable(self) -> str | None:
        try:
            open_device(threads=1).release()
        except BadInput as error:
            return str(error)
        return None

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        super().prepare(precision)
        open_device(torch.get_num_threads()).release()

    def denoise(self, frame: Frame, radiance: Tensor, albedo: Tensor) -> Tensor:
        """The denoised image of radiance (B, 3, H, W) with `albedo` (B, 3, H, W) as the auxiliary image."""
        key = (*frame.size, torch.get_num_threads())
        if key != self.key:  # creating a filter is slow
            self.filter = RayTracingFilter(*key, self.quality)
            self.key = key
        inputs = (radiance.clamp(min=0), albedo.clamp(0, 1), frame.normal.clamp(-1, 1))
        return torch.stack([*map(self.filter, *inputs)])

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return self.denoise(frame, frame.radiance(self.signal), frame.albedo), State(frame.moment)


class OIDNBalanced(OIDN):
    """OIDN in its quality "balanced"."""

    baseline_for = ()
    evaluated_with = ()
    quality = "balanced"


class OIDNFast(OIDN):
    """OIDN in its quality "fast"."""

    baseline_for = ()
    evaluated_with = ()
    quality = "fast"


class OIDNIrradiance(OIDN):
    """Denoises irradiance + emission, with an albedo of 1; the albedo is multiplied afterwards, of irradiance alone."""

    baseline_for = ()
    evaluated_with = ()

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        emission = frame.emission if self.signal == "total" else 0
        denoised = self.denoise(frame, frame.irradiance(self.signal) + emission, torch.ones_like(frame.albedo))
        return frame.remodulate((denoised - emission).clamp(min=0), self.signal), State(frame.moment)


class OIDNAccumulated(Accumulating, OIDN):
    """Denoises temporally accumulated radiance. The history is not filtered."""

    has_kernels = True
    baseline_for = ()
    evaluated_with = ("adaptive",)

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        history = self.accumulated(frame, matching_state(state, AccumulatedState, frame))
        radiance = frame.remodulate(history.irradiance, self.signal)
        return self.denoise(frame, radiance, frame.albedo), AccumulatedState(frame.moment, history)
