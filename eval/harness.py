"""The evaluation harness: every denoiser on every test clip, in one streaming pass per clip."""

import math
import multiprocessing
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from signal import SIG_IGN, SIGINT
from signal import signal as on_signal
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from errors import BadInput, can_draw
from eval.bench.synthetic_frames import synthetic_frame
from eval.clip_run import DenoiserRun, NamedDenoiser, ReferenceRun, Run, run_clip
from eval.results import (
    SIGNALS,
    ClipResults,
    Result,
    by_clip,
    folder_of,
    heading,
    is_finished,
    load_picture,
    load_result,
    write_results,
)
from eval.selection import evaluated, with_indirect_baselines
from eval.tables import results_table, table_by_age
from files import locked
from models.spec import DenoiserSpec
from process import set_up_process
from provenance import device_in_words
from timing import thread_count, threads_for

if TYPE_CHECKING:
    from plotting import Figure

COMPILED_SIZE = (32, 48)  # px: a frame on which denoisers are run to compile their kernels
SMALLEST_SHARE = 500_000  # pixels of all frames, evaluated in about the time in which another process starts


def clips_of_one_spp(dataset: Dataset) -> list[Clip]:
    """The test clips of 1 spp; those of more spp show the same frames. Raises BadInput without any."""
    clips = [clip for clip in dataset.clips("test") if clip.facts["noisy_spp"] == 1]
    if not clips:
        raise BadInput(f"{dataset.path} has no test clips of 1 spp: render another with `onespp dataset`")
    return clips


def named_denoisers(specs: Sequence[DenoiserSpec]) -> list[NamedDenoiser]:
    """The denoisers of all specs, and the baselines of indirect light if any spec returns that."""
    return [NamedDenoiser(spec, spec.name, saves_error=True) for spec in with_indirect_baselines(specs)]


def runs_through(clip: Clip, denoisers: Sequence[NamedDenoiser], runs: Path) -> dict[Path, Run]:
    """The runs of all denoisers, and of the references with which they are compared, by the folder of their results."""
    present = {denoiser.spec.returns for denoiser in denoisers}
    all_runs: list[Run] = [DenoiserRun(denoiser) for denoiser in denoisers]
    all_runs += [ReferenceRun(signal) for signal in SIGNALS if signal in present]
    return {folder_of(runs, clip.scene, clip.name, run.name, run.signal): run for run in all_runs}


def unfinished(clip: Clip, all_runs: dict[Path, Run]) -> dict[Path, Run]:
    return {folder: run for folder, run in all_runs.items() if not is_finished(folder, run.key(clip))}


def evaluate_clip(clip: Clip, denoisers: Sequence[NamedDenoiser], runs: Path, quiet: bool = False) -> list[Result]:
    """The results of all denoisers and of their references; what is missing is evaluated and stored."""
    all_runs = runs_through(clip, denoisers, runs)
    missing = unfinished(clip, all_runs)
    for folder in missing:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    if missing:
        with thread_count(threads_for(clip.height, clip.width)):
            run_clip(clip, missing, quiet)
    for run in missing.values():
        run.result(clip).save(runs)
    return [load_result(folder) for folder in all_runs]


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder of results. Raises BadInput where another process has it."""
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / ".lock") as ours:
        if not ours:
            raise BadInput(f"another process is writing {folder}: wait for it or use another --runs")
        yield


def evaluate_in_worker(specs: list[DenoiserSpec], runs: Path, threads: int, clip: tuple[Path, bool]) -> None:
    """Evaluate a clip, whose path and `first_hits` are given, in this process."""
    torch.set_num_threads(threads)
    evaluate_clip(Clip(*clip), named_denoisers(specs), runs, quiet=True)


def start_worker() -> None:
    """Keep freed memory, and the progress bars' lock within the process."""
    set_up_process()
    tqdm.set_lock(threading.RLock())


@torch.inference_mode()
def compile_kernels(spec: DenoiserSpec) -> None:
    """Denoise two small frames, so that the denoiser's kernels are in the cache on disk for every process."""
    denoiser = spec.build()
    state = None
    for index in range(2):
        _, state = denoiser(synthetic_frame(index, *COMPILED_SIZE).to(spec.device), state)


def do_all(
    pool: ProcessPoolExecutor, work: Callable[[Any], None], arguments: Sequence[Any], label: str, unit: str
) -> None:
    """Call `work` for each of the arguments in the pool's processes. Raises BadInput where one of these is killed."""
    try:
        before = on_signal(SIGINT, SIG_IGN)  # in the processes that begin with these calls: this one handles interrupts
        futures = [pool.submit(work, argument) for argument in arguments]
        on_signal(SIGINT, before)
        for future in tqdm(as_completed(futures), label, len(futures), unit=unit):
            future.result()
    except BrokenProcessPool:
        raise BadInput("a process was killed, probably for lack of memory: use fewer --processes") from None
    except BaseException:  # an interrupt, or an error in one process: wait for none of the others
        pool.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.terminate()
        raise


def evaluate_in_processes(clips: Sequence[Clip], specs: list[DenoiserSpec], runs: Path, processes: int) -> None:
    """Evaluate clips in parallel, after compiling kernels in parallel, those of networks first: they take longest."""
    work = partial(evaluate_in_worker, specs, runs, max(1, torch.get_num_threads() // processes))
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, start_worker) as pool:
        do_all(pool, compile_kernels, specs[::-1], "kernels", "denoiser")
        do_all(pool, work, [(clip.path, clip.first_hits) for clip in clips], "clips", "clip")


def sheet(runs: Path, results: ClipResults) -> "Figure":
    """The outputs of all denoisers for a frame at three quarters of the clip, and its reference, in rows."""
    from eval.figures.show import Panel, draw_grid, in_rows

    judged = results.reference.judged
    index = judged[len(judged) * 3 // 4]
    panels = []
    for result in (*results.results, results.reference):
        values = ((key, result.frames[index].get(key)) for key in ("rmse", "ssim"))
        errors = (f"{key.upper()} {value:.3f}" for key, value in values if value is not None)
        caption = f"{result.denoiser}\n{'' if result.floor else '  '.join(errors)}"
        picture = load_picture(folder_of(runs, result.scene, result.clip, result.denoiser, result.signal), index)
        panels.append(Panel(picture / 255, caption))
    columns = in_rows(panels)
    return draw_grid(columns, [f"frame {index}"] * len(columns[0]))


def save_sheets(runs: Path, clips: Iterable[ClipResults]) -> None:
    """Write a PNG per clip and signal, if the extra `report` is installed."""
    if not can_draw():
        print("no pictures: they need `pip install 'onespp[report]'`")
        return
    from plotting import save_figure

    for clip in clips:
        save_figure(runs / "eval" / f"{clip.file_name}.png", sheet(runs, clip))


def evaluate(
    data: Sequence[Path],
    runs: Path,
    budget: str,
    names: Sequence[str] = (),
    processes: int = 1,
    device: str = "cpu",
    first_hits: bool = False,
    smallest_share: int = SMALLEST_SHARE,
) -> dict[str, Any]:
    """Evaluate on the test clips of data sets; writes results.json, frames.csv and a PNG per clip and signal.

    These go to RUNS/eval; names of PNGs of indirect light end in `-indirect`. Earlier results of the same clips,
    weights and code are reused. `first_hits` describes mirrors and glass by their own surfaces. Returns the content of
    results.json. Raises BadInput where two data sets have clips of one name or another process writes there.
    """
    clips = [clip for path in data for clip in Dataset(path).clips("test", first_hits)]
    if twice := [name for name, count in Counter((clip.scene, clip.name) for clip in clips).items() if count > 1]:
        raise BadInput(f"{' and '.join(map(str, data))} both have {'/'.join(twice[0])}: evaluate them by themselves")
    specs = evaluated(names, runs, budget, device, clips)
    denoisers = named_denoisers(specs)
    with writing(runs / "eval"):
        missing = [clip for clip in clips if unfinished(clip, runs_through(clip, denoisers, runs))]
        pixels = sum(clip.frames * clip.height * clip.width for clip in missing)
        processes = min(processes, len(missing), math.ceil(pixels / smallest_share))
        if processes > 1:
            evaluate_in_processes(missing, specs, runs, processes)
        results = [result for clip in clips for result in evaluate_clip(clip, denoisers, runs)]
        weights = {spec.name: str(spec.weights) if spec.weights else None for spec in specs}
        content = write_results(runs, data, device_in_words(device), results, weights, first_hits)
        judged = list(by_clip(results))
        save_sheets(runs, judged)
    print(f"{heading(content)}\n\n{results_table(judged)}\n\n{table_by_age(judged)}")
    return content
