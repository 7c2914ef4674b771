"""Rendering on a Ray cluster of this machine: equal bytes, whoever dies."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from errors import BadInput
from render.job.clip_job import ClipOutcome, RenderJob
from render.job.cluster import connected_ray, outcomes_of, render_on_cluster
from tests.helpers.datasets import clip_in_progress, dataset_command, digest, generate_tiny


def holder(lock: Path) -> int | None:
    """The process that has a file open."""
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(link) == str(lock):
                return int(link.parts[2])
        except OSError:  # the process has ended, or is not ours
            continue
    return None


def kill_a_renderer(root: Path) -> Path:
    """Kill the first process that is found amid a clip. Returns the clip's folder."""
    while True:
        clip = clip_in_progress(root)
        worker = holder(clip.with_name(f".{clip.name}.lock"))
        if worker:
            os.kill(worker, signal.SIGKILL)
            return clip


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").exists(), reason="finds the worker through /proc")
def test_a_killed_worker_costs_nothing_but_time(tiny, tiny_copy):
    for clip in ("val/cornell_box/000", "test/cornell_box_moving/000"):
        shutil.rmtree(tiny_copy / clip)
    command = [*dataset_command(tiny_copy), "--ray"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as job:
        victim = kill_a_renderer(tiny_copy)
        out, err = job.communicate(timeout=120)
    assert job.returncode == 0, err
    assert "2 clips rendered" in out and "failed" not in err
    assert (victim / "clip.json").exists()
    assert digest(tiny_copy) == digest(tiny)
    assert not [path for path in tiny_copy.rglob(".*") if path.name != ".dataset.json"]


@pytest.mark.slow  # test_generate.py has both without a cluster
def test_a_failing_clip_does_not_stop_the_others_but_a_full_disk_does(tiny, tmp_path):
    """A negative seed fails in the renderer; a file where a folder should be stands in for trouble with the disk."""
    root = tmp_path / "data"
    jobs: list[RenderJob] = []
    generate_tiny(root, render=lambda planned: iter(jobs.extend(planned) or ()))
    good = jobs[0]
    bad = good._replace(path=root / "val" / "cornell_box" / "000", seed=-1)
    (root / "file").write_text("")
    with connected_ray() as ray:
        ended = {outcome.path: outcome for outcome in outcomes_of(ray, [bad, good])}
        with pytest.raises(NotADirectoryError):
            list(outcomes_of(ray, [good._replace(path=root / "file" / "cornell_box" / "000")]))
    assert ended[good.path] == ClipOutcome(good.path, "rendered")
    assert ended[bad.path].ending == "failed" and "non-negative" in ended[bad.path].reason
    assert digest(good.path) == digest(tiny / good.path.relative_to(root))


def test_ray_is_optional_and_a_wrong_address_is_a_clear_error(monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(BadInput, match=r"no Ray cluster answers.*refused.*RAY_ADDRESS"):
        next(render_on_cluster([]))
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BadInput, match=r"pip install 'onespp\[ray\]'"):
        next(render_on_cluster([]))
