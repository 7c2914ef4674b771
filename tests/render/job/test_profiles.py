"""Clips of profiles and their names, samples of references, and channels that are left out."""

from pathlib import Path

import numpy as np
import pytest
import torch

from datasets.channels import CHANNELS, HIT_CHANNELS, MOTION_CHANNELS, SAMPLE_BUFFERS, USUAL_CHANNELS
from datasets.clip import SPLITS, Clip, ClipKind
from datasets.frame import read_frame
from datasets.info import size_in_full, stored_size, summarise
from errors import BadInput
from models.registry import channels_read
from render.clip import NO_OPTIONS
from render.job import pilots
from render.job.generate import generate, render_to_folder
from render.job.pilots import choose_rooms, noise_of_reference, samples_needed
from render.job.plan import clips_of, plan, rarity_of_clip, rooms_of
from render.job.profiles import DataProfile, SamplingQuality, profile_of
from render.stage import Stage
from scenes.registry import build_scene
from tests.helpers.datasets import MOST_CHANNELS


def test_release_has_rooms_enough_and_tests_on_others():
    facts = plan("release", 0)
    rooms = {split: {c for c in clips if c.startswith("room")} for split, clips in facts["splits"].items()}
    assert len(rooms["train"]) >= 64 and len(rooms["val"]) >= 8 and rooms["test"]
    closeups = [c for clips in facts["splits"].values() for c in clips if c.startswith("closeup")]
    parts = {c.replace("closeup", "room") for c in closeups}
    assert len(parts) >= 64 and not parts & (rooms["train"] | rooms["val"] | rooms["test"])
    assert not rooms["train"] & rooms["val"] and not (rooms["train"] | rooms["val"]) & rooms["test"]
    boxes = {split: [c for c in clips if c.startswith("cornell")] for split, clips in facts["splits"].items()}
    assert not boxes["train"] and {"cornell_box/000", "cornell_box_moving/still"} <= set(boxes["test"])
    assert {f"cornell_box_moving/000-{spp}spp" for spp in (4, 64, 256)} <= set(boxes["test"])
    quality = profile_of("release").quality
    assert quality["train"].floor is None and quality["test"].floor == 40  # docs/training.md, Samples where they teach


def test_other_seeds_have_other_rooms():
    a, b = (set(clips_of(profile_of("release"), "train", seed)) for seed in (0, 1))
    assert not a & b


def test_half_of_the_clips_sample_lights_up_to_so_many_times_more_rarely():
    rarities = np.array([rarity_of_clip(seed, 64.0) for seed in range(400)])
    rarer = rarities[rarities != 1]
    assert 160 < len(rarer) < 240 and rarer.min() > 1 and rarer.max() < 64
    assert np.log2(rarer).mean() == pytest.approx(3, abs=0.4)
    assert {rarity_of_clip(seed, 1.0) for seed in range(20)} == {1.0}


def test_clip_names_are_parsed():
    kinds = {"000": (0, False, 1), "012": (12, False, 1), "still": (0, True, 1), "000-64spp": (0, False, 64)}
    assert {name: ClipKind.of(name) for name in kinds} == kinds
    with pytest.raises(BadInput, match="'moving' does not name a clip"):
        ClipKind.of("moving")


def small_profile(size: int, frames: int, quality: SamplingQuality) -> DataProfile:
    """For test clips of `size` x `size` pixels."""
    return DataProfile((frames, size, size), {"test": quality})


def rendered(root: Path, name: str, profile: DataProfile) -> Clip:
    """A test clip, SCENE/CLIP, with most channels."""
    path = root / "test" / name
    render_to_folder(path, profile, 0, MOST_CHANNELS)
    return Clip(path)


@pytest.fixture(scope="module")
def moving_boxes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Clip]:
    """One moving box as it is, standing still, and with 16 spp as noisy input."""
    profile = small_profile(24, 5, SamplingQuality(realisations=4, reference_spp=8))
    root = tmp_path_factory.mktemp("variants")
    return {name: rendered(root, f"cornell_box_moving/{name}", profile) for name in ("000", "still", "000-16spp")}


def test_in_a_still_clip_only_the_noise_changes(moving_boxes):
    clip = moving_boxes["still"]
    for name in ("albedo", "normal", "depth", "emission", "mesh_id"):
        assert all(np.array_equal(clip.read(name, 0), clip.read(name, frame)) for frame in range(1, clip.frames))
    assert all((clip.read("motion", frame) == 0).all() for frame in range(clip.frames))
    assert clip.channels["gradient"] == {"value": [0.0, 0.0]} and not clip.read("gradient", 2).any()
    assert not np.array_equal(clip.read("direct", 0), clip.read("direct", 1))
    assert not np.array_equal(moving_boxes["000"].read("depth", 0), moving_boxes["000"].read("depth", 4))


def test_more_samples_as_input_have_less_noise_and_the_same_reference(moving_boxes):
    single = moving_boxes["000"]
    many = moving_boxes["000-16spp"]
    assert many.facts["noisy_spp"] == 16
    for name in ("direct_reference", "indirect_reference", "albedo", "motion", "dual_motion"):
        assert all(np.array_equal(single.read(name, frame), many.read(name, frame)) for frame in range(single.frames))

    def variance(clip: Clip) -> float:
        noisy = [[clip.read("indirect", f, realisation=s).astype(float) for s in range(4)] for f in range(clip.frames)]
        return float(np.var(noisy, axis=1, ddof=1).mean())

    assert variance(many) < variance(single) / 12  # stratified samples gain about a 16th, as independent ones


def test_buffers_predict_the_noise_of_their_mean(moving_boxes):
    """(A - B)² / 4 is the variance of the mean: the same that its realisations show."""
    assert "direct_buffers" not in moving_boxes["000"].channels  # of one sample
    many = moving_boxes["000-16spp"]
    for name, buffers in SAMPLE_BUFFERS.items():
        drawn = np.array([[many.read(buffers, f, realisation=s) for s in range(4)] for f in range(many.frames)], float)
        noisy = np.array([[many.read(name, f, realisation=s) for s in range(4)] for f in range(many.frames)], float)
        np.testing.assert_allclose(noisy, drawn.mean(axis=2), rtol=2e-3, atol=1e-5)  # of float16
        predicted = ((drawn[:, :, 0] - drawn[:, :, 1]) ** 2).mean() / 4
        assert predicted == pytest.approx(np.var(noisy, axis=1, ddof=1).mean(), rel=0.3)


def test_buffers_are_stored_together_on_request():
    """A clip for denoisers of indirect light alone may be shown to others too."""
    assert set(SAMPLE_BUFFERS.values()) < set(plan("release", 0, channels_read(["ntd+js"]))["channels"]["test"])
    assert set(plan("release", 0, channels_read(["ntd"]))["channels"]["test"]) == set(USUAL_CHANNELS)


def test_a_frame_returns_its_buffers_as_frames(moving_boxes):
    frame = read_frame(moving_boxes["000-16spp"], 2, ("direct", "albedo", *SAMPLE_BUFFERS.values()))
    a, b = frame.buffer(0), frame.buffer(1)
    assert frame.has_buffers and not a.has_buffers
    assert a.channels.keys() == {"direct", "albedo"} and float(a.samples) == float(b.samples) == 8
    torch.testing.assert_close((a.direct + b.direct) / 2, frame.direct, rtol=2e-3, atol=1e-5)
    single = read_frame(moving_boxes["000"], 2, ("direct", "albedo", *SAMPLE_BUFFERS.values()))
    assert not single.has_buffers and single.channels.keys() == {"direct", "albedo"}


@pytest.mark.parametrize("floor", [pytest.param(34.0, marks=pytest.mark.slow), 40.0])
def test_references_get_down_to_their_floor(floor, tmp_path):
    profile = small_profile(32, 4, SamplingQuality(realisations=1, reference_spp=16, floor=floor))
    clip = rendered(tmp_path, "cornell_box/000", profile)
    assert -10 * np.log10(clip.facts["floor_mse"]) > floor - 0.5
    spp = clip.facts["reference_spp"]
    assert spp > 16 and spp & (spp - 1) == 0


@pytest.mark.slow
def test_rare_bright_paths_are_found_with_the_samples_that_the_pilot_chose():
    scene = build_scene("room-3", 0, 2)  # in which few samples see little of the noise that many have
    quality = SamplingQuality(realisations=1, reference_spp=16, floor=26.0, most_spp=1024)
    stage = Stage(scene, 24, 24)
    wanted = 10**-2.6
    predicted = 16 * 2 ** np.ceil(np.log2(noise_of_reference(stage, 1, 16, 2, NO_OPTIONS) / wanted))
    spp = samples_needed(scene, (1, 48, 48), quality, 2)
    assert spp > predicted
    assert spp > 1024 or noise_of_reference(stage, 1, spp, 2, NO_OPTIONS) <= wanted


def test_references_stop_at_the_most(tmp_path):
    quality = SamplingQuality(realisations=1, reference_spp=8)
    scene = build_scene("cornell_box", 0, 2)
    assert samples_needed(scene, (2, 16, 16), quality, 1) == 8
    hopeless = quality._replace(floor=90.0, most_spp=64)
    assert samples_needed(scene, (2, 16, 16), hopeless, 1) > 64
    assert rendered(tmp_path, "cornell_box/000", small_profile(16, 2, hopeless)).facts["reference_spp"] == 64


@pytest.mark.slow
def test_rooms_that_would_need_too_many_samples_are_skipped():
    bounded = SamplingQuality(realisations=1, reference_spp=16, floor=33.0, most_spp=128, skips_noisy_rooms=True)
    profile = DataProfile((2, 32, 32), {"test": bounded}, rooms={"test": 3})
    needed = choose_rooms(profile, 0, NO_OPTIONS)
    chosen = [f"test/{room}" for room in rooms_of(profile, "test", 0, needed)]
    assert len(chosen) == 3
    assert all(needed[room] <= 128 for room in chosen)
    skipped = set(needed) - set(chosen)
    assert skipped and all(needed[room] > 128 for room in skipped)


def test_rooms_that_all_need_too_many_samples_end_the_search(monkeypatch):
    monkeypatch.setattr(pilots, "samples_needed", lambda *_: 4096)
    monkeypatch.setattr(pilots, "scene_of_clip", lambda *_: (None, 0))
    bounded = SamplingQuality(realisations=1, reference_spp=16, floor=90.0, most_spp=128, skips_noisy_rooms=True)
    profile = DataProfile((2, 32, 32), {"test": bounded}, rooms={"test": 2})
    with pytest.raises(BadInput, match="fewer than 2 in 64 rooms reach 90 dB within 128 spp"):
        choose_rooms(profile, 0, NO_OPTIONS)


@pytest.mark.parametrize("name", ["rooms-0x16", "rooms-4x1", "rooms-4x0"])
def test_rooms_need_a_room_and_two_buffers(name):
    with pytest.raises(BadInput, match="2 spp or more"):
        profile_of(name)


def test_rooms_to_test_on_are_not_trained_on():
    profile = profile_of("rooms-1000x16")
    rooms = [room for split in SPLITS for room in clips_of(profile, split, seed=0)]
    assert len(set(rooms)) == len(rooms) == 1007
    with pytest.raises(BadInput, match="at most 1000 rooms"):
        profile_of("rooms-1001x16")


READS = channels_read(["accumulated", "rae"])  # not dual_motion, which cannot be derived


@pytest.fixture(scope="module")
def lean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips of the tiny dataset, the box in training and test, for denoisers that do not read all channels."""
    root = tmp_path_factory.mktemp("lean")
    assert generate(root, "tiny", seed=0, reads=READS, part="1/4") == 2
    return root


def test_unread_channels_are_not_rendered(lean):
    clip = Clip(lean / "train" / "cornell_box" / "000")
    assert set(clip.channels) == set(plan("tiny", 0, READS)["channels"]["train"]) < set(CHANNELS)
    with pytest.raises(BadInput, match="'dual_motion': it was not rendered"):
        clip.read("dual_motion", 1)
    assert set(Clip(lean / "test" / "cornell_box" / "000").channels) == set(USUAL_CHANNELS)


def test_a_static_diffuse_box_takes_at_most_sixty_percent(lean):
    clip = Clip(lean / "train" / "cornell_box" / "000")
    surface = ("emission", "albedo", "normal", "depth", "roughness", "mesh_id")
    names = (*surface, *MOTION_CHANNELS, "gradient", *HIT_CHANNELS)
    stored = sum(stored_size(clip, name) for name in names)
    assert 0.2 < stored / sum(size_in_full(clip, name) for name in names) <= 0.6


def test_info_shows_what_is_saved(lean):
    lines = summarise(lean).splitlines()
    channel, step = (line.split() for line in lines if line.startswith("dual_motion"))
    assert "not rendered" in " ".join(channel)
    assert "% of full" in next(line for line in lines if line.startswith("auxiliary channels"))
    assert float(step[1]) > 0 and float(step[2]) > 0  # seconds spent on test clips, saved on the others
