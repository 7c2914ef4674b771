"""The log of a training: metrics.csv, TensorBoard and the newest sample picture."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np
from torch import Tensor

from extras import can_draw
from files import replacing

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

METRICS_CSV = "metrics.csv"
SAMPLE_FILE = "sample.png"
MAX_ROWS = 2000  # of metrics.csv, whatever the number of steps

LogRow = dict[str, float]


def read_metrics(path: Path) -> list[LogRow]:
    """The rows of a metrics.csv; what was not measured in a row is missing there."""
    lines = [line for line in path.read_text().splitlines(keepends=True) if line.endswith("\n")]  # a kill may cut one
    return [{key: float(value) for key, value in row.items() if value} for row in csv.DictReader(lines)]


def open_board(folder: Path, done: int) -> "SummaryWriter | None":
    """TensorBoard's log from step `done` on; None where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        return None
    return SummaryWriter(str(folder), purge_step=done)


class Log:
    """Means over every so many steps, as rows of metrics.csv and points in TensorBoard.

    A resumed training overwrites what the interrupted one logged after its last checkpoint.
    """

    def __init__(self, folder: Path, done: int, total: int):
        self.path = folder / METRICS_CSV
        self.every = max(1, total // MAX_ROWS)
        self.board = open_board(folder, done)
        self.pending: list[LogRow] = []
        self.truncate(done)

    def truncate(self, done: int) -> None:
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
    def writer(file: TextIO, row: LogRow) -> "csv.DictWriter[str]":
        return csv.DictWriter(file, [*(name for name in row if name != "val_loss"), "val_loss"], lineterminator="\n")

    def step(self, row: LogRow) -> None:
        self.pending.append(row)

    def write(self, step: int, extra: Mapping[str, float] | None = None) -> None:
        """Log the mean of the steps since the last row, if those are enough or there is something `extra` to log."""
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
        if self.board:
            for name, value in row.items():
                self.board.add_scalar(name, value, step)

    def picture(self, step: int, image: Tensor) -> None:
        """Show a picture (3, H, W) in [0, 1]: in TensorBoard, and the newest as sample.png."""
        if self.board:
            self.board.add_image("noisy, output, reference, difference", image, step)
        if can_draw():
            from plotting import plt

            with replacing(self.path.with_name(SAMPLE_FILE)) as temporary:
                plt.imsave(temporary, image.permute(1, 2, 0).numpy(), format="png")

    def close(self) -> None:
        """Flush TensorBoard's log."""
        if self.board:
            self.board.close()
