"""Without the packages of the extra `report` everything but pictures works, and messages name what to install."""

import subprocess
import sys
from pathlib import Path

import pytest

from eval.bench.synthetic_frames import synthetic_frame
from provenance import ROOT
from tests.helpers import foreign

BLOCKED = """
import sys
for package in ("matplotlib", "PIL", "jinja2", "markupsafe", "tensorboard"):
    sys.modules[package] = None

from command_line import main
from errors import BadInput
"""
REMEDY = "pip install 'onespp[report]'"


def output_without_report(code: str) -> str:
    """What Python `code` prints in a process that cannot import the extra's packages."""
    run = subprocess.run([sys.executable, "-c", BLOCKED + code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_denoising_works_and_drawing_commands_name_the_extra(tmp_path):
    frames = [synthetic_frame(index, 40, 56) for index in range(2)]
    foreign.write_sequence(tmp_path / "in", frames, foreign.blender)
    call = ["denoise", str(tmp_path / "in" / "*.exr"), "--denoiser", "svgf", "--out", str(tmp_path / "out")]
    drawing = (["report"], ["show", "clip"], ["preview"], ["denoise", "*.exr", "--png", "--out", str(tmp_path / "o")])
    printed = output_without_report(f"""
import contextlib, io, onespp
onespp.load("svgf")
main({call})
for command in {drawing}:
    with contextlib.redirect_stderr(io.StringIO()) as complaint, contextlib.suppress(SystemExit):
        main(command)
    print(complaint.getvalue())
""")
    assert "2 of them new" in printed and printed.count(REMEDY) == len(drawing)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == {".exr", ".json"}
    assert not (tmp_path / "o").exists()


@pytest.mark.slow
def test_training_and_evaluation(tiny: Path, tmp_path: Path):
    words = ("wskp6", str(tiny), str(tmp_path), repr({"epochs": 1, "crops": (1, 1)}))
    judging = ["eval", "noisy", "--data", str(tiny), "--runs", str(tmp_path)]
    printed = output_without_report(f"from tests.helpers.training import main as train; train{words}; main({judging})")
    assert printed.count(REMEDY) == 2 and "no loss.png" in printed and "no pictures" in printed
    assert "RMSE" in printed and (tmp_path / "eval" / "results.json").exists()
    files = {path.name for path in (tmp_path / "train" / "wskp6-tiny").iterdir()}
    assert {"weights.safetensors", "metrics.csv"} <= files
    assert not [path for ending in ("png", "webp", "tfevents*") for path in tmp_path.rglob(f"*{ending}")]
