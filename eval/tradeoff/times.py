"""Milliseconds per frame, read from the results of `onespp bench denoisers`."""

from pathlib import Path

from errors import BadInput
from eval.bench.denoisers import results_file
from eval.bench.sizes import Size, size_name
from files import read_json
from models.spec import DenoiserSpec


class Times:
    """Milliseconds per frame of `size`, measured with `threads`, by default the most of the bench.

    `device` is "cpu" or "cuda". Raises BadInput where the bench has no such rows.
    """

    def __init__(self, runs: Path, size: Size, threads: int | None = None, device: str = "cpu"):
        path = results_file(runs, device)
        self.size = size
        self.name = size_name(size)
        self.command = f"onespp bench denoisers --size {self.name} --runs {runs}"
        if not path.exists():
            raise BadInput(f"there are no times at {path}: measure them with `{self.command}`")
        bench = read_json(path, ("device", "threads", "rows"))
        self.device: str = bench["device"]
        self.threads: int = threads or bench["threads"]
        # By the bench's name of the denoiser, and precision.
        self.ms: dict[tuple[str, str], float] = {
            (row["denoiser"], row["dtype"]): row["ms_median"]
            for row in bench["rows"]
            if (row["height"], row["width"], row["threads"]) == (*size, self.threads)
        }
        if not self.ms:
            raise BadInput(
                f"{path} has no times of {self.name} with {self.threads} threads: measure them with "
                f"`{self.command} --threads {self.threads}`"
            )

    def of(self, spec: DenoiserSpec) -> float | None:
        """Milliseconds a frame; None where that was not measured."""
        return self.ms.get((spec.way, spec.precision))


def times_of_first_size(runs: Path) -> Times | None:
    """The times on the CPU at the bench's first size; None without any."""
    path = results_file(runs)
    rows = read_json(path, ("rows",))["rows"] if path.exists() else []
    return Times(runs, (rows[0]["height"], rows[0]["width"])) if rows else None
