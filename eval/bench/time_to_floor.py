"""Seconds to a given noise floor: our references against stock Mitsuba on the same frames, in one run."""

import time
from collections.abc import Callable, Iterable, Iterator
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from render.backend import dr, mi
from render.shot import FloatImage, Shot, finite_or_zero
from render.stage import Stage
from scenes.camera import View
from scenes.registry import build_scene

Display = Callable[[FloatImage], FloatImage]  # radiance to what is shown, in [0, 1]
Render = Callable[[int, int], FloatImage]  # (seed, spp) to radiance (H, W, 3)

SIZE, FRAMES, FRAME = 96, 24, 8
FIRST_SPP, MOST_SPP, REPEATS = 32, 512, 3
STOCK, OURS = "stock path, independent", "onespp"


class Row(NamedTuple):
    """How a renderer did on a frame. Where `spp` was not enough, `seconds` are extrapolated: noise falls as 1 / spp."""

    scene: str
    renderer: str
    spp: int
    samples_per_second: float  # paths from the camera
    floor: float  # mean squared error of the mean of two halves, as displayed
    seconds: float  # to the target
    extrapolated: bool


def perspective(stage: Stage, view: View) -> Any:
    """Mitsuba's own sensor for a view."""
    x_fov = np.degrees(2 * np.arctan(stage.width / 2 / -view.K[0, 0]))
    matrix = view.camera_to_world.copy()
    matrix[:3, 3] /= stage.unit
    film = {"type": "hdrfilm", "width": stage.width, "height": stage.height, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f(matrix.astype(np.float32))
    nearest = {"near_clip": 1e-3, "far_clip": 1e5}
    return mi.load_dict({"type": "perspective", "fov": float(x_fov), "to_world": to_world, "film": film, **nearest})


def stock(shot: Shot) -> Render:
    """`mi.render` with the `path` integrator and the `independent` sampler: all radiance."""
    integrator = mi.load_dict({"type": "path", "max_depth": shot.stage.scene.max_depth})
    sensor = perspective(shot.stage, shot.view)

    def render(seed: int, spp: int) -> FloatImage:
        scene = shot.stage.mitsuba_scene
        return finite_or_zero(
            np.array(mi.render(scene, sensor=sensor, integrator=integrator, seed=mi.UInt32(seed), spp=spp))
        )

    return render


def noise(render: Render, seed: int, spp: int, display: Display) -> float:
    a, b = (display(render(seed + half, spp // 2)) for half in (0, 1))
    return float(((a - b) ** 2).mean() / 4)


def timed(render: Render, seed: int, spp: int) -> float:
    start = time.perf_counter()
    render(seed, spp // 2)
    render(seed + 1, spp // 2)
    return time.perf_counter() - start


def enough(render: Render, target: float, display: Display) -> tuple[int, float]:
    """(spp, noise) where the noise is first down to `target`, or at MOST_SPP."""
    spp = FIRST_SPP
    while (floor := noise(render, 1, spp, display)) > target and spp < MOST_SPP:
        spp *= 2
    return spp, floor


def seconds_to_floor(names: Iterable[str], target: float, display_of: Callable[[FloatImage], Display]) -> Iterator[Row]:
    """Rows for both renderers on one frame of each scene, `target` an MSE.

    `display_of` makes the display transform from radiance (H, W, 3); both renderers share the one of ours.
    """
    for name in names:
        shot = Shot(Stage(build_scene(name, 0, FRAMES), SIZE, SIZE), FRAME)
        renderers = {STOCK: stock(shot), OURS: shot.radiance}
        display = display_of(renderers[OURS](9, 256))
        reached = {label: enough(render, target, display) for label, render in renderers.items()}
        spent: dict[str, list[float]] = {label: [] for label in renderers}
        for repeat in range(REPEATS):  # interleaved, so that drift of the machine hits both alike
            for label, render in renderers.items():
                spent[label].append(timed(render, 100 * repeat, reached[label][0]))
        for label, (spp, floor) in reached.items():
            seconds = median(spent[label])
            # Where the target is passed, fewer samples would have done, by the same law.
            to_target = seconds * floor / target
            yield Row(name, label, spp, SIZE * SIZE * spp / seconds, floor, to_target, floor > target)
        dr.flush_malloc_cache()
