"""The evaluation harness: every denoiser over every test clip, one streaming pass a clip."""

from collections.abc import Mapping
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
from datasets.display import psnr
from datasets.files import write_json
from datasets.frame import Frame, read_frame, to_tensor
from eval.metrics import TemporalMetrics, disocclusion_l1, image_metrics
from eval.pictures import save_strip
from models import DENOISERS, create, load
from models.denoiser import Denoiser, State
from train.loop import WEIGHTS, run_folder

METRICS_CHANNELS = ("motion", "dual_motion")


@dataclass
class Track:
    """One denoiser's way through one clip."""

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


@torch.no_grad()
def evaluate_clip(clip: Clip, tracks: Mapping[str, Track], picture: Path) -> None:
    """Run all denoisers over a clip frame by frame, in memory that does not grow with its length; save a picture."""
    channels = sorted({name for track in tracks.values() for name in track.denoiser.reads} | set(METRICS_CHANNELS))
    still, shown = is_still(clip), clip.frames * 3 // 4
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False):
        frame = read_frame(clip, index, channels)
        halves = to_tensor(clip.reference(index), has_halves=True)[0]
        outputs = {name: track.step(frame, halves, clip.exposure, still) for name, track in tracks.items()}
        if index == shown:
            errors = {name: track.per_frame[-1] for name, track in tracks.items()}
            save_strip(picture, outputs | {"reference": halves.mean(dim=0, keepdim=True)}, errors, clip.exposure)


def ready_denoisers(names: list[str] | None, runs: Path, profile: str) -> dict[str, tuple[Denoiser, str | None]]:
    """Denoisers to evaluate, with the file of their weights. Without `names` all that can run.

    Raises BadInput where a named one is unknown or has no weights.
    """
    ready: dict[str, tuple[Denoiser, str | None]] = {}
    for name in names or DENOISERS:
        trained = create(name).parameter_count() > 0
        weights = run_folder(runs, name, profile) / WEIGHTS if trained else None
        if weights and not weights.exists() and not names:
            print(f"{name}: skipped, it has no weights at {weights}; train them with `onespp train {name}`")
            continue
        ready[name] = load(name, weights), str(weights) if weights else None
    return ready


def evaluate(data: Path, runs: Path, profile: str, names: list[str] | None = None) -> dict[str, Any]:
    """Evaluate over the test clips; writes `RUNS/eval/results.json` and a PNG strip a clip. Returns the results."""
    dataset = Dataset(data)
    clips = dataset.clips("test")
    denoisers = ready_denoisers(names, runs, profile)
    folder = runs / "eval"
    folder.mkdir(parents=True, exist_ok=True)
    rows = []
    for clip in clips:
        tracks = {name: Track(denoiser, weights) for name, (denoiser, weights) in denoisers.items()}
        evaluate_clip(clip, tracks, folder / f"{clip.scene}-{clip.name}.png")
        rows += [
            {
                "denoiser": name,
                "signal": track.denoiser.signal,
                "weights": track.weights,
                "scene": clip.scene,
                "clip": clip.name,
                "frames": clip.frames,
                "metrics": track.means(),
                "nonfinite": track.nonfinite,
            }
            for name, track in tracks.items()
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


def table(results: dict[str, Any], clips: list[Clip]) -> str:
    """Results for people: a row a clip and denoiser, and the reference's own noise floor below each clip."""
    lines = []
    for clip in clips:
        rows = [row for row in results["rows"] if (row["scene"], row["clip"]) == (clip.scene, clip.name)]
        label = f"{clip.scene}/{clip.name}"
        for row in rows:
            cells = [
                form.format(row["metrics"][key]) if row["metrics"][key] is not None else "-"
                for key, (_, form) in COLUMNS.items()
            ]
            lines.append([label, row["denoiser"], *cells, row["nonfinite"]])
        floor = clip.facts["floor_mse"]
        floors = {"rmse": floor**0.5, "psnr": psnr(floor), "temporal_error": rows[0]["metrics"]["temporal_error_floor"]}
        cells = [form.format(floors[key]) if floors.get(key) is not None else "-" for key, (_, form) in COLUMNS.items()]
        lines.append([label, "(noise floor)", *cells, ""])
    head = ["clip", "denoiser", *(title for title, _ in COLUMNS.values()), "non-finite"]
    return tabulate(lines, head, disable_numparse=True)
