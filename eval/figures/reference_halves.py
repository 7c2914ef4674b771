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
    """Yield, for each of `spps`, two halves (2, H, W, 3) of the reference radiance of a scene's first frame.

    Each half has spp/2 samples and a seed of its own, as in a data set; `size` is (height, width).
    Raises BadInput for an unknown scene.
    """
    shot = Shot(Stage(build_scene(name, seed, 1), *size), 0)
    for index, spp in enumerate(tqdm(spps, "references", leave=False)):
        yield np.stack([shot.radiance(2 * index + half, spp // 2) for half in (0, 1)])
