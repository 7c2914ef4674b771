"""`onespp bench export`: milliseconds of an exported denoiser under onnxruntime, next to onespp."""

from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tabulate import tabulate
from torch import Tensor

from datasets.frame import Frame
from eval.bench.sizes import Size, bench_folder, parse_size, threads_or_all
from eval.bench.synthetic_frames import synthetic_frame
from eval.bench.timed import TIMED_FRAMES, WARM_UP_FRAMES, TimedDenoiser
from files import write_json
from models.export.package import largest_difference
from models.export.program import check_installed, play, run_onnx, trace, write_onnx
from models.export.registry import check_exportable, step_of
from models.export.step import Step, Warp
from models.spec import DenoiserSpec
from provenance import device_in_words
from timing import take_turns, thread_count

COMPILED = "onespp, compiled"
PYTORCH = "onespp, PyTorch"
EXPORTED: dict[str, Warp] = {"onnxruntime": "inside", "onnxruntime, our warp outside": "outside"}
EXAMPLE_SIZE = (24, 32)

Play = Callable[[], Tensor]  # the radiance of the sequence's next frame


class TimedSequence:
    """A sequence that several denoisers process in turn: `frame` is the current one."""

    frame: Frame

    def __init__(self, size: Size):
        self.size = size

    def go_to(self, index: int) -> None:
        self.frame = synthetic_frame(index, *self.size)

    def frames(self) -> Iterator[Frame]:
        while True:
            yield self.frame

    def ours(self, spec: DenoiserSpec) -> Play:
        timed = TimedDenoiser.of(spec)

        def next_frame() -> Tensor:
            with spec.running():
                radiance, timed.state = timed.denoiser(self.frame, timed.state)
            return radiance

        return next_frame

    def exported(self, step: Step, file: Path, threads: int) -> Play:
        playing = play(step, self.frames(), run_onnx(file, threads))
        return lambda: next(playing)[1]["radiance"]


@torch.inference_mode()
def bench_export(
    runs: Path,
    name: str = "wskp6",
    size: str = "1280x720",
    threads: int | None = None,
    measured: int = TIMED_FRAMES,
) -> str:
    """Measure milliseconds per frame in float32. Returns a table and writes RUNS/bench/export.json.

    Weights are random. The time with the warp outside includes onespp's reprojection. Raises BadInput for a denoiser
    that cannot be exported, missing packages, and an invalid size or number of threads.
    """
    check_exportable(name)
    check_installed("onnx")
    pixels = parse_size(size)
    count = threads_or_all(threads)
    sequence = TimedSequence(pixels)
    operators: dict[str, int] = {}
    radiance: dict[str, Tensor] = {}
    with thread_count(count), TemporaryDirectory() as folder:
        ways = {
            COMPILED: sequence.ours(DenoiserSpec.named(name)),
            PYTORCH: sequence.ours(DenoiserSpec.named(name, compiled=False)),
        }
        for way, warp in EXPORTED.items():
            step = step_of(DenoiserSpec.named(name).build(), warp)
            file = Path(folder) / f"{warp}.onnx"
            with torch.inference_mode(False):
                operators[way] = write_onnx(trace(step, synthetic_frame(0, *EXAMPLE_SIZE)), step, file).total
            ways[way] = sequence.exported(step, file, count)

        def keeping(way: str, next_frame: Play) -> Callable[[], None]:
            return lambda: radiance.update({way: next_frame()})

        work = {way: keeping(way, next_frame) for way, next_frame in ways.items()}
        seconds = take_turns(work, measured, WARM_UP_FRAMES, sequence.go_to, label="export")
    ms = {way: 1e3 * median(spent) for way, spent in seconds.items()}
    rows: list[dict[str, Any]] = [
        {
            "way": way,
            "ms": ms[way],
            "times ours": ms[way] / ms[COMPILED],
            "operators": operators.get(way),
            "largest difference": largest_difference(radiance[way], radiance[COMPILED]),
        }
        for way in ways
    ]
    height, width = pixels
    device = device_in_words(threads=count)
    content = {"denoiser": name, "device": device, "threads": count, "height": height, "width": width, "rows": rows}
    write_json(bench_folder(runs) / "export.json", content)
    return tabulate(rows, "keys", floatfmt=".3g", missingval="-")
