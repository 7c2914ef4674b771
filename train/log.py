"""The log of a training: metrics.csv, TensorBoard and the newest sample picture."""

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from extras import can_draw
from files import replacing

METRICS_CSV = "metrics.csv"
SAMPLE_FILE = "sample.png"
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

            with replacing(self.path.with_name(SAMPLE_FILE)) as temporary:
                plt.imsave(temporary, image.permute(1, 2, 0).numpy(), format="png")

    def close(self) -> None:
        """Flush TensorBoard's log."""
        if self.board:
            self.board.close()
