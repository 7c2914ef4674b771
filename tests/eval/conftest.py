"""What tests of the report share."""

import json
from pathlib import Path

import pytest
import torch
from PIL import Image

from eval.harness import evaluate
from eval.report.page import report
from models.registry import create
from models.weights import save_weights
from train.task import run_folder

TIMES = {"noisy": 1.0, "accumulated": 2.0, "eaw": 5.0, "ntd": 50.0}
INDIRECT = {"noisy (indirect)": 0.8, "accumulated (indirect)": 1.2}


@pytest.fixture(scope="session")
def evaluated(tiny, tmp_path_factory) -> Path:
    """Results on the tiny data set, the bench's times, a figure, and the report of them."""
    runs = tmp_path_factory.mktemp("evaluated")
    torch.manual_seed(0)
    folder = run_folder(runs, "ntd", "tiny")
    folder.mkdir(parents=True)
    save_weights(create("ntd"), "ntd", {}, folder / "weights.safetensors")
    evaluate([tiny], runs, "tiny", list(TIMES))
    rows = [
        {"denoiser": name, "height": 720, "width": 1280, "dtype": dtype, "threads": threads, "ms_median": ms / threads}
        for name, ms in (TIMES | INDIRECT).items()
        for dtype in ("float32", "bfloat16")
        for threads in (1, 2)
        if name != "eaw" or dtype == "float32"
    ]
    (runs / "bench").mkdir()
    (runs / "bench" / "results.json").write_text(json.dumps({"device": "cpu", "threads": 2, "rows": rows}))
    (runs / "report" / "figures").mkdir(parents=True)
    Image.new("RGB", (20, 10), "red").save(runs / "report" / "figures" / "trade-flip.png")
    report(runs)
    return runs
