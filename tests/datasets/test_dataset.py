"""The data set on disk: derived channels, damage, resumption, and the promise of equal bytes."""

import hashlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import datasets.generate
from datasets.clip import Clip, Dataset
from datasets.generate import Part
from datasets.inspect import check_clip, difficulty, info, verify
from datasets.profiles import DATA_PROFILES, clip_seed, plan
from datasets.writer import ClipWriter
from errors import BadInput
from files import locked
from models.registry import channels_read
from render.clip import Sampling, render_clip
from scenes.registry import build_scene

ONESPP = [sys.executable, "-m", "onespp"]
generate = partial(datasets.job.generate, reads=channels_read())  # as the command line does


def digest(root: Path) -> dict[str, str]:
    """Hashes of all files except timings."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name not in ("timing.json",) and not path.name.startswith(".")
    }


@pytest.fixture
def copy(tiny, tmp_path) -> Path:
    return Path(shutil.copytree(tiny, tmp_path / "copy"))


def test_plan_and_layout(tiny):
    facts = json.loads((tiny / "dataset.json").read_text())
    assert facts["schema"] == 1 and facts["profile"] == "tiny" and facts["seed"] == 0
    assert set(facts) == {
        "schema",
        "profile",
        "generator",
        "versions",
        "seed",
        "scenes",
        "options",
        "channels",
        "splits",
    }
    for path in Dataset(tiny).planned():
        names = {file.name for file in path.iterdir()}
        assert {"clip.json", "timing.json", "direct.npy", "depth.npy"} <= names
        assert set(Clip(path).channels) == set(facts["channels"][path.parts[-3]])
        assert not any(name.endswith(".raw") for name in names)
    assert verify(tiny) == []


def test_stored_arrays_are_what_was_rendered(tiny):
    """Render one clip again, in this process, and compare with the disk."""
    clip = Dataset(tiny).clips("test")[1]
    profile = DATA_PROFILES["tiny"]
    seed = clip_seed(0, clip.scene, "test", 0)
    scene = build_scene(clip.scene, seed, profile.frames)
    sampling = Sampling(1, 1, profile.quality["test"].reference_spp)
    frames = render_clip(scene, profile.frames, profile.height, profile.width, sampling, seed)
    for index, (channels, _) in enumerate(frames):
        for name in ("direct", "depth", "motion", "dual_motion", "normal", "mesh_id"):
            rendered = channels[name][0] if name == "direct" else channels[name]
            stored = clip.read(name, index)
            np.testing.assert_array_equal(stored, rendered.astype(stored.dtype))
        np.testing.assert_array_equal(clip.view(index).camera_to_world, channels["camera_to_world"])


def test_derived_motion_equals_rendered_motion(tiny):
    clip = Dataset(tiny).clips("test")[0]
    assert clip.scene == "cornell_box" and clip.channels["motion"] == {"derived": "camera"}
    assert clip.channels["roughness"] == {"value": [1.0]}
    visible = np.zeros(2)
    for index in range(1, clip.frames):
        # Both are the renderer's, and equal where nothing was disoccluded.
        motion, dual = clip.read("motion", index), clip.read("dual_motion", index)
        visible += [(motion == dual).all(axis=-1).mean(), np.abs(motion).max() > 0.5]
        window = (slice(10, 20), slice(5, 60))
        np.testing.assert_array_equal(clip.read("motion", index, window), motion[window])
    assert visible[0] / (clip.frames - 1) > 0.9 and visible[1] > 0
    assert (clip.read("motion", 0) == 0).all() and (clip.read("dual_motion", 0) == 0).all()


def test_absent_channel_is_a_clear_error(copy):
    path = Dataset(copy).planned(["test"])[0]
    facts = json.loads((path / "clip.json").read_text())
    del facts["channels"]["dual_motion"]
    (path / "clip.json").write_text(json.dumps(facts))
    with pytest.raises(BadInput, match=r"'dual_motion'.*not rendered"):
        Clip(path).read("dual_motion", 0)


def flip_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_verify_names_every_kind_of_damage(copy):
    clip = copy / "train" / "cornell_box" / "000"
    flip_byte(clip / "depth.npy")
    (clip / "normal.npy").write_bytes((clip / "normal.npy").read_bytes()[:-100])
    (clip / "albedo.npy").unlink()
    np.save(clip / "mesh_id.npy", np.zeros((2, 2), np.uint16))
    (copy / "val" / "cornell_box" / "000" / "clip.json").write_text("{")
    shutil.rmtree(copy / "test" / "cornell_box" / "000")
    problems = "\n".join(verify(copy))
    for damaged in ("depth.npy", "normal.npy", "albedo.npy", "mesh_id.npy", "clip.json", "test/cornell_box/000"):
        assert damaged in problems
    assert len(problems.splitlines()) == 6


def test_damaged_headers_and_json_of_another_form_are_bad_input(copy):
    """Bits flipped in an .npy header, which numpy reads as Python, and JSON that is valid but something else."""
    path = copy / "test" / "cornell_box" / "000"
    header = (path / "depth.npy").read_bytes()
    rng = np.random.default_rng(0)
    for bit in rng.integers(0, 128 * 8, 60):
        data = bytearray(header)
        data[bit // 8] ^= 1 << (bit % 8)
        (path / "depth.npy").write_bytes(data)
        assert any("depth.npy" in problem for problem in check_clip(path))
    for content in ("[]", "3", '{"complete": true}'):
        (path / "clip.json").write_text(content)
        with pytest.raises(BadInput, match=r"clip.json is damaged"):
            Clip(path)
    (copy / "dataset.json").write_text("[]")
    with pytest.raises(BadInput, match=r"dataset.json is damaged"):
        Dataset(copy)


def test_info_tells_sizes_floors_and_what_is_missing(copy):
    shutil.rmtree(copy / "val" / "cornell_box" / "000")
    text = info(copy)
    for word in ("floor dB", "P95/P5", "dual_motion", "derived", "value", "missing", "test/cornell_box_moving/000"):
        assert word in text


def test_difficulty_by_hand(tmp_path):
    """Half of the pixels black at 1 spp, the others twice the reference of 1; one firefly; a dark tenth."""
    shape = (40, 50)
    reference = np.ones((*shape, 3))
    reference[:4] = 0.01  # a tenth of the rows
    noisy = 2 * reference
    noisy[:, ::2] = 0
    frame = {
        "direct": noisy[None] / 2,
        "indirect": np.zeros((1, *shape, 3)),
        "direct_reference": np.stack([reference, reference]) / 2,
        "indirect_reference": np.zeros((2, *shape, 3)),
        "emission": np.full((*shape, 3), 7.0),
        "albedo": np.full((*shape, 3), 0.5),
        "mesh_id": np.ones((*shape, 1)),
    }
    with ClipWriter(tmp_path / "clip") as writer:
        writer.add(frame, {})
        writer.finish({}, {})
    zeros, relative_mse, peak, contrast = difficulty(Clip(tmp_path / "clip"))
    assert zeros == pytest.approx(0.5)
    assert relative_mse == pytest.approx((reference[..., 0] ** 2).mean() / reference[..., 0].mean() ** 2, rel=1e-3)
    assert peak == pytest.approx(2 / noisy.mean(), rel=1e-3)
    assert contrast == pytest.approx(100, rel=1e-2)


def test_missing_clip_and_other_schema(copy):
    shutil.rmtree(copy / "train" / "cornell_box" / "000")
    with pytest.raises(BadInput, match=r"train/cornell_box/000.*onespp dataset"):
        Dataset(copy).clips("train")
    facts = json.loads((copy / "dataset.json").read_text())
    (copy / "dataset.json").write_text(json.dumps(facts | {"schema": 99}))
    with pytest.raises(BadInput, match="schema version 99"):
        Dataset(copy)
    with pytest.raises(BadInput, match="there is no data set"):
        Dataset(copy / "nowhere")


def test_rerun_renders_only_what_is_missing_and_ends_with_equal_bytes(tiny, copy):
    """Also across processes: the fixture was rendered in one, clip after clip, and this clip alone in another."""
    expected = digest(tiny)
    victim = copy / "train" / "cornell_box_moving" / "000"
    shutil.rmtree(victim)
    (victim.parent / ".000.tmp").mkdir()
    (victim.parent / ".000.tmp" / "direct.raw").write_bytes(b"left by a killed job")
    untouched = (copy / "test" / "cornell_box" / "000" / "direct.npy").stat().st_mtime_ns
    run = subprocess.run([*ONESPP, "dataset", "--data", str(copy), "--profile", "tiny"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert "1 clips rendered" in run.stdout
    assert digest(copy) == expected
    assert (copy / "test" / "cornell_box" / "000" / "direct.npy").stat().st_mtime_ns == untouched
    assert generate(copy, "tiny", 0) == 0


def kill_and_resume(root: Path, rng: np.random.Generator, kills: int) -> int:
    """Kill the job at random moments, then let it finish. Returns how many kills hit a running job."""
    hit = 0
    for _ in range(kills):
        job = subprocess.Popen(
            [*ONESPP, "dataset", "--data", str(root), "--profile", "tiny"], stderr=subprocess.DEVNULL
        )
        time.sleep(rng.uniform(0.7, 2.7))
        hit += job.poll() is None
        job.send_signal(signal.SIGKILL)
        job.wait()
        for clip in root.glob("*/*/[0-9]*"):
            assert json.loads((clip / "clip.json").read_text())["complete"]  # whole or absent
    subprocess.run(
        [*ONESPP, "dataset", "--data", str(root), "--profile", "tiny"], check=True, stderr=subprocess.DEVNULL
    )
    return hit


def test_killed_job_resumes_to_equal_bytes(tiny, tmp_path):
    assert kill_and_resume(tmp_path / "data", np.random.default_rng(0), kills=3) > 0
    assert digest(tmp_path / "data") == digest(tiny)


@pytest.mark.slow
def test_killed_fifty_times(tiny, tmp_path):
    rng, hit = np.random.default_rng(1), 0
    for attempt in range(10):
        hit += kill_and_resume(tmp_path / str(attempt), rng, kills=5)
        assert digest(tmp_path / str(attempt)) == digest(tiny)
    assert hit > 10


def test_full_disk_is_one_clear_line_and_leaves_whole_clips_only(tmp_path):
    """A limit on file size stands in for a full disk: writing fails with an error of the operating system."""

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))

    root = tmp_path / "data"
    command = [*ONESPP, "dataset", "--data", str(root), "--profile", "tiny"]
    environment = os.environ | {"DRJIT_CACHE_DIR": str(tmp_path / "kernels")}
    (tmp_path / "kernels").mkdir()
    run = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit, env=environment)
    assert run.returncode == 2, run.stderr
    assert "run it again" in run.stderr.splitlines()[-1] and "Traceback" not in run.stderr
    assert [path for path in root.rglob("*") if path.is_file() and path.name != "dataset.json"] == []


def test_two_jobs_on_one_folder_share_the_work(copy, tiny):
    """A clip that another process renders is left to it; the rest goes on."""
    theirs, ours = copy / "val" / "cornell_box" / "000", copy / "train" / "cornell_box" / "000"
    for path in (theirs, ours):
        shutil.rmtree(path)
    with locked(theirs.with_name(".000.lock")) as claim:
        assert claim
        assert generate(copy, "tiny", 0) == 1
        assert ours.exists() and not theirs.exists()
    assert generate(copy, "tiny", 0) == 1
    assert digest(copy) == digest(tiny)


def test_two_processes_on_one_folder_share_the_work(tiny, tmp_path):
    command = [*ONESPP, "dataset", "--data", str(tmp_path / "data"), "--profile", "tiny"]
    jobs = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
    outputs = [job.communicate(timeout=120) for job in jobs]
    assert [job.returncode for job in jobs] == [0, 0], outputs
    assert sum(int(re.search(r"(\d+) clips rendered", out)[1]) for out, _ in outputs) == 6
    assert digest(tmp_path / "data") == digest(tiny)


def test_parts_are_disjoint_and_their_union_is_the_whole(tiny, tmp_path):
    shares = [tmp_path / str(k) for k in (1, 2, 3, 4)]
    counts = [generate(share, "tiny", 0, Part.parse(f"{k}/4")) for k, share in enumerate(shares, 1)]
    assert sum(counts) == 6 and max(counts) - min(counts) <= 1
    for share in shares[1:]:
        shutil.copytree(share, shares[0], dirs_exist_ok=True)
    assert digest(shares[0]) == digest(tiny)
    for text in ("0/4", "5/4", "1/0", "x", "1", "-1/2"):
        with pytest.raises(BadInput, match="K/N"):
            Part.parse(text)


def test_a_clip_that_fails_does_not_stop_the_others(copy, monkeypatch):
    for scene in ("cornell_box", "cornell_box_moving"):
        shutil.rmtree(copy / "val" / scene / "000")
    genuine = datasets.job.build_scene

    def broken(name, seed, frames):
        if name == "cornell_box":
            raise RuntimeError("no such texture")
        return genuine(name, seed, frames)

    monkeypatch.setattr(datasets.generate, "build_scene", broken)
    with pytest.raises(BadInput, match=r"1 of 2 clips failed.*val/cornell_box/000: no such texture"):
        generate(copy, "tiny", 0)
    assert (copy / "val" / "cornell_box_moving" / "000" / "clip.json").exists()
    assert not list((copy / "val" / "cornell_box").glob("*"))


def test_samples_that_are_not_finite_are_counted_by_clip_and_shown(copy, monkeypatch):
    for scene in ("cornell_box", "cornell_box_moving"):
        shutil.rmtree(copy / "val" / scene / "000")
    genuine = datasets.job.render_clip

    def faulty(scene, *arguments):
        for index, (channels, seconds) in enumerate(genuine(scene, *arguments)):
            if index == 3 and not scene.moves():
                channels["direct"][0, 5, 5:7] = np.nan
                channels["indirect_reference"][1, 0, 0, 2] = np.inf
            yield channels, seconds

    monkeypatch.setattr(datasets.generate, "render_clip", faulty)
    assert generate(copy, "tiny", 0) == 2
    box, moving = Dataset(copy).clips("val")
    assert {name: count for name, count in box.facts["nonfinite"].items() if count} == {
        "direct": 6,
        "indirect_reference": 1,
    }
    assert not any(moving.facts["nonfinite"].values())
    assert (box.read("direct", 3)[5, 5:7] == 0).all()
    head, *rows = (
        re.split(r"\s{2,}", line) for line in info(copy).splitlines() if re.match(r"clip |\w+/cornell", line)
    )
    bad = {row[0]: row[head.index("bad values")].strip() for row in rows}
    assert bad.pop("val/cornell_box/000") == "7" and set(bad.values()) == {"0"}


def test_more_memory_maps_than_files_may_be_open(tiny):
    """Every map holds a file descriptor, a dozen a clip, and the usual limit is 1024."""
    script = f"""
import resource
from pathlib import Path
from datasets.clip import Dataset
resource.setrlimit(resource.RLIMIT_NOFILE, (16, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
clips = Dataset(Path({str(tiny)!r})).clips("train")
maps = [clip.map(name) for clip in clips for name, entry in clip.channels.items() if "file" in entry]
assert len(maps) > 16, len(maps)
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_what_a_kill_or_a_careless_hand_left_is_repaired(tiny, copy):
    (copy / "dataset.json").rename(copy / ".dataset.json.tmp")  # killed before the first file was in place
    for path in (copy / "train", copy / "val", copy / "test"):
        shutil.rmtree(path)
    assert generate(copy, "tiny", 0) == 6
    (copy / "test" / "cornell_box" / "000" / "clip.json").unlink()
    assert generate(copy, "tiny", 0) == 1
    assert digest(copy) == digest(tiny)


def test_a_data_set_is_not_continued_with_other_versions(copy):
    facts = json.loads((copy / "dataset.json").read_text())
    facts["versions"]["mitsuba"] = "3.0.0"
    (copy / "dataset.json").write_text(json.dumps(facts))
    assert generate(copy, "tiny", 0) == 0  # nothing to render
    shutil.rmtree(copy / "val" / "cornell_box" / "000")
    with pytest.raises(BadInput, match=r"begun with mitsuba 3.0.0"):
        generate(copy, "tiny", 0)


def test_folder_of_something_else_is_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("precious")
    with pytest.raises(BadInput, match="something else"):
        generate(tmp_path, "tiny", 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(BadInput, match="is a file"):
        generate(tmp_path / "file", "tiny", 0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "thesis.tex"]


def test_other_seed_or_profile_needs_another_folder(tiny):
    with pytest.raises(BadInput, match="another seed"):
        generate(tiny, "tiny", 1)
    with pytest.raises(BadInput, match="another profile"):
        generate(tiny, "quick", 0)
    with pytest.raises(BadInput, match=r"unknown profile 'huge'.*quick"):
        plan("huge", 0)
    with pytest.raises(BadInput, match="negative"):
        plan("tiny", -1)
