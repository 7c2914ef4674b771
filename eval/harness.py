"""The evaluation harness: every denoiser over every test clip, one streaming pass a clip."""

import math
import multiprocessing
import shutil
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from signal import SIG_IGN, SIGINT
from signal import signal as on_signal
from typing import Any, NamedTuple

import numpy as np
import torch
from tqdm import tqdm

from allocator import keep_freed_memory
from datasets.clip import Clip, Dataset
from datasets.frame import Signal, read_frame, to_tensor
from datasets.tonemap import display
from errors import BadInput
from eval.bench.denoisers import thread_count
from eval.clip_run import Track, Truth
from eval.results import (
    BASELINES,
    SIGNALS,
    ClipResults,
    Result,
    by_clip,
    device,
    folder_of,
    folders_of,
    is_finished,
    label,
    load_picture,
    load_result,
    save_picture,
    write_results,
)
from eval.strip import save_strip
from eval.text_table import table
from models.denoiser import Denoiser
from models.operators import finite
from models.registry import DENOISERS, create, load, unavailable, without_taa
from train.loop import WEIGHTS, run_folder
from train.recipes import TRAINABLE

METRICS_CHANNELS = ("motion", "dual_motion")
PIXELS_A_THREAD = 256 * 256  # with fewer, threads mostly wait for each other
SMALLEST_SHARE = 500_000  # pixels of all frames: what is evaluated while another process starts


def clips_of_one_spp(dataset: Dataset) -> list[Clip]:
    """The test clips of one sample a pixel: those of more show the same frames again. Raises BadInput without any."""
    clips = [clip for clip in dataset.clips("test") if clip.facts["noisy_spp"] == 1]
    if not clips:
        raise BadInput(f"{dataset.path} has no test clips of 1 spp: render another with `onespp dataset`")
    return clips


def is_still(clip: Clip) -> bool:
    """Whether neither the camera nor any mesh moves in the clip."""
    first = clip.view(0)
    views = (clip.view(frame) for frame in range(1, clip.frames))
    return all(np.array_equal(a, b) for view in views for a, b in zip(first, view, strict=True))


def signals_of(tracks: Sequence[Track]) -> list[Signal]:
    present = {track.signal for track in tracks}
    return [signal for signal in SIGNALS if signal in present]


@torch.no_grad()
def play(clip: Clip, tracks: Sequence[Track | Truth], folders: Sequence[Path], quiet: bool = False) -> None:
    """Run all tracks over a clip frame by frame, in memory that does not grow with its length; keep what they show.

    Each is held to the reference of the signal that it returns.
    """
    reads = {name for track in tracks if isinstance(track, Track) for name in track.denoiser.reads}
    channels, still = sorted(reads | set(METRICS_CHANNELS)), is_still(clip)
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False, disable=quiet):
        frame = read_frame(clip, index, channels)
        halves = {
            signal: to_tensor(clip.reference(index, signal), has_halves=True)[0]
            for signal in {track.signal for track in tracks}
        }
        for track, folder in zip(tracks, folders, strict=True):
            output = track.step(frame, halves[track.signal], clip.exposure, still)
            image = display(finite(output), clip.exposure)[0].permute(1, 2, 0)
            save_picture(folder, index, image.numpy())


def everyone_on(clip: Clip, tracks: Sequence[Track], runs: Path) -> list[tuple[Track | Truth, Path, bool]]:
    """All tracks and their references, with their folders and whether their results are there."""
    everyone: list[Track | Truth] = [*tracks, *(Truth(signal) for signal in signals_of(tracks))]
    folders = [folder_of(runs, clip.scene, clip.name, track.name, track.signal) for track in everyone]
    return [
        (track, folder, is_finished(folder, track.key(clip))) for track, folder in zip(everyone, folders, strict=True)
    ]


def evaluate_clip(clip: Clip, tracks: Sequence[Track], runs: Path, quiet: bool = False) -> list[Result]:
    """The results of all tracks and of their references: evaluated, where they are not there yet, and kept."""
    everyone = everyone_on(clip, tracks, runs)
    waiting = [(track, folder) for track, folder, finished in everyone if not finished]
    for _, folder in waiting:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    if waiting:
        threads = max(1, min(torch.get_num_threads(), clip.height * clip.width // PIXELS_A_THREAD))
        with thread_count(threads):
            play(clip, [track for track, _ in waiting], [folder for _, folder in waiting], quiet)
    for track, _ in waiting:
        track.result(clip).save(runs)
    return [load_result(folder) for _, folder, _ in everyone]


class Job(NamedTuple):
    """A clip for a process of its own."""

    path: Path
    names: list[str]
    runs: Path
    profile: str
    threads: int

    def run(self) -> None:
        torch.set_num_threads(self.threads)
        denoisers = ready_denoisers(self.names, self.runs, self.profile)
        evaluate_clip(Clip(self.path), tracks_of(denoisers), self.runs, quiet=True)


def start_worker() -> None:
    """An interrupt is the parent's to act on. Ended then, a worker must not leave behind a lock that bars share."""
    on_signal(SIGINT, SIG_IGN)
    keep_freed_memory()
    tqdm.set_lock(threading.RLock())


def evaluate_in_processes(clips: Sequence[Clip], names: list[str], runs: Path, profile: str, processes: int) -> None:
    """Evaluate clips side by side."""
    threads = max(1, torch.get_num_threads() // processes)
    jobs = [Job(clip.path, names, runs, profile, threads) for clip in clips]
    with multiprocessing.get_context("spawn").Pool(processes, start_worker) as pool:
        for _ in tqdm(pool.imap_unordered(Job.run, jobs, chunksize=1), "clips", len(jobs), unit="clip"):
            pass


def ready_denoisers(names: list[str] | None, runs: Path, profile: str) -> dict[str, tuple[Denoiser, str | None]]:
    """Denoisers to evaluate, with the file of their weights. Without `names` all that can run.

    Raises BadInput where a named one is unknown or has no weights.
    """
    ready: dict[str, tuple[Denoiser, str | None]] = {}
    for name in names or DENOISERS:
        if not names and (reason := unavailable(name)):
            print(f"{name}: skipped, {reason}")
            continue
        trained = create(name).parameter_count() > 0
        weights = run_folder(runs, without_taa(name), profile) / WEIGHTS if trained else None
        if weights and not weights.exists() and not names:
            remedy = f"; train them with `onespp train {name}`" if name in TRAINABLE else ""
            print(f"{name}: skipped, it has no weights at {weights}{remedy}")
            continue
        ready[name] = load(name, weights), str(weights) if weights else None
    return ready


def tracks_of(denoisers: Mapping[str, tuple[Denoiser, str | None]]) -> list[Track]:
    """A track for each denoiser.

    Beside one that returns indirect light alone, the baselines that were asked for run a second time, on that alone.
    """
    tracks = [Track(name, denoiser, weights) for name, (denoiser, weights) in denoisers.items()]
    if "indirect" in signals_of(tracks):
        for name in [name for name in BASELINES if name in denoisers]:
            tracks.append(Track(name, load(name, None, signal="indirect"), None))
    return tracks


def save_strips(runs: Path, results: ClipResults) -> None:
    """A PNG of a frame late in the clip as each denoiser shows it."""
    index = len(results.reference.frames) * 3 // 4
    images = {name: load_picture(folder, index) for name, folder in folders_of(runs, results).items()}
    errors = {result.denoiser: result.frames[index] for result in results.tracks}
    name = label(f"{results.scene}-{results.clip}", results.signal)
    save_strip(runs / "eval" / f"{name}.png", images, errors)


def evaluate(
    data: Path, runs: Path, profile: str, names: list[str] | None = None, processes: int = 1
) -> dict[str, Any]:
    """Evaluate over the test clips; writes RUNS/eval: results.json, frames.csv, and a PNG strip a clip and signal.

    What has been evaluated before, of the same clips, weights and code, is kept. Returns the results. Strips of
    indirect light have names that end in `-indirect`.
    """
    clips = Dataset(data).clips("test")
    denoisers = ready_denoisers(names, runs, profile)
    (runs / "eval").mkdir(parents=True, exist_ok=True)
    waiting = [c for c in clips if not all(done for _, _, done in everyone_on(c, tracks_of(denoisers), runs))]
    pixels = sum(clip.frames * clip.height * clip.width for clip in waiting)
    processes = min(processes, len(waiting), math.ceil(pixels / SMALLEST_SHARE))
    if processes > 1:
        evaluate_in_processes(waiting, list(denoisers), runs, profile, processes)
    results = [result for clip in clips for result in evaluate_clip(clip, tracks_of(denoisers), runs)]
    content = write_results(runs, data, device(), results, {name: weights for name, (_, weights) in denoisers.items()})
    for group in by_clip(results):
        save_strips(runs, group)
    print(table(list(by_clip(results))))
    return content
