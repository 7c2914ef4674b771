"""What a frame takes, from what `onespp bench denoisers` left."""

from pathlib import Path
from typing import Any

from datasets.frame import Signal
from errors import BadInput
from eval.bench.denoisers import results_file
from eval.bench.sizes import Size, size_name
from eval.extra_denoisers import ALL_WINDOWS
from eval.spec import DenoiserSpec
from files import read_json

TIMED_AS = {ALL_WINDOWS: "wskp6", "ntd-b": "ntd"}  # the same computation: another training of a network


def timed_as(name: str, signal: Signal) -> str:
    """What the bench calls whatever computes the same as a denoiser of this name that returns `signal`."""
    return DenoiserSpec(TIMED_AS.get(name, name), signal=signal).way


def median_ms(bench: dict[str, Any], size: Size, threads: int) -> dict[tuple[str, str], float]:
    """Milliseconds by (denoiser, dtype) in the bench's results, at a size and a number of threads."""
    return {
        (row["denoiser"], row["dtype"]): row["ms_median"]
        for row in bench["rows"]
        if (row["height"], row["width"], row.get("threads", bench["threads"])) == (*size, threads)
    }


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
        self.device = bench["device"]
        self.threads = threads or bench["threads"]
        self.ms = median_ms(bench, size, self.threads)
        if not self.ms:
            raise BadInput(
                f"{path} has no times of {self.name} with {self.threads} threads: measure them with "
                f"`{self.command} --threads {self.threads}`"
            )

    def of(self, spec: DenoiserSpec, signal: Signal) -> float | None:
        """Of a spec's denoiser that returns `signal`; None where that was not measured."""
        return self.ms.get((timed_as(spec.name, signal), spec.precision))
