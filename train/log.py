"""The log of a training: metrics.csv and its curve, TensorBoard, and a frame as the network denoises it."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.clip import Clip
from datasets.frame import read_frame, to_tensor
from datasets.tonemap import display
from errors import can_draw
from files import replacing
from models.denoiser import Denoiser, State
from models.operators import finite

METRICS_CSV = "metrics.csv"
SAMPLE_FRAME = 7  # of a clip, or its last one: late enough for the state to have settled
AMPLIFIED = 4  # differences in sample pictures
MAX_ROWS = 2000  # of metrics.csv, whatever the number of steps

LogRow = dict[str, float]


def read_metrics(path: Path) -> list[LogRow]:
    """The rows of a metrics.csv; what was not measured in a row is missing there."""
    lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]  # a kill may cut one
    return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(lines)]


class Log:
    """Means over every so many steps, as rows of metrics.csv and points in TensorBoard.

    A resumed training overwrites what the interrupted one logged after its last checkpoint.
    """

    def __init__(self, folder: Path, done: int, total: int):
        self.path = folder / METRICS_CSV
        self.every = max(1, total // MAX_ROWS)
        try:
            from torch.utils.tensorboard import SummaryWriter

            self.board: SummaryWriter | None = SummaryWriter(str(folder), purge_step=done)
        except ModuleNotFoundError:  # TensorBoard is not installed
            self.board = None
        self.pending: list[LogRow] = []
        rows = [row for row in read_metrics(self.path) if row["step"] <= done] if self.path.exists() else []
        with replacing(self.path) as temporary:
            self.append(temporary, [{**row, "step": int(row["step"])} for row in rows])

    @staticmethod
    def append(path: Path, rows: Sequence[LogRow]) -> None:
        """Append rows to a CSV file, which begins with the names in them."""
        with path.open("a", newline="") as file:
            for row in rows:
                names = [*(name for name in row if name != "val_loss"), "val_loss"]
                writer = csv.DictWriter(file, names, lineterminator="\n")
                if not file.tell():
                    writer.writeheader()
                writer.writerow(row)

    def add(self, step: int, row: LogRow, val_loss: float | None = None) -> None:
        """Log the mean of the steps since the last row, if those are enough or there is a loss on validation clips."""
        self.pending.append(row)
        if len(self.pending) < self.every and val_loss is None:
            return
        means = {name: float(np.mean([row[name] for row in self.pending])) for name in self.pending[0]}
        row = {"step": step, **means, **({} if val_loss is None else {"val_loss": val_loss})}
        self.pending = []
        self.append(self.path, [row])
        if self.board:
            for name, value in row.items():
                self.board.add_scalar(name, value, step)

    def picture(self, step: int, image: Tensor) -> None:
        """Show a picture (3, H, W) in [0, 1]: in TensorBoard, and the newest as sample.png."""
        if self.board:
            self.board.add_image("noisy, output, reference, difference", image, step)
        if can_draw():
            from plotting import plt

            with replacing(self.path.with_name("sample.png")) as temporary:
                plt.imsave(temporary, image.permute(1, 2, 0).numpy(), format="png")

    def close(self) -> None:
        if self.board:
            self.board.close()


@torch.no_grad()
def sample_picture(denoiser: Denoiser, clip: Clip, device: torch.device) -> Tensor:
    """Noisy, output, reference and amplified difference as displayed, (3, H, 4 W), of a frame with history."""
    state: State | None = None
    last = min(SAMPLE_FRAME, clip.frames - 1)
    for index in range(last + 1):
        frame = read_frame(clip, index, denoiser.reads, in_layers=False)
        output, state = denoiser(frame.to(device), state)
    reference = to_tensor(clip.reference(last, denoiser.signal), has_buffers=True)[0].mean(dim=0, keepdim=True)
    images = (frame.radiance(denoiser.signal), finite(output).float().cpu(), reference)
    noisy, shown, truth = (display(image, clip.exposure)[0] for image in images)
    return torch.cat([noisy, shown, truth, (AMPLIFIED * (shown - truth).abs()).clamp(max=1)], dim=-1)


def loss_curve(folder: Path, title: str) -> None:
    """Draw loss.png from metrics.csv: the training loss and its parts, and the loss over the validation clips."""
    from plotting import DPI, plt, save_figure

    rows = read_metrics(folder / METRICS_CSV)
    figure, axis = plt.subplots(figsize=(7, 4.5), dpi=DPI, layout="constrained")
    other = {"step", "learning_rate", "gradient_norm", "step_ms", "loading_ms", "skipped", "val_loss"}
    for name in [name for name in rows[0] if name not in other]:
        points = smooth(np.array([(row["step"], row[name]) for row in rows if name in row]))
        axis.plot(*points.T, lw=1.8 if name == "loss" else 0.9, label=name)
    validation = np.array([(row["step"], row["val_loss"]) for row in rows if "val_loss" in row])
    axis.plot(*validation.T, "o-", color="black", ms=4, lw=0.8, label="loss on validation clips")
    axis.set(xlabel="step", ylabel="loss", title=title, yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    save_figure(folder / "loss.png", figure)


def smooth(points: NDArray[np.float64], width: int = 50) -> NDArray[np.float64]:
    """Points (N, 2) as means of neighbours, fewer than 8 * `width` of them: single steps are too noisy to read."""
    size = max(1, len(points) // (width * 4))
    whole = points[: len(points) // size * size]
    return np.asarray(whole.reshape(-1, size, 2).mean(axis=1))
