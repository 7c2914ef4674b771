"""The command line: help, and bad input answered by one line and exit code 2, with nothing half-written."""

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from command_line import GROUPS, main
from provenance import ROOT
from render.job.profiles import DATA_PROFILES
from train.recipes import RECIPES


def fails(capsys, *arguments: str) -> str:
    """The one line on standard error of a call that must exit with 2."""
    with pytest.raises(SystemExit) as exit_:
        main(list(arguments))
    assert exit_.value.code == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("onespp: ")]
    assert len(lines) == 1 and err.endswith(lines[0] + "\n") and "Traceback" not in err
    return lines[0]


def help_of(capsys, *words: str) -> str:
    with contextlib.suppress(SystemExit):  # tyro exits, with code 0
        main([*words, "--help"])
    return capsys.readouterr().out


def commands(groups, *before: str):
    """The words of every command."""
    for group in groups.values():
        for name, command in group.items():
            yield from commands({"": command}, *before, name) if isinstance(command, dict) else [(*before, name)]


@pytest.mark.parametrize("words", list(commands(GROUPS)), ids=" ".join)
def test_every_command_has_help_under_its_own_name(capsys, words):
    shown = help_of(capsys, *words)
    assert shown.startswith(f"usage: onespp {' '.join(words)}")


def test_help_begins_with_the_pipeline(capsys):
    shown = help_of(capsys)
    places = [shown.index(f"\n  {name} ") for name in ("preview", "dataset", "train", "eval", "report")]
    assert places == sorted(places) and places[-1] < shown.index("Datasets")
    assert all(f"\n  {name} " in shown for group in GROUPS.values() for name in group)
    assert all(f"\n  {name} " in help_of(capsys, "bench") for name in ("denoisers", "light"))


def test_help_names_every_profile_and_budget(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")  # on a line each
    assert "{" + ",".join([*DATA_PROFILES, "rooms-NxS"]) + "}" in help_of(capsys, "dataset")
    assert "{" + ",".join(dict.fromkeys(budget for _, budget in RECIPES)) + "}" in help_of(capsys, "train")


def test_a_bench_refuses_unknown_options(capsys):
    with pytest.raises(SystemExit) as exit_:
        main(["bench", "light", "svgf", "--threads", "1"])
    assert exit_.value.code == 2 and "--threads" in capsys.readouterr().err


def test_unknown_commands(capsys):
    assert "unknown command 'onespp fly'" in fails(capsys, "fly")
    assert "denoisers, light" in fails(capsys, "bench", "everything")


@pytest.mark.parametrize("words", [["--help"], ["eval", "--help"]], ids=" ".join)
def test_nobody_reads_on(monkeypatch, capfd, words):
    """As behind `| true`."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as gone, monkeypatch.context() as patched:
        patched.setattr(sys, "stdout", gone)
        with pytest.raises(SystemExit) as exit_:
            main(words)
    assert exit_.value.code == 141 and capfd.readouterr().err == ""


def test_options_that_would_do_nothing(capsys, tmp_path):
    file = str(tmp_path / "file")
    assert "--where prints other tables" in fails(capsys, "eval", "--where", "--jod", "--data", file)
    assert "--out needs --average" in fails(capsys, "weights", "one", "--out", file)
    average = ("weights", "one", "--average", file, "--out", file)
    assert "leave one of them out" in fails(capsys, *average, "--card", file)


def made(folder: Path, *arguments: str) -> str:
    """The commands of a call of make."""
    if not shutil.which("make"):
        pytest.skip("needs make")
    command = ["make", "--dry-run", "-C", folder, "-f", ROOT / "Makefile", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def test_make_keeps_its_time_where_it_does_everything_but_set_up(tmp_path):
    def keeps(target: str = "all", file: str = "make.seconds") -> bool:
        return f"> runs/{file}" in made(tmp_path, target)

    (tmp_path / "pyproject.toml").touch()
    assert not keeps()  # it sets up first
    (tmp_path / ".venv").mkdir()
    (tmp_path / ".venv" / ".ready").touch()
    os.utime(tmp_path / "pyproject.toml", (0, 0))
    assert keeps()
    (tmp_path / "data" / "quick").mkdir(parents=True)
    assert not keeps()
    assert not keeps("test", "test.seconds")  # it would not follow a `make`
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "make.seconds").touch()
    assert keeps("test", "test.seconds")
    (tmp_path / "runs" / "test.seconds").touch()
    assert not keeps("test", "test.seconds")  # its kernels are compiled


@pytest.mark.parametrize("profile", DATA_PROFILES)
def test_make_trains_with_a_budget_whatever_the_profile(tmp_path, profile):
    (tmp_path / "pyproject.toml").touch()
    budget = profile if profile in {budget for _, budget in RECIPES} else "quick"
    assert f"onespp train --budget {budget} --data data/{profile} " in made(tmp_path, "train", f"PROFILE={profile}")


def test_unknown_names(capsys, tiny, tmp_path):
    there = ["--data", str(tiny), "--runs", str(tmp_path / "runs")]
    assert "unknown profile 'fast'" in fails(capsys, "dataset", "--profile", "fast", "--data", str(tmp_path / "d"))
    assert "unknown budget 'fast'" in fails(capsys, "train", "--budget", "fast", *there)
    assert "'oidn' is not a network" in fails(capsys, "train", "oidn", "--budget", "tiny", *there)
    assert "unknown denoiser 'magic'" in fails(capsys, "eval", "magic", "--budget", "tiny", *there)
    assert list(tmp_path.iterdir()) == []


def test_missing_or_damaged_data(capsys, tiny, tmp_path):
    nowhere = str(tmp_path / "nowhere")
    for command in ("verify", "info", "train", "eval"):
        assert "there is no data set" in fails(capsys, command, "--data", nowhere)
    copy = shutil.copytree(tiny, tmp_path / "copy")
    (copy / "test" / "cornell_box" / "000" / "direct.npy").write_bytes(b"\x93NUMPY")
    message = fails(capsys, "eval", "noisy", "--data", str(copy), "--runs", str(tmp_path / "runs"))
    assert "direct.npy is damaged" in message and "onespp dataset" in message
    assert not (tmp_path / "runs" / "eval" / "results.json").exists()
    assert "1 problems" in fails(capsys, "verify", "--data", str(copy))


def test_unwritable_folder(capsys, tiny, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    assert str(file) in fails(capsys, "dataset", "--profile", "tiny", "--data", str(file / "below"))
    assert str(file) in fails(capsys, "eval", "noisy", "--data", str(tiny), "--runs", str(file))
