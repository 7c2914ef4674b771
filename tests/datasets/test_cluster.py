"""Rendering on a Ray cluster of this machine: equal bytes, whoever dies."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_dataset import ONESPP, digest

from datasets.cluster import render_on_cluster
from datasets.generate import ClipJob, Outcome, generate
from errors import BadInput
from models.registry import channels_read


def holder(lock: Path) -> int | None:
    """The process that has a file open."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(link) == str(lock):
                return int(link.parts[2])
        except OSError:  # the process has ended, or is not ours
            continue
    return None


def kill_a_renderer(root: Path, seconds: float) -> Path:
    """Kill the first process that is found in the middle of a clip. Returns the clip."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for raw in root.glob("*/*/.*.tmp/direct.raw"):
            clip = raw.parent.with_name(raw.parent.name[1:-4])
            worker = holder(clip.with_name(f".{clip.name}.lock"))
            if worker:
                os.kill(worker, signal.SIGKILL)
                return clip
        time.sleep(0.01)
    raise AssertionError("no clip was being rendered")


@pytest.mark.skipif(not Path("/proc").exists(), reason="finds the worker through /proc")
def test_a_killed_worker_costs_nothing_but_time(tiny, tmp_path):
    root = tmp_path / "data"
    command = [*ONESPP, "dataset", "--ray", "--data", str(root), "--profile", "tiny"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as job:
        victim = kill_a_renderer(root, 60)
        out, err = job.communicate(timeout=120)
    assert job.returncode == 0, err
    assert "6 clips rendered" in out and "failed" not in err
    assert (victim / "clip.json").exists()
    assert digest(root) == digest(tiny)
    assert not [path for path in root.rglob(".*") if path.name != ".dataset.json"]


def test_a_failing_clip_does_not_stop_the_others_but_a_full_disk_does(tiny, tmp_path):
    """A negative seed fails in the renderer; a file where a folder should be stands in for trouble with the disk."""
    root, jobs = tmp_path / "data", list[ClipJob]()
    generate(root, "tiny", 0, reads=channels_read(), render=lambda planned: iter(jobs.extend(planned) or ()))
    good = jobs[0]
    bad = good._replace(path=root / "val" / "cornell_box" / "000", seed=-1)
    ended = {outcome.path: outcome for outcome in render_on_cluster([bad, good])}
    assert ended[good.path] == Outcome(good.path, "rendered")
    assert ended[bad.path].ending == "failed" and "non-negative" in ended[bad.path].reason
    assert digest(good.path) == digest(tiny / good.path.relative_to(root))
    (root / "file").write_text("")
    with pytest.raises(NotADirectoryError):
        list(render_on_cluster([good._replace(path=root / "file" / "cornell_box" / "000")]))


def test_ray_is_optional_and_a_wrong_address_is_a_clear_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(BadInput, match=r"no Ray cluster answers.*refused.*RAY_ADDRESS"):
        next(render_on_cluster([]))
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BadInput, match=r"pip install 'onespp\[ray\]'"):
        next(render_on_cluster([]))
