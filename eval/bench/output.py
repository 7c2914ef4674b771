"""Where benches leave what they have measured."""

from pathlib import Path


def bench_folder(runs: Path) -> Path:
    """RUNS/bench, made where it is not there yet."""
    folder = runs / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
