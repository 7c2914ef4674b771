"""`onespp bench rendering`: seconds to a noise floor, next to stock Mitsuba on the same frames."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import count
from pathlib import Path
from statistics import median

from tabulate import tabulate
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean, psnr
from eval.bench.sizes import bench_folder
from eval.bench.stock import Render, stock_render
from files import write_json
from render.backend import VARIANT, dr
from render.path import PosedFrame
from render.stage import Stage
from scenes.registry import build_scene
from timing import take_turns

BENCH_SCENES = ("cornell_box", "cornell_box_moving", *(f"room-{number}" for number in range(6)))
SCENE_FRAMES = 24
FRAME = 8  # the one that is rendered
FIRST_SPP = 32
MAX_SPP = 512
TIMED_RENDERS = 3
TARGET_DB = 40.0
STOCK = "stock path, independent"
ONESPP = "onespp"


@dataclass(frozen=True)
class TimeToFloor:
    """The speed of a renderer on a frame."""

    scene: str
    renderer: str
    spp: int  # the fewest samples per pixel, doubling, that reach the target, or MAX_SPP
    samples_per_second: float  # camera paths
    floor: float  # PSNR in dB of the displayed mean of two independent sample buffers
    seconds: float  # to the target, by the law that noise falls as 1 / spp
    extrapolated: bool  # whether `spp` was not enough
    ratio: float  # to the seconds of stock Mitsuba


def noise_mse(render: Render, exposure: float, spp: int) -> float:
    """Mean squared error of the displayed mean of two buffers of `spp` / 2 samples each."""
    a, b = (display(render(seed, spp // 2), exposure) for seed in (1, 2))
    return noise_of_mean(a, b)


def samples_needed(render: Render, exposure: float, target: float) -> tuple[int, float]:
    """(samples per pixel, noise) where the noise first reaches `target`, or at MAX_SPP."""
    spp = FIRST_SPP
    while (noise := noise_mse(render, exposure, spp)) > target and spp < MAX_SPP:
        spp *= 2
    return spp, noise


def rendering_buffers(render: Render, spp: int) -> Callable[[], None]:
    """A function that renders two buffers of `spp` / 2 samples each, with different seeds at every call."""
    seeds = count(step=100)

    def work() -> None:
        seed = next(seeds)
        render(seed, spp // 2)
        render(seed + 1, spp // 2)

    return work


def times_to_floor(scene: str, size: int, measured: int) -> list[TimeToFloor]:
    """The rows of both renderers for a frame of `size` x `size` pixels, stock Mitsuba first.

    Both use the same exposure. Raises BadInput for an unknown scene.
    """
    posed = PosedFrame(Stage(build_scene(scene, 0, SCENE_FRAMES), size, size), FRAME)
    renders: dict[str, Render] = {STOCK: stock_render(posed), ONESPP: posed.radiance}
    exposure = clip_exposure(luminance(posed.radiance(9, 256)))
    target = 10 ** (-TARGET_DB / 10)
    reached = {renderer: samples_needed(render, exposure, target) for renderer, render in renders.items()}
    work = {renderer: rendering_buffers(render, reached[renderer][0]) for renderer, render in renders.items()}
    spent = take_turns(work, measured, warm_up=0, label=scene)  # the search for spp was the warm-up
    rows: list[TimeToFloor] = []
    for renderer, (spp, noise) in reached.items():
        seconds = median(spent[renderer])
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
        )
        rows.append(row)
    dr.flush_malloc_cache()
    return rows


def bench_rendering(
    runs: Path, scenes: Sequence[str] = BENCH_SCENES, size: int = 96, measured: int = TIMED_RENDERS
) -> str:
    """Measure samples per second and seconds to 40 dB on a frame of `size` x `size` pixels of each scene.

    Returns a table and writes RUNS/bench/rendering.json. Raises BadInput for an unknown scene.
    """
    names = tqdm(scenes or BENCH_SCENES, "scenes", leave=False)
    rows = [asdict(row) for name in names for row in times_to_floor(name, size, measured)]
    content = {"variant": VARIANT, "size": size, "frame": FRAME, "target_db": TARGET_DB, "rows": rows}
    write_json(bench_folder(runs) / "rendering.json", content)
    heads = {"samples_per_second": "samples/s", "floor": "floor dB", "seconds": f"seconds to {TARGET_DB:.0f} dB"}
    return tabulate(rows, heads, floatfmt=("", "", ".0f", ".2e", ".1f", ".2f", "", ".3f"))
