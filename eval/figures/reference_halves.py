"""References of one frame at several sample counts, to see what their noise does to metrics."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from render.shot import Shot
from render.stage import Stage
from scenes.registry import build_scene


def reference_halves(
    name: str, size: tuple[int, int], spps: Sequence[int], seed: int = 0
) -> Iterator[NDArray[np.float64]]:
    """Yields two halves (2, H, W, 3) of the radiance of a scene's first frame, for each of `spps`.

    Both have spp / 2 samples a pixel and a seed of their own, as in a data set; `size` is (height, width) in pixels.
    Raises BadInput for an unknown scene.
    """
    height, width = size
    shot = Shot(Stage(build_scene(name, seed, frames=1), height, width), 0)
    for index, spp in enumerate(tqdm(spps, "references", leave=False)):
        yield np.stack([shot.radiance(2 * index + half, spp // 2) for half in (0, 1)])
