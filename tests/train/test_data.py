"""Who reads which items, in what parts; and crops of accumulated frames."""

import resource
import signal

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from datasets.clip import Dataset
from datasets.frame import read_frame
from errors import BadInput
from models.registry import create
from train.accumulated import AccumulatedCrops, accumulate_clip
from train.data import in_parts, loader, micro_batches, split


@given(count=st.integers(1, 200), most=st.integers(1, 250))
def test_split_makes_the_fewest_equal_parts(count, most):
    parts = split(count, most)
    assert [i for part in parts for i in part] == list(range(count))
    assert {len(part) for part in parts} == {len(parts[0])} and len(parts[0]) <= most
    fewer = [n for n in range(1, len(parts)) if count % n == 0 and count // n <= most]
    assert not fewer


@given(st.sampled_from([1, 2, 4]), st.integers(1, 8), st.integers(0, 3))
def test_processes_share_what_one_would_read(world, at_once, first):
    """Step by step, all processes together read the items of a single one, whatever the parts."""
    batch, stop = 8, 5
    whole = micro_batches(first, stop, batch, batch)
    assert whole == [list(range(s * batch, (s + 1) * batch)) for s in range(first, stop)]
    parts = len(split(batch // world, at_once))
    shares = [micro_batches(first, stop, batch, at_once, rank, world) for rank in range(world)]
    for step, expected in enumerate(whole):
        seen = [i for share in shares for part in share[step * parts : (step + 1) * parts] for i in part]
        assert sorted(seen) == expected


@pytest.fixture(scope="module")
def clips(tiny):
    return Dataset(tiny).clips("train")


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("accumulated")


def crops(clips, cache, crop=32, count=3, seed=0) -> AccumulatedCrops:
    return AccumulatedCrops(clips, create("wskp3"), count, crop, seed, cache)


def test_crops_hold_what_the_network_meets_in_use(clips, cache):
    """A whole frame's input is that of the denoiser, run frame by frame over the clip."""
    wskp, clip = create("wskp3"), clips[1]
    folder = accumulate_clip(clip, wskp, cache)
    irradiance, scale = (np.load(folder / name) for name in ("irradiance.npy", "scale.npy"))
    state = None
    for index in range(clip.frames):
        frame = read_frame(clip, index, wskp.reads, 1)
        _, state = wskp(frame, state)
        torch.testing.assert_close(
            torch.from_numpy(irradiance[index, 1]).permute(2, 0, 1)[None], state.history.irradiance
        )
        expected = [state.scale.log_luminance.value.item(), state.scale.log_depth.value.item()]
        assert scale[index, 1].tolist() == pytest.approx(expected)
    whole = crops(clips, cache, crop=None)[0]
    assert whole.irradiance.shape == (1, 3, clip.height, clip.width)


def test_a_crop_depends_on_seed_epoch_and_index_only(clips, cache):
    a, b = crops(clips, cache), crops(clips, cache)
    _ = b[0], b[1]  # whatever was read before
    assert torch.equal(a[5].irradiance, b[5].irradiance)
    assert not torch.equal(a[5].irradiance, a[6].irradiance)
    b.set_epoch(1)
    assert not torch.equal(a[5].irradiance, b[5].irradiance)
    assert not torch.equal(a[5].irradiance, crops(clips, cache, seed=1)[5].irradiance)
    assert len(a) == 3 * sum(clip.frames for clip in clips)


def test_accumulating_is_done_once_and_whole(clips, cache, tmp_path, monkeypatch):
    """A second training finds what the first has accumulated; an interrupted one leaves nothing that looks whole."""
    wskp = create("wskp6")
    monkeypatch.setattr(type(wskp), "accumulate", lambda *_: pytest.fail("accumulated again"))
    accumulate_clip(clips[0], wskp, cache)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(type(wskp), "accumulate", interrupted)
    with pytest.raises(KeyboardInterrupt):
        accumulate_clip(clips[0], wskp, tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_full_disk_is_an_error_and_leaves_nothing(clips, tmp_path):
    """A limit on file size stands in for a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        with pytest.raises(OSError, match="File too large"):
            accumulate_clip(clips[0], create("wskp3"), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert not list(tmp_path.iterdir())


def test_crops_stack_and_come_in_parts(clips, cache):
    data = crops(clips, cache)
    steps = list(map(list, in_parts(loader(data, micro_batches(0, 2, 4, 2)), 2)))
    assert [[len(part.irradiance) for part in step] for step in steps] == [[2, 2], [2, 2]]
    batch = steps[1][0]
    assert torch.equal(batch.irradiance[1:], data[5].irradiance)
    assert torch.equal(batch.frame.albedo[1:], data[5].frame.albedo)
    assert torch.equal(batch.scale.exposure()[1:], data[5].scale.exposure())


def test_too_small_clips_are_refused(clips, cache):
    with pytest.raises(BadInput, match="too few or too small to train on"):
        crops(clips, cache, crop=65)
