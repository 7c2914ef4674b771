"""`onespp relight`: a page that dims and tints the lights of a denoised sequence."""

from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.tonemap import clip_exposure, luminance
from denoise.exr_image import ExrImage
from denoise.layers import COLOUR
from denoise.parts import part_layer
from denoise.sequence import sequence_of
from errors import BadInput
from files import write_file
from web_page import filled, packed

# RGB9E5, OpenGL 4.6, §8.5.2: three mantissas and a shared exponent.
RGB9E5_BITS = 9
RGB9E5_BIAS = 15
RGB9E5_MAX = (1 - 2.0**-RGB9E5_BITS) * 2.0 ** (31 - RGB9E5_BIAS)

MOST_PAGE_PIXELS = 100_000_000  # of all lights and frames; a browser takes four bytes for each


def representable(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Radiance in [0, RGB9E5_MAX]; NaN becomes 0."""
    return np.nan_to_num(radiance.astype(np.float64)).clip(0, RGB9E5_MAX)


def shared_exponents(radiance: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Representable radiance (H, W, 3) as RGB9E5 (H, W), to within 1/512 of each pixel's largest channel."""
    radiance = representable(radiance)
    largest = radiance.max(axis=-1)
    exponents = np.maximum(np.frexp(largest)[1], -RGB9E5_BIAS)
    exponents += np.round(np.ldexp(largest, RGB9E5_BITS - exponents)) == 2**RGB9E5_BITS  # rounded up to the next
    mantissas = np.round(np.ldexp(radiance, (RGB9E5_BITS - exponents)[..., None])).astype(np.uint32)
    red, green, blue = np.moveaxis(mantissas, -1, 0)
    biased = (exponents + RGB9E5_BIAS).astype(np.uint32)
    return red | green << RGB9E5_BITS | blue << 2 * RGB9E5_BITS | biased << 3 * RGB9E5_BITS


def lights_of(path: Path, layers: Sequence[str]) -> NDArray[np.float32]:
    """The radiance (light, H, W, 3) of the named layers. Raises BadInput where one is missing or has one channel."""
    image = ExrImage(path)
    found = [part_layer(name, image) for name in layers]
    if single := [layer.name for layer in found if len(layer.channels) == 1]:
        raise BadInput(f"{path}: '{single[0]}' has one channel, and so is no light: name layers with R, G and B")
    return np.stack([image.stacked(layer.channels) for layer in found])


def packed_lights(lights: NDArray[np.float32]) -> list[str]:
    return [packed(shared_exponents(light).tobytes()) for light in lights]


def packed_frame(path: Path, layers: Sequence[str], height: int, width: int) -> list[str]:
    """The lights of a frame. Raises BadInput as `lights_of`, and for an image of another size."""
    lights = lights_of(path, layers)
    if lights.shape[1:3] != (height, width):
        size = f"{lights.shape[2]} x {lights.shape[1]}"
        raise BadInput(f"{path} has {size} pixels, the frames before {width} x {height}")
    return packed_lights(lights)


def relit(patterns: Sequence[str], layers: Sequence[str], frames: str | None = None) -> dict[str, Any]:
    """What the page shows: the layers' names, and packed frames by layer.

    Raises BadInput as `packed_frame`, and for more frames than a browser could hold.
    """
    files = [frame.passes[COLOUR] for frame in sequence_of({COLOUR: patterns}, frames)]
    first = lights_of(files[0], layers)
    count, height, width, _ = first.shape
    most = max(1, MOST_PAGE_PIXELS // (count * height * width))
    if len(files) > most:
        raise BadInput(f"{len(files)} frames are too many for a page: show {most} of them with --frames A-B")
    others = tqdm(files[1:], "reading", initial=1, total=len(files), unit="frame", leave=False)
    return {
        "layers": [*layers],
        "width": width,
        "height": height,
        "exposure": clip_exposure(luminance(representable(first).sum(axis=0))),
        "frames": [packed_lights(first), *(packed_frame(path, layers, height, width) for path in others)],
    }


def write_relight_page(patterns: Sequence[str], layers: Sequence[str], out: Path, frames: str | None = None) -> None:
    """Write one HTML file that works offline. Raises BadInput as `relit`, and for no layers or one named twice."""
    if not layers or len(set(layers)) < len(layers):
        raise BadInput("name the lights' layers, each once: --lights key fill")
    out.parent.mkdir(parents=True, exist_ok=True)
    template = resources.files("denoise").joinpath("relight.html").read_text()
    write_file(out, filled(template, relit(patterns, layers, frames)).encode())
