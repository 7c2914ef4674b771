"""What tests of the report and of evaluation share."""

import contextlib
import json
from collections.abc import Iterable
from pathlib import Path

import pytest
from PIL import Image

from eval.harness import evaluate
from eval.report.page import report
from provenance import device_in_words
from tests.helpers.shared import made_once
from tests.helpers.training import folder_of, fresh_weights
from train.task import WEIGHTS_FILE

TIMES = {"noisy": 1.0, "accumulated": 2.0, "eaw": 5.0, "ntd": 50.0}
INDIRECT = {"noisy (indirect)": 0.8, "accumulated (indirect)": 1.2}


def untrained(runs: Path, name: str, seed: int = 0) -> Path:
    """Fresh weights, where those of a training with budget `tiny` are kept."""
    folder_of(runs, name).mkdir(parents=True, exist_ok=True)
    return fresh_weights(name, folder_of(runs, name) / WEIGHTS_FILE, seed)


def bench_of(runs: Path, times: dict[str, float], size: tuple[int, int], threads: Iterable[int] = (1, 2)) -> None:
    """Milliseconds as `onespp bench denoisers` leaves them at a size: with two threads half of those with one."""
    rows = [
        {"denoiser": name, "dtype": dtype, "height": size[0], "width": size[1], "threads": n, "ms_median": ms / n}
        for name, ms in times.items()
        for dtype in ("float32", "bfloat16", "float16")
        for n in threads
    ]
    (runs / "bench").mkdir(parents=True)
    most = max(threads)
    results = {"schema": 1, "device": device_in_words("cpu", most), "threads": most, "rows": rows}
    (runs / "bench" / "results.json").write_text(json.dumps(results))


def without_live_page(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("eval.report.page.save_live_page", lambda *_: [])


@pytest.fixture
def no_live_page(monkeypatch) -> None:
    """Reports have none, which takes a process of its own: for tests of something else."""
    without_live_page(monkeypatch)


@pytest.fixture(scope="session")
def evaluated(tiny, shared) -> Path:
    """Results on the tiny data set, what was printed of them, the bench's times, a figure, and the report of all."""

    def make(runs: Path) -> None:
        untrained(runs, "ntd")
        with (runs / "table.txt").open("w") as printed, contextlib.redirect_stdout(printed):
            evaluate([tiny], runs, "tiny", list(TIMES))
        bench_of(runs, TIMES | INDIRECT, (720, 1280))
        (runs / "report" / "figures").mkdir(parents=True)
        Image.new("RGB", (20, 10), "red").save(runs / "report" / "figures" / "trade-flip.png")
        with pytest.MonkeyPatch.context() as patch:
            without_live_page(patch)
            report(runs)

    return made_once(shared / "evaluated", make)
