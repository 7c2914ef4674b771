"""What a frame takes, from what `onespp bench denoisers` left."""

from pathlib import Path

from errors import BadInput
from eval.bench.denoisers import results_file
from eval.bench.sizes import Size, size_name
from files import read_json
from models.spec import DenoiserSpec


class Times:
    """Milliseconds of a frame of `size`, measured with `threads`, by default as many as the bench had last.

    `device` is "cpu" or "cuda". Raises BadInput where nothing was measured like that.
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
        # By denoiser, as the bench calls it, and precision. Rows of old files are all of the threads at the top.
        self.ms: dict[tuple[str, str], float] = {
            (row["denoiser"], row["dtype"]): row["ms_median"]
            for row in bench["rows"]
            if (row["height"], row["width"], row.get("threads", bench["threads"])) == (*size, self.threads)
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
    """What the bench has measured on the CPU at the first of its sizes; None where it has measured nothing."""
    path = results_file(runs)
    rows = read_json(path, ("rows",))["rows"] if path.exists() else []
    return Times(runs, (rows[0]["height"], rows[0]["width"])) if rows else None
