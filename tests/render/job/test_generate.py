"""The rendering job: equal bytes however it is interrupted or shared, and clear errors."""

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import render.clip
import render.job.generate
import render.job.plan
from datasets.clip import Dataset, is_clip
from datasets.info import summarise
from errors import BadInput
from files import locked
from render.job.generate import generate, share_of
from render.kept import kept_references
from render.path import PathTracer
from tests.helpers.datasets import clip_in_progress, dataset_command, digest, generate_tiny
from tests.helpers.training import full_disk


def remove_clips(root: Path, *clips: str) -> list[Path]:
    """Delete clips, SPLIT/SCENE/CLIP, from a dataset. Returns their folders."""
    folders = [root / clip for clip in clips]
    for folder in folders:
        shutil.rmtree(folder)
    return folders


def test_rerun_renders_only_what_is_missing_and_ends_with_equal_bytes(tiny, tiny_copy):
    """The fixture was rendered clip after clip, and this one is rendered alone."""
    [missing] = remove_clips(tiny_copy, "train/cornell_box_moving/000")
    (missing.parent / ".000.tmp").mkdir()
    (missing.parent / ".000.tmp" / "direct.raw").write_bytes(b"left by a killed job")
    untouched = (tiny_copy / "test" / "cornell_box" / "000" / "direct.npy").stat().st_mtime_ns
    assert generate_tiny(tiny_copy) == 1
    assert digest(tiny_copy) == digest(tiny)
    assert (tiny_copy / "test" / "cornell_box" / "000" / "direct.npy").stat().st_mtime_ns == untouched
    assert generate_tiny(tiny_copy) == 0


def test_an_interrupted_clip_keeps_the_references_that_are_finished(tiny, tiny_copy, monkeypatch):
    [clip] = remove_clips(tiny_copy, "test/cornell_box/000")
    radiance = PathTracer.radiance
    rendered, limit = [], [5]  # buffers of references

    def limited(self, ray, seed, spp, *others):
        if spp == 64 and len(rendered) == limit[0]:
            raise KeyboardInterrupt
        rendered.extend([seed] if spp == 64 else [])
        return radiance(self, ray, seed, spp, *others)

    monkeypatch.setattr(PathTracer, "radiance", limited)
    with pytest.raises(KeyboardInterrupt):
        generate_tiny(tiny_copy)
    references = clip.with_name(".000.references")
    assert sorted(path.name for path in references.iterdir()) == ["0.npy", "1.npy"]
    (references / "1.npy").write_bytes(b"damaged")
    limit[0] = 100
    generate_tiny(tiny_copy)
    assert len(rendered) == 5 + 2 * 7  # all but frame 0
    assert digest(tiny_copy) == digest(tiny)
    assert not references.exists()


def test_references_outlive_a_full_disk_but_no_failure(tmp_path):
    for error, kept in ((OSError(errno.ENOSPC, "No space left on device"), True), (RuntimeError("a kernel"), False)):
        with pytest.raises(type(error)), kept_references(tmp_path / "000") as folder:
            raise error
        assert folder.exists() == kept


def all_are_whole(root: Path) -> bool:
    """Whether every clip that stands at its place is complete."""
    return all(json.loads((clip / "clip.json").read_text())["complete"] for clip in root.glob("*/*/[0-9]*"))


def resume(root: Path) -> str:
    """Let another process finish the dataset. Returns what it prints."""
    return subprocess.run(dataset_command(root), check=True, capture_output=True, text=True).stdout


@pytest.mark.slow
def test_a_job_killed_amid_a_clip_resumes_to_equal_bytes(tiny, tiny_copy):
    remove_clips(tiny_copy, "val/cornell_box_moving/000", "test/cornell_box/000")
    with subprocess.Popen(dataset_command(tiny_copy), stderr=subprocess.DEVNULL) as job:
        clip_in_progress(tiny_copy)
        job.kill()
    assert job.returncode == -signal.SIGKILL
    assert all_are_whole(tiny_copy)
    assert re.search("[12] clips rendered", resume(tiny_copy))
    assert digest(tiny_copy) == digest(tiny)


@pytest.mark.slow
def test_killed_fifty_times(tiny, tmp_path):
    """At random moments, from an empty folder on."""
    rng = np.random.default_rng(1)
    hits = 0
    for attempt in range(10):
        root = tmp_path / str(attempt)
        for _ in range(5):
            job = subprocess.Popen(dataset_command(root), stderr=subprocess.DEVNULL)
            time.sleep(rng.uniform(0.7, 2.7))
            hits += job.poll() is None
            job.kill()
            job.wait()
            assert all_are_whole(root)
        resume(root)
        assert digest(root) == digest(tiny)
    assert hits > 10


@pytest.mark.slow
def test_full_disk_is_one_clear_line_and_leaves_whole_clips_only(tmp_path):
    root = tmp_path / "data"
    environment = os.environ | {"DRJIT_CACHE_DIR": str(tmp_path / "kernels")}
    (tmp_path / "kernels").mkdir()
    with full_disk(100_000):
        run = subprocess.run(dataset_command(root), capture_output=True, text=True, env=environment)
    assert run.returncode == 2, run.stderr
    assert "run it again" in run.stderr.splitlines()[-1] and "Traceback" not in run.stderr
    assert [path for path in root.rglob("*") if path.is_file() and path.name != "dataset.json"] == []


@pytest.mark.slow
def test_a_clip_that_another_job_renders_is_left_to_it(tiny_copy, tiny):
    theirs, ours = remove_clips(tiny_copy, "val/cornell_box/000", "train/cornell_box/000")
    with locked(theirs.with_name(".000.lock")) as claim:
        assert claim
        assert generate_tiny(tiny_copy) == 1
        assert ours.exists() and not theirs.exists()
    assert generate_tiny(tiny_copy) == 1
    assert digest(tiny_copy) == digest(tiny)


@pytest.mark.slow
def test_two_processes_on_one_folder_share_the_work(tiny, tiny_copy):
    remove_clips(tiny_copy, "train/cornell_box/000", "train/cornell_box_moving/000", "val/cornell_box/000")
    command = dataset_command(tiny_copy)
    jobs = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [job.communicate(timeout=120) for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], outputs
    assert sum(int(re.search(r"(\d+) clips rendered", out)[1]) for out, _ in outputs) == 3
    assert digest(tiny_copy) == digest(tiny)


@pytest.fixture
def copied(tiny, monkeypatch):
    """Clips are not rendered: those of the dataset `tiny` take their place, in the same folder."""

    def copy(folder: Path, *_: object) -> None:
        shutil.copytree(tiny.joinpath(*folder.parts[-3:]), folder)

    monkeypatch.setattr(render.job.generate, "render_to_folder", copy)


@pytest.mark.usefixtures("copied")
@pytest.mark.parametrize("count", [4, 8])
def test_shares_are_disjoint_and_their_union_is_the_whole(count, tiny, tmp_path):
    roots = [tmp_path / str(index) for index in range(1, count + 1)]
    counts = [generate_tiny(root, part=f"{index}/{count}") for index, root in enumerate(roots, 1)]
    assert sum(counts) == 6 and max(counts) - min(counts) <= 1
    merged = tmp_path / "merged"
    for root in roots:
        shutil.copytree(root, merged, dirs_exist_ok=True)
    assert generate_tiny(merged) == 0  # which adds the card
    assert digest(merged) == digest(tiny)


@pytest.mark.parametrize("text", ["0/4", "5/4", "1/0", "x", "1", "-1/2"])
def test_invalid_shares_are_refused(text):
    with pytest.raises(BadInput, match="K/N"):
        share_of([], text)


def test_a_clip_that_fails_does_not_stop_the_others(tiny_copy, monkeypatch):
    failing, other = remove_clips(tiny_copy, "val/cornell_box/000", "val/cornell_box_moving/000")
    genuine = render.job.plan.build_scene

    def broken(name, *arguments):
        if name == "cornell_box":
            raise RuntimeError("no such texture")
        return genuine(name, *arguments)

    monkeypatch.setattr(render.job.plan, "build_scene", broken)
    with pytest.raises(BadInput, match=r"1 of 2 clips failed.*val/cornell_box/000: no such texture"):
        generate_tiny(tiny_copy)
    assert is_clip(other)
    assert not list(failing.parent.glob("*"))


def test_non_finite_samples_are_counted_and_reported(tiny_copy, monkeypatch):
    remove_clips(tiny_copy, "val/cornell_box/000")
    genuine = render.clip.render_clip

    def faulty(scene, *arguments):
        for index, (channels, seconds) in enumerate(genuine(scene, *arguments)):
            if index == 3:
                channels["direct"][0, 5, 5:7] = np.nan
                channels["indirect_reference"][1, 0, 0, 2] = np.inf
            yield channels, seconds

    monkeypatch.setattr(render.clip, "render_clip", faulty)
    assert generate_tiny(tiny_copy) == 1
    box, moving = Dataset(tiny_copy).clips("val")
    assert {name: n for name, n in box.facts["nonfinite"].items() if n} == {"direct": 6, "indirect_reference": 1}
    assert not any(moving.facts["nonfinite"].values())
    assert (box.read("direct", 3)[5, 5:7] == 0).all()
    head, *rows = (
        re.split(r"\s{2,}", line) for line in summarise(tiny_copy).splitlines() if re.match(r"clip |\w+/cornell", line)
    )
    bad = {row[0]: row[head.index("bad values")].strip() for row in rows}
    assert bad.pop("val/cornell_box/000") == "7" and set(bad.values()) == {"0"}


@pytest.mark.usefixtures("copied")
def test_incomplete_files_are_replaced(tiny, tmp_path, monkeypatch):
    root = tmp_path / "data"
    root.mkdir()
    (root / ".dataset.json.tmp").write_text("{")  # killed before the first file was in place
    assert generate_tiny(root, part="1/6") == 1
    [clip] = root.glob("*/*/*")
    (clip / "clip.json").unlink()
    monkeypatch.undo()
    assert generate_tiny(root, part="1/6") == 1
    assert is_clip(clip) and (root / "dataset.json").exists() and digest(root).items() < digest(tiny).items()


def test_a_data_set_is_not_continued_with_other_versions(tiny_copy):
    facts = json.loads((tiny_copy / "dataset.json").read_text())
    facts["versions"] |= {"mitsuba": "3.0.0", "blender": "4.2"}
    (tiny_copy / "dataset.json").write_text(json.dumps(facts))
    assert generate_tiny(tiny_copy) == 0  # nothing to render
    remove_clips(tiny_copy, "val/cornell_box/000")
    with pytest.raises(BadInput, match=r"begun with mitsuba 3.0.0, here 3.*; blender 4.2, here none"):
        generate_tiny(tiny_copy)


def test_other_folders_are_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(BadInput, match="something other"):
        generate_tiny(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="is a file"):
        generate_tiny(tmp_path / "file")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "thesis.tex"]


def test_other_seed_or_profile_needs_another_folder(tiny):
    with pytest.raises(BadInput, match="another seed"):
        generate(tiny, "tiny", 1)
    with pytest.raises(BadInput, match="another profile"):
        generate(tiny, "quick", 0)
    with pytest.raises(BadInput, match="negative"):
        generate(tiny, "tiny", -1)
