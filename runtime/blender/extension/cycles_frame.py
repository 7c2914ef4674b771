"""One frame of Cycles as the denoiser takes it: the passes of a multi-layer file in the conventions of the runtime."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .exr import BadFrame, ExrReader

Image = NDArray[np.float32]

SKY_DEPTH = 1e9  # from here on a pixel is background: Cycles writes 1e10
NEEDED = {  # passes and their components
    "Combined": "RGBA",
    "Denoising Albedo": "RGB",
    "Normal": "XYZ",
    "Depth": "Z",
    "Vector": "XYZW",
}
NOISY = "Noisy Image"  # in place of Combined, where Blender's own denoiser was on
EMISSION = ("Emission", "Emit")  # since Blender 5.0, and before


@dataclass(frozen=True)
class CyclesFrame:
    """Images (H, W, C) as of `onespp_runtime.Denoiser.denoise`; color is without emission, which background is, too."""

    color: Image
    albedo: Image
    normal: Image
    depth: Image
    motion: Image
    emission: Image
    alpha: Image  # (H, W)
    samples: float  # per pixel

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        height, width = self.alpha.shape
        return height, width


def read_cycles_frame(path: Path) -> CyclesFrame:
    """Raises BadFrame where the file is no such frame, and OSError where it cannot be read."""
    file = ExrReader(path)
    layer = layer_of(file)
    emission = next((name for name in EMISSION if f"{layer}.{name}.R" in file.channels), None)
    radiance = NOISY if f"{layer}.{NOISY}.R" in file.channels else "Combined"
    passes = NEEDED | {radiance: "RGBA"} | ({emission: "RGB"} if emission else {})
    planes = file.planes(f"{layer}.{name}.{c}" for name, components in passes.items() for c in components)

    def image(name: str) -> Image:
        return np.stack([planes[f"{layer}.{name}.{c}"] for c in passes[name]], axis=-1)

    depth = image("Depth")
    surface = (depth > 0) & (depth < SKY_DEPTH)
    light = image(radiance)
    seen = image(emission) if emission else np.zeros_like(light[..., :3])
    normal = image("Normal")
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return CyclesFrame(
        color=np.where(surface, light[..., :3] - seen, 0),
        albedo=np.where(surface, np.nan_to_num(image("Denoising Albedo"), posinf=0), 1).clip(0, 1),
        normal=np.where(surface, normal / np.maximum(length, 1e-6), 0),  # a mean of samples is shorter than 1
        depth=np.where(surface, depth, 0),
        motion=image("Vector")[..., :2] * np.array([1, -1], np.float32),  # to the frame before, with y up
        emission=np.where(surface, seen, light[..., :3]),
        alpha=light[..., 3],
        samples=float(file.attribute(f"cycles.{layer}.samples") or 1),
    )


def layer_of(file: ExrReader) -> str:
    """The name of the view layer that has all passes. Raises BadFrame where there is none, or more than one."""
    layers = {name.rsplit(".", 2)[0] for name in file.channels if name.count(".") > 1}
    lacking = {
        layer: [name for name, parts in NEEDED.items() if f"{layer}.{name}.{parts[-1]}" not in file.channels]
        for layer in sorted(layers)
    }
    complete = [layer for layer, missing in lacking.items() if not missing]
    if len(complete) == 1:
        return complete[0]
    if complete:
        raise BadFrame(
            f"{file.path} has the view layers {', '.join(complete)}: only one can be denoised; turn off the others"
        )
    missing = min(lacking.values(), key=len, default=list(NEEDED))
    raise BadFrame(
        f"{file.path} lacks the passes {', '.join(missing)}: set them by Denoise Animation and render again"
        " (with motion blur there is no Vector)"
    )
