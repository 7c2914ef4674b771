"""`onespp bench rendering`: seconds to a noise floor, next to stock Mitsuba on the same frames in the same run."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from statistics import median
from typing import NamedTuple

from tabulate import tabulate
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean, psnr
from eval.bench.sizes import bench_folder
from eval.bench.stock import Render, stock_render
from files import write_json
from render.backend import VARIANT, dr
from render.shot import Shot
from render.stage import Stage
from scenes.registry import build_scene
from timing import take_turns

BENCH_SCENES = ("cornell_box", "cornell_box_moving", *(f"room-{number}" for number in range(6)))
SCENE_FRAMES = 24
FRAME = 8  # the one that is rendered
FIRST_SPP = 32
MOST_SPP = 512
TIMED_RENDERS = 3
TARGET_DB = 40.0
STOCK = "stock path, independent"
ONESPP = "onespp"


@dataclass(frozen=True)
class TimeToFloor:
    """How a renderer did on a frame.

    Attributes:
        spp: samples a pixel with which the noise was first down to the target, or MOST_SPP.
        samples_per_second: paths from the camera.
        floor: PSNR in dB, as displayed, of the mean of two halves of the samples.
        seconds: to the target. Where `spp` was not enough, they are extrapolated: noise falls as 1 / spp.
        ratio: of stock Mitsuba's seconds.
        kernels, compiling: see Compilations; None for stock Mitsuba, whose first frame is not looked at.
    """

    scene: str
    renderer: str
    spp: int
    samples_per_second: float
    floor: float
    seconds: float
    extrapolated: bool
    ratio: float
    kernels: int | None = None
    compiling: float | None = None  # seconds


def displayed_noise(render: Render, exposure: float, spp: int) -> float:
    """Mean squared error of the mean of two halves of so many samples, as displayed."""
    a, b = (display(render(1 + half, spp // 2), exposure) for half in (0, 1))
    return noise_of_mean(a, b)


def samples_needed(render: Render, exposure: float, target: float) -> tuple[int, float]:
    """(samples a pixel, noise) where the noise is first down to `target`, or at MOST_SPP."""
    spp = FIRST_SPP
    while (noise := displayed_noise(render, exposure, spp)) > target and spp < MOST_SPP:
        spp *= 2
    return spp, noise


class Compilations(NamedTuple):
    """Kernels that a scene needed for its first frame and that nothing in this process had compiled before."""

    kernels: int
    compiling: float  # seconds, 0 where they lay on disk


def first_frame(scene: str, size: int) -> tuple[Shot, Compilations]:
    """A frame of `size` x `size` pixels, ready to be sampled, and what it took to compile."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        shot = Shot(Stage(build_scene(scene, 0, SCENE_FRAMES), size, size), FRAME)
        shot.radiance(0, 1)
        launched = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
    new = [kernel for kernel in launched if kernel["cache_disk"] or not kernel["cache_hit"]]
    return shot, Compilations(len(new), sum(kernel["backend_time"] for kernel in new) / 1e3)


def rendering_halves(render: Render, spp: int) -> Callable[[], None]:
    """A function that renders both halves of so many samples, with other seeds at every call."""
    seeds = count(step=100)

    def work() -> None:
        seed = next(seeds)
        render(seed, spp // 2)
        render(seed + 1, spp // 2)

    return work


def times_to_floor(scene: str, size: int, measured: int) -> list[TimeToFloor]:
    """How both renderers do on a frame of `size` x `size` pixels, stock Mitsuba first.

    Both share the exposure of ours. Raises BadInput for an unknown scene.
    """
    shot, compiled = first_frame(scene, size)
    renders: dict[str, Render] = {STOCK: stock_render(shot), ONESPP: shot.radiance}
    exposure = clip_exposure(luminance(shot.radiance(9, 256)))
    target = 10 ** (-TARGET_DB / 10)
    reached = {renderer: samples_needed(render, exposure, target) for renderer, render in renders.items()}
    work = {renderer: rendering_halves(render, reached[renderer][0]) for renderer, render in renders.items()}
    spent = take_turns(work, measured, warm_up=0, label=scene)  # to find the samples was warm-up enough
    rows: list[TimeToFloor] = []
    for renderer, (spp, noise) in reached.items():
        seconds = median(spent[renderer])
        # Where the target is passed, fewer samples would have done, by the same law.
        to_target = seconds * noise / target
        row = TimeToFloor(
            scene=scene,
            renderer=renderer,
            spp=spp,
            samples_per_second=size * size * spp / seconds,
            floor=psnr(noise),
            seconds=to_target,
            extrapolated=noise > target,
            ratio=to_target / rows[0].seconds if rows else 1.0,
            **(compiled._asdict() if renderer == ONESPP else {}),
        )
        rows.append(row)
    dr.flush_malloc_cache()
    return rows


def bench_rendering(
    runs: Path, scenes: Sequence[str] = BENCH_SCENES, size: int = 96, measured: int = TIMED_RENDERS
) -> str:
    """Samples a second and seconds to 40 dB on a frame of each scene: a table, and RUNS/bench/rendering.json.

    A frame has `size` x `size` pixels. Raises BadInput for an unknown scene.
    """
    names = tqdm(scenes or BENCH_SCENES, "scenes", leave=False)
    rows = [asdict(row) for name in names for row in times_to_floor(name, size, measured)]
    content = {
        "variant": VARIANT,
        "size": size,
        "frame": FRAME,
        "target_db": TARGET_DB,
        "rows": rows,
    }
    write_json(bench_folder(runs) / "rendering.json", content)
    heads = {
        "samples_per_second": "samples/s",
        "floor": "floor dB",
        "seconds": f"seconds to {TARGET_DB:.0f} dB",
        "kernels": "new kernels",
        "compiling": "compiling s",
    }
    return tabulate(rows, heads, floatfmt=("", "", ".0f", ".2e", ".1f", ".2f", "", ".3f", ".0f", ".2f"))
