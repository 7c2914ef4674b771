"""The evaluation harness: every denoiser over every test clip, one streaming pass a clip."""

import math
import multiprocessing
import shutil
import threading
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from signal import SIG_IGN, SIGINT
from signal import signal as on_signal
from typing import Any, NamedTuple

import torch
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from eval.clip_run import ClipRun, Entrant, ReferenceRun, Run, play
from eval.results import (
    SIGNALS,
    ClipResults,
    Result,
    by_clip,
    folder_of,
    folders_of,
    is_finished,
    load_picture,
    load_result,
    signal_label,
    write_results,
)
from eval.selection import evaluated, with_indirect_baselines
from eval.text_table import results_table
from extras import can_draw
from models.spec import DenoiserSpec
from process import set_up_process
from provenance import device_in_words
from timing import thread_count, threads_for

COMPILED_SIZE = (32, 48)  # px: a frame on which denoisers are run to compile their kernels
SMALLEST_SHARE = 500_000  # pixels of all frames: what is evaluated while another process starts


def clips_of_one_spp(dataset: Dataset) -> list[Clip]:
    """The test clips of one sample a pixel: those of more show the same frames again. Raises BadInput without any."""
    clips = [clip for clip in dataset.clips("test") if clip.facts["noisy_spp"] == 1]
    if not clips:
        raise BadInput(f"{dataset.path} has no test clips of 1 spp: render another with `onespp dataset`")
    return clips


def entrant(spec: DenoiserSpec, name: str | None = None, tells_error: bool = False) -> Entrant:
    """The denoiser of a spec, under the name that results are to give it."""
    name = name or spec.name
    return Entrant(name, spec.returns, spec.precision, spec.weights, spec.modules, spec.build, tells_error, spec.device)


def entrants_of(specs: Sequence[DenoiserSpec]) -> list[Entrant]:
    """An entrant for each spec, and for the baselines of indirect light if that is denoised."""
    return [entrant(spec, tells_error=True) for spec in with_indirect_baselines(specs)]


class Pass(NamedTuple):
    """One run through a clip: where its results belong, and whether they are there."""

    run: Run
    folder: Path
    finished: bool


def passes(clip: Clip, entrants: Sequence[Entrant], runs: Path) -> list[Pass]:
    """Those of all entrants and of the references that they are held to."""
    present = {entrant.signal for entrant in entrants}
    all_runs: list[Run] = [ClipRun(entrant) for entrant in entrants]
    all_runs += [ReferenceRun(signal) for signal in SIGNALS if signal in present]
    folders = [folder_of(runs, clip.scene, clip.name, run.name, run.signal) for run in all_runs]
    return [
        Pass(run, folder, is_finished(folder, run.key(clip))) for run, folder in zip(all_runs, folders, strict=True)
    ]


def evaluate_clip(clip: Clip, entrants: Sequence[Entrant], runs: Path, quiet: bool = False) -> list[Result]:
    """The results of all entrants and of their references: evaluated, where they are not there yet, and kept."""
    everyone = passes(clip, entrants, runs)
    waiting = [one for one in everyone if not one.finished]
    for one in waiting:
        shutil.rmtree(one.folder, ignore_errors=True)
        one.folder.mkdir(parents=True)
    if waiting:
        with thread_count(threads_for(clip.height, clip.width)):
            play(clip, [one.run for one in waiting], [one.folder for one in waiting], quiet)
    for one in waiting:
        one.run.result(clip).save(runs)
    return [load_result(one.folder) for one in everyone]


class ClipJob(NamedTuple):
    """A clip for a process of its own."""

    path: Path
    specs: list[DenoiserSpec]
    runs: Path
    threads: int

    def work(self) -> None:
        torch.set_num_threads(self.threads)
        evaluate_clip(Clip(self.path), entrants_of(self.specs), self.runs, quiet=True)


def start_worker() -> None:
    """An interrupt is the parent's to act on. Ended then, a worker must not leave behind a lock that bars share."""
    on_signal(SIGINT, SIG_IGN)
    set_up_process()
    tqdm.set_lock(threading.RLock())


@torch.inference_mode()
def compile_kernels(spec: DenoiserSpec) -> None:
    """Run a denoiser on small frames, so that its kernels are compiled and on disk for every process."""
    denoiser = spec.build()
    state = None
    for index in range(2):
        _, state = denoiser(synthetic_frame(index, *COMPILED_SIZE), state)


def evaluate_in_processes(clips: Sequence[Clip], specs: list[DenoiserSpec], runs: Path, processes: int) -> None:
    """Evaluate clips side by side. First the processes share out the kernels: else each would compile all of them."""
    threads = max(1, torch.get_num_threads() // processes)
    jobs = [ClipJob(clip.path, specs, runs, threads) for clip in clips]
    with multiprocessing.get_context("spawn").Pool(processes, start_worker) as pool:
        for _ in tqdm(pool.imap_unordered(compile_kernels, specs), "kernels", len(specs), unit="denoiser"):
            pass
        for _ in tqdm(pool.imap_unordered(ClipJob.work, jobs, chunksize=1), "clips", len(jobs), unit="clip"):
            pass


def save_strips(runs: Path, results: ClipResults) -> None:
    """A PNG of a frame late in the clip as each denoiser shows it."""
    from eval.strip import save_strip

    index = len(results.reference.frames) * 3 // 4
    images = {name: load_picture(folder, index) for name, folder in folders_of(runs, results).items()}
    errors = {result.denoiser: result.frames[index] for result in results.results}
    name = signal_label(f"{results.scene}-{results.clip}", results.signal)
    save_strip(runs / "eval" / f"{name}.png", images, errors)


def evaluate(
    data: Sequence[Path],
    runs: Path,
    budget: str,
    names: Sequence[str] = (),
    processes: int = 1,
    device: str = "cpu",
    smallest_share: int = SMALLEST_SHARE,
) -> dict[str, Any]:
    """Evaluate over the test clips of data sets; writes RUNS/eval: results.json, frames.csv, a PNG a clip and signal.

    What has been evaluated before, of the same clips, weights and code, is kept. Returns the results. Strips of
    indirect light have names that end in `-indirect`. Raises BadInput where two data sets have clips of one name.
    """
    clips = [clip for path in data for clip in Dataset(path).clips("test")]
    if twice := [name for name, count in Counter((clip.scene, clip.name) for clip in clips).items() if count > 1]:
        raise BadInput(f"{' and '.join(map(str, data))} both have {'/'.join(twice[0])}: evaluate them by themselves")
    specs = evaluated(names, runs, budget, device)
    entrants = entrants_of(specs)
    (runs / "eval").mkdir(parents=True, exist_ok=True)
    waiting = [clip for clip in clips if not all(one.finished for one in passes(clip, entrants, runs))]
    pixels = sum(clip.frames * clip.height * clip.width for clip in waiting)
    processes = min(processes, len(waiting), math.ceil(pixels / smallest_share))
    if processes > 1:
        evaluate_in_processes(waiting, specs, runs, processes)
    results = [result for clip in clips for result in evaluate_clip(clip, entrants, runs)]
    weights = {spec.name: str(spec.weights) if spec.weights else None for spec in specs}
    content = write_results(runs, data, device_in_words(device), results, weights)
    if can_draw():
        for group in by_clip(results):
            save_strips(runs, group)
    else:
        print("no pictures: they need `pip install 'onespp[report]'`")
    print(results_table(list(by_clip(results))))
    return content
