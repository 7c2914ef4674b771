"""The command line: help, and bad input answered by one line and exit code 2, with nothing half-written."""

import shutil

import pytest

from onespp import COMMANDS, main


def fails(capsys, *arguments: str) -> str:
    """The one line on standard error of a call that must exit with 2."""
    with pytest.raises(SystemExit) as exit_:
        main(list(arguments))
    assert exit_.value.code == 2
    err = capsys.readouterr().err
    lines = [line for line in err.splitlines() if line.startswith("onespp: ")]
    assert len(lines) == 1 and err.endswith(lines[0] + "\n") and "Traceback" not in err
    return lines[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_help(capsys, command):
    with pytest.raises(SystemExit) as exit_:
        main([command, "--help"])
    assert exit_.value.code == 0
    assert "usage: onespp" in capsys.readouterr().out


def test_unknown_names(capsys, tiny, tmp_path):
    there = ["--data", str(tiny), "--runs", str(tmp_path / "runs")]
    assert "unknown profile 'fast'" in fails(capsys, "dataset", "--profile", "fast", "--data", str(tmp_path / "d"))
    assert "unknown budget 'fast'" in fails(capsys, "train", "--profile", "fast", *there)
    assert "'oidn' is not a network" in fails(capsys, "train", "oidn", "--profile", "tiny", *there)
    assert "unknown denoiser 'magic'" in fails(capsys, "eval", "magic", "--profile", "tiny", *there)
    assert list(tmp_path.iterdir()) == []


def test_missing_or_damaged_data(capsys, tiny, tmp_path):
    nowhere = str(tmp_path / "nowhere")
    for command in (["verify"], ["info"], ["train", "--data"], ["eval", "--data"]):
        assert "there is no data set" in fails(capsys, *command, nowhere)
    copy = shutil.copytree(tiny, tmp_path / "copy")
    (copy / "test" / "cornell_box" / "000" / "direct.npy").write_bytes(b"\x93NUMPY")
    message = fails(capsys, "eval", "noisy", "--data", str(copy), "--runs", str(tmp_path / "runs"))
    assert "direct.npy is damaged" in message and "onespp dataset" in message
    assert not (tmp_path / "runs" / "eval" / "results.json").exists()
    assert "1 problems" in fails(capsys, "verify", str(copy))


def test_unwritable_folder(capsys, tiny, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    assert str(file) in fails(capsys, "dataset", "--profile", "tiny", "--data", str(file / "below"))
    assert str(file) in fails(capsys, "eval", "noisy", "--data", str(tiny), "--runs", str(file))


def test_verify_and_info_of_good_data(capsys, tiny):
    main(["verify", str(tiny)])
    main(["info", str(tiny)])
    out = capsys.readouterr().out
    assert "everything is as it was written" in out and "floor dB" in out
