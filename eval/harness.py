"""The evaluation harness: every denoiser over every test clip, one streaming pass a clip."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.display import display, noise_of_halves, psnr
from datasets.files import write_json
from datasets.frame import Frame, Signal, read_frame, to_tensor
from eval.metrics import TemporalMetrics, disocclusion_l1, image_metrics
from eval.pictures import save_strip
from models import DENOISERS, create, load, unavailable, without_taa
from models.denoiser import Denoiser, State
from train.loop import WEIGHTS, run_folder
from train.recipes import TRAINABLE

METRICS_CHANNELS = ("motion", "dual_motion")
BASELINES = ("noisy", "accumulated")
SIGNALS: tuple[Signal, ...] = ("total", "indirect")


@dataclass
class Track:
    """One denoiser's way through one clip."""

    name: str
    denoiser: Denoiser
    weights: str | None
    state: State | None = None
    temporal: TemporalMetrics = field(default_factory=TemporalMetrics)
    per_frame: list[dict[str, float | None]] = field(default_factory=list)
    nonfinite: int = 0

    def step(self, frame: Frame, halves: Tensor, exposure: float, still: bool) -> Tensor:
        """Denoise one frame and measure it. Returns the radiance (1, 3, H, W)."""
        output, self.state = self.denoiser(frame, self.state)
        self.nonfinite += int((~torch.isfinite(output)).any(dim=1).sum())
        metrics = image_metrics(output, halves, exposure) | self.temporal.update(output, halves, exposure, still)
        metrics["disocclusion_l1"] = disocclusion_l1(output, halves, exposure, frame.motion, frame.dual_motion)
        self.per_frame.append(metrics)
        return output

    def means(self) -> dict[str, float | None]:
        """Arithmetic means over the frames where a metric is defined, None where it never is."""
        columns = {name: [row[name] for row in self.per_frame if row[name] is not None] for name in self.per_frame[0]}
        return {name: float(np.mean(values)) if values else None for name, values in columns.items()}  # type: ignore[arg-type]


def is_still(clip: Clip) -> bool:
    """Whether neither the camera nor any mesh moves in the clip."""
    first = clip.view(0)
    views = (clip.view(frame) for frame in range(1, clip.frames))
    return all(np.array_equal(a, b) for view in views for a, b in zip(first, view, strict=True))


def signals_of(tracks: Sequence[Track]) -> list[Signal]:
    present = {track.denoiser.signal for track in tracks}
    return [signal for signal in SIGNALS if signal in present]


@torch.no_grad()
def evaluate_clip(clip: Clip, tracks: Sequence[Track], pictures: Mapping[Signal, Path]) -> None:
    """Run all denoisers over a clip frame by frame, in memory that does not grow with its length.

    Each is held to the reference of the signal that it returns; a picture of one frame is saved for each signal.
    """
    channels = sorted({name for track in tracks for name in track.denoiser.reads} | set(METRICS_CHANNELS))
    still, shown = is_still(clip), clip.frames * 3 // 4
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False):
        frame = read_frame(clip, index, channels)
        for signal in signals_of(tracks):
            halves = to_tensor(clip.reference(index, signal), has_halves=True)[0]
            ours = [track for track in tracks if track.denoiser.signal == signal]
            outputs = {track.name: track.step(frame, halves, clip.exposure, still) for track in ours}
            if index == shown:
                errors = {track.name: track.per_frame[-1] for track in ours}
                images = outputs | {"reference": halves.mean(dim=0, keepdim=True)}
                save_strip(pictures[signal], images, errors, clip.exposure)


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
            baseline = load(name, None)
            baseline.signal = "indirect"
            tracks.append(Track(name, baseline, None))
    return tracks


def evaluate(data: Path, runs: Path, profile: str, names: list[str] | None = None) -> dict[str, Any]:
    """Evaluate over the test clips; writes `RUNS/eval/results.json` and a PNG strip a clip and signal.

    Returns the results. Strips of indirect light have names that end in `-indirect`.
    """
    dataset = Dataset(data)
    clips = dataset.clips("test")
    denoisers = ready_denoisers(names, runs, profile)
    folder = runs / "eval"
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for clip in clips:
        tracks, label = tracks_of(denoisers), f"{clip.scene}-{clip.name}"
        evaluate_clip(clip, tracks, {"total": folder / f"{label}.png", "indirect": folder / f"{label}-indirect.png"})
        rows += [
            {
                "denoiser": track.name,
                "signal": track.denoiser.signal,
                "weights": track.weights,
                "scene": clip.scene,
                "clip": clip.name,
                "frames": clip.frames,
                "metrics": track.means(),
                "nonfinite": track.nonfinite,
            }
            for track in tracks
        ]
    results = {
        "schema": 1,
        "dataset": str(data),
        "device": f"cpu, {torch.get_num_threads()} threads",
        "versions": {package: version(package) for package in ("onespp", "torch", "torchmetrics")},
        "rows": rows,
    }
    write_json(folder / "results.json", results)
    print(table(results, clips))
    return results


COLUMNS = {
    "rmse": ("RMSE", "{:.4f}"),
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.4f}"),
    "flip": ("FLIP", "{:.4f}"),
    "mse_unbiased": ("unbiased MSE", "{:.2e}"),
    "temporal_error": ("temporal error", "{:.4f}"),
    "disocclusion_l1": ("disocclusion L1", "{:.4f}"),
}


def noise_floor(clip: Clip, signal: Signal) -> float:
    """Mean squared error as displayed of the reference itself, of all light or of indirect light alone."""
    if signal == "total":
        return float(clip.facts["floor_mse"])
    halves = (display(clip.reference(index, signal), clip.exposure) for index in range(clip.frames))
    return float(np.mean([noise_of_halves(a, b) for a, b in halves]))


def cells(metrics: Mapping[str, float | None]) -> list[str]:
    values = [(metrics.get(key), form) for key, (_, form) in COLUMNS.items()]
    return [form.format(value) if value is not None else "-" for value, form in values]


def table(results: dict[str, Any], clips: list[Clip]) -> str:
    """Results for people: a row a clip, signal and denoiser, and the reference's own noise floor below each signal."""
    lines = []
    for clip in clips:
        label = f"{clip.scene}/{clip.name}"
        for signal in SIGNALS:
            key = clip.scene, clip.name, signal
            rows = [row for row in results["rows"] if (row["scene"], row["clip"], row["signal"]) == key]
            lines += [[label, row["denoiser"], signal, *cells(row["metrics"]), row["nonfinite"]] for row in rows]
            if rows:
                mse, temporal = noise_floor(clip, signal), rows[0]["metrics"]["temporal_error_floor"]
                floor = {"rmse": mse**0.5, "psnr": psnr(mse), "temporal_error": temporal}
                lines.append([label, "(noise floor)", signal, *cells(floor), ""])
    head = ["clip", "denoiser", "signal", *(title for title, _ in COLUMNS.values()), "non-finite"]
    return tabulate(lines, head, disable_numparse=True)
