"""What is seen of a training: metrics.csv, TensorBoard, sample pictures and the curve of the loss."""

import csv
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import matplotlib.image
import numpy as np
import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from datasets.clip import Clip
from datasets.frame import read_frame, to_tensor
from datasets.tonemap import display
from files import replacing
from models.denoiser import Denoiser, State
from models.operators import finite
from plotting import DPI, plt, save_figure

METRICS, CURVE, SAMPLE = "metrics.csv", "loss.png", "sample.png"
ROWS = 2000  # of metrics.csv at most, whatever the number of steps
SAMPLE_FRAME = 7  # of a clip, or its last one: enough of them to have settled
AMPLIFIED = 4  # differences in sample pictures

Row = dict[str, float]


def read_metrics(path: Path) -> list[Row]:
    """The rows of a metrics.csv; what was not measured in a row is missing there."""
    whole = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]  # a kill may cut one
    return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(whole)]


class Log:
    """Means of what `step` is given, a row of metrics.csv and points in TensorBoard for every so many steps.

    A resumed training overwrites what the interrupted one had noted after its last checkpoint.
    """

    def __init__(self, folder: Path, done: int, total: int):
        self.path, self.every = folder / METRICS, max(1, total // ROWS)
        self.board = SummaryWriter(str(folder), purge_step=done)
        self.pending: list[Row] = []
        self.forget_after(done)

    def forget_after(self, done: int) -> None:
        """Keep the rows of metrics.csv up to step `done`."""
        rows = [row for row in read_metrics(self.path) if row["step"] <= done] if self.path.exists() else []
        if not rows:
            self.path.unlink(missing_ok=True)
            return
        with replacing(self.path) as temporary, temporary.open("w", newline="") as file:
            writer = self.writer(file, rows[0])
            writer.writeheader()
            writer.writerows({**row, "step": int(row["step"])} for row in rows)

    @staticmethod
    def writer(file: TextIO, row: Row) -> "csv.DictWriter[str]":
        return csv.DictWriter(file, [*(name for name in row if name != "val_loss"), "val_loss"], lineterminator="\n")

    def step(self, row: Row) -> None:
        self.pending.append(row)

    def write(self, step: int, extra: Mapping[str, float] | None = None) -> None:
        """Note the mean of the steps since the last time, if that is long enough ago or there is `extra` to note."""
        if not self.pending or (len(self.pending) < self.every and extra is None):
            return
        means = {name: float(np.mean([row[name] for row in self.pending])) for name in self.pending[0]}
        row = {"step": step, **means, **(extra or {})}
        self.pending = []
        new = not self.path.exists()
        with self.path.open("a", newline="") as file:
            writer = self.writer(file, row)
            if new:
                writer.writeheader()
            writer.writerow(row)
        for name, value in row.items():
            self.board.add_scalar(name, value, step)

    def picture(self, step: int, image: Tensor) -> None:
        """Show a picture (3, H, W) in [0, 1]: in TensorBoard, and the newest as sample.png."""
        self.board.add_image("noisy, output, reference, difference", image, step)
        with replacing(self.path.with_name(SAMPLE)) as temporary:
            matplotlib.image.imsave(temporary, image.permute(1, 2, 0).numpy(), format="png")


@contextmanager
def logging(folder: Path, done: int, total: int) -> Iterator[Log]:
    """A log that is complete at the end, however that comes."""
    log = Log(folder, done, total)
    try:
        yield log
    finally:
        log.board.close()


@torch.no_grad()
def sample_picture(denoiser: Denoiser, clip: Clip, device: Any) -> Tensor:
    """Noisy, output, reference and amplified difference side by side as displayed, (3, H, 4 W), of one frame.

    The network runs over the frames before it as it does in use.
    """
    state: State | None = None
    last = min(SAMPLE_FRAME, clip.frames - 1)
    for index in range(last + 1):
        frame = read_frame(clip, index, denoiser.reads)
        output, state = denoiser(frame.to(device), state)
    reference = to_tensor(clip.reference(last, denoiser.signal), has_halves=True)[0].mean(dim=0, keepdim=True)
    images = (frame.radiance(denoiser.signal), finite(output).float().cpu(), reference)
    noisy, shown, truth = (display(image, clip.exposure)[0] for image in images)
    return torch.cat([noisy, shown, truth, (AMPLIFIED * (shown - truth).abs()).clamp(max=1)], dim=-1)


def loss_curve(folder: Path, title: str) -> None:
    """Draw loss.png from metrics.csv: loss of training and its parts, and validation."""
    rows = read_metrics(folder / METRICS)
    figure, axis = plt.subplots(figsize=(7, 4.5), dpi=DPI, layout="constrained")
    other = {"step", "learning_rate", "step_ms", "loading_ms", "skipped", "val_loss"}
    for name in [name for name in rows[0] if name not in other]:
        points = smooth(np.array([(row["step"], row[name]) for row in rows if name in row]))
        axis.plot(*points.T, lw=1.8 if name == "loss" else 0.9, label=name)
    validation = np.array([(row["step"], row["val_loss"]) for row in rows if "val_loss" in row])
    axis.plot(*validation.T, "o-", color="black", ms=4, lw=0.8, label="loss on validation clips")
    axis.set(xlabel="step", ylabel="loss", title=title, yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    save_figure(folder / CURVE, figure)


def smooth(points: np.ndarray, width: int = 50) -> np.ndarray:
    """(N, 2) to at most `width` * 4 means of neighbours: single steps are too noisy to read."""
    size = max(1, len(points) // (width * 4))
    whole = points[: len(points) // size * size]
    return np.asarray(whole.reshape(-1, size, 2).mean(axis=1))
