"""`onespp relight`: a page that dims and colours the lights of a sequence after the fact."""

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

# Of pixels with three mantissas and one exponent, OpenGL 4.6, §8.5.2:
RGB9E5_BITS = 9
RGB9E5_BIAS = 15
RGB9E5_MAX = (1 - 2.0**-RGB9E5_BITS) * 2.0 ** (31 - RGB9E5_BIAS)

MOST_PAGE_PIXELS = 100_000_000  # of all lights and frames; a browser takes four bytes for each


def shared_exponents(radiance: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Radiance (H, W, 3) as RGB9E5 (H, W): to within 1/1024 of the largest channel; negative and NaN become 0."""
    radiance = np.nan_to_num(radiance.astype(np.float64)).clip(0, RGB9E5_MAX)
    largest = radiance.max(axis=-1)
    exponents = np.maximum(np.frexp(largest)[1], -RGB9E5_BIAS)
    exponents += np.round(np.ldexp(largest, RGB9E5_BITS - exponents)) == 2**RGB9E5_BITS  # rounded up to the next
    mantissas = np.round(np.ldexp(radiance, (RGB9E5_BITS - exponents)[..., None])).astype(np.uint32)
    red, green, blue = np.moveaxis(mantissas, -1, 0)
    biased = (exponents + RGB9E5_BIAS).astype(np.uint32)
    return red | green << RGB9E5_BITS | blue << 2 * RGB9E5_BITS | biased << 3 * RGB9E5_BITS


def lights_of(path: Path, layers: Sequence[str], size: tuple[int, int]) -> list[NDArray[np.float32]]:
    """The radiance (H, W, 3) of the named layers of a file.

    Raises BadInput where one is missing or has a single channel, or the image is not (width, height) = `size`.
    """
    image = ExrImage(path)
    if size != (image.width, image.height):
        raise BadInput(f"{path} has {image.width} x {image.height} pixels, the frames before {size[0]} x {size[1]}")
    found = [part_layer(name, image) for name in layers]
    if single := [layer.name for layer in found if len(layer.channels) == 1]:
        raise BadInput(f"{path}: '{single[0]}' has one channel, and so is no light: name layers with R, G and B")
    return [image.stacked(layer.channels) for layer in found]


def relit(patterns: Sequence[str], layers: Sequence[str], frames: str | None = None) -> dict[str, Any]:
    """What the page shows: the layers' names, and packed frames by layer.

    Raises BadInput as `lights_of`, and for more frames than a browser could hold.
    """
    files = [frame.passes[COLOUR] for frame in sequence_of({COLOUR: patterns}, frames)]
    first = ExrImage(files[0], header_only=True)
    size = first.width, first.height
    pixels = len(layers) * first.width * first.height
    if len(files) * pixels > MOST_PAGE_PIXELS:
        most = max(1, MOST_PAGE_PIXELS // pixels)
        raise BadInput(f"{len(files)} frames are too many for a page: show {most} of them with --frames A-B")
    whole = np.sum(lights_of(files[0], layers, size), axis=0)
    content = {
        "layers": [*layers],
        "width": size[0],
        "height": size[1],
        "exposure": clip_exposure(luminance(np.nan_to_num(whole))),
    }
    reading = tqdm(files, "reading", unit="frame", leave=False)
    return content | {"frames": [packed_lights(lights_of(path, layers, size)) for path in reading]}


def packed_lights(lights: Sequence[NDArray[np.float32]]) -> list[str]:
    return [packed(shared_exponents(light).tobytes()) for light in lights]


def write_relight_page(patterns: Sequence[str], layers: Sequence[str], out: Path, frames: str | None = None) -> None:
    """Write one HTML file that works offline. Raises BadInput as `relit`, and for no layers or one named twice."""
    if not layers or len(set(layers)) < len(layers):
        raise BadInput("name the lights' layers, each once: --lights key fill")
    template = resources.files("denoise").joinpath("relight.html").read_text()
    write_file(out, filled(template, relit(patterns, layers, frames)).encode())
