"""Accumulated frames: computed once a clip and by the present code; and crops of them."""

import numpy as np
import pytest
import torch

from datasets.frame import read_frame
from models.registry import create
from provenance import sources
from tests.helpers.training import full_disk
from train import accumulation
from train.accumulation import accumulate_clip, accumulation_digest
from train.crops import AccumulatedCrops
from train.data import load_ahead, micro_batches


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("accumulated")


def crops(clips, cache, crop=32, count=3, seed=0) -> AccumulatedCrops:
    return AccumulatedCrops(clips, create("wskp3"), count, crop, seed, cache)


def test_crops_equal_the_input_in_use(clips, cache):
    """A whole frame's input is that of the denoiser, run frame by frame over the clip."""
    wskp = create("wskp3")
    clip = clips[1]
    folder = accumulate_clip(clip, wskp, cache)
    irradiance = np.load(folder / "irradiance.npy")
    scale = np.load(folder / "scale.npy")
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
    a = crops(clips, cache)
    b = crops(clips, cache)
    _ = b[0], b[1]  # whatever was read before
    assert torch.equal(a[5].irradiance, b[5].irradiance)
    assert not torch.equal(a[5].irradiance, a[6].irradiance)
    b.epoch = 1
    assert not torch.equal(a[5].irradiance, b[5].irradiance)
    assert not torch.equal(a[5].irradiance, crops(clips, cache, seed=1)[5].irradiance)
    assert len(a) == 3 * sum(clip.frames for clip in clips)


def test_accumulating_is_done_once_and_whole(clips, cache, tmp_path, monkeypatch):
    """A second training reuses what the first has accumulated; an interrupted one leaves nothing."""
    wskp = create("wskp6")
    accumulate_clip(clips[0], wskp, cache)
    monkeypatch.setattr(accumulation, "read_frame", lambda *_: pytest.fail("accumulated again"))
    accumulate_clip(clips[0], wskp, cache)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(accumulation, "read_frame", interrupted)
    with pytest.raises(KeyboardInterrupt):
        accumulate_clip(clips[0], wskp, tmp_path)
    assert not list(tmp_path.iterdir())


def test_other_code_accumulates_anew_and_leaves_one_copy(clips, tmp_path, monkeypatch):
    wskp = create("wskp3")
    with monkeypatch.context() as patched:
        patched.setattr(accumulation, "accumulation_digest", lambda network: "other")
        stale = accumulate_clip(clips[0], wskp, tmp_path)
    another_clip = accumulate_clip(clips[1], wskp, tmp_path)
    (stale / "irradiance.npy").write_bytes(b"stale")
    fresh = accumulate_clip(clips[0], wskp, tmp_path)
    assert np.load(fresh / "irradiance.npy").shape[0] == clips[0].frames
    assert set(tmp_path.iterdir()) == {fresh, another_clip}


def test_the_key_follows_code_and_packages(monkeypatch):
    wskp = create("wskp3")
    accumulating = sources("train.accumulation", "models.networks.wskp")
    assert accumulating.keys() >= {
        "models.operators",
        "models.compiled.reprojection",
        "datasets.frame",
        "scenes.camera",
    }
    others = {"train.crops", "train.training", "models.networks.rae", "models.networks.ntd", "models.registry"}
    assert not accumulating.keys() & others
    here = accumulation_digest(wskp)
    assert here == accumulation_digest(create("nbgd"))  # which accumulates alike
    assert len(here) == 16 and here == accumulation_digest(wskp)
    with monkeypatch.context() as patched:
        patched.setattr(accumulation, "versions", lambda packages: dict.fromkeys(packages, "0"))
        assert accumulation_digest(wskp) != here
    monkeypatch.setattr(accumulation, "code_digest", lambda *modules: "other")
    assert accumulation_digest(wskp) != here


def test_a_full_disk_is_an_error_and_leaves_nothing(clips, tmp_path):
    with full_disk(100_000), pytest.raises(OSError, match="File too large"):
        accumulate_clip(clips[0], create("wskp3"), tmp_path)
    assert not list(tmp_path.iterdir())


def test_crops_stack_and_come_in_parts(clips, cache):
    data = crops(clips, cache)
    parts = list(load_ahead(data, micro_batches(0, 2, 4, 2)))
    assert [len(part.irradiance) for part in parts] == [2, 2, 2, 2]
    batch = parts[2]
    assert torch.equal(batch.irradiance[1:], data[5].irradiance)
    assert torch.equal(batch.frame.albedo[1:], data[5].frame.albedo)
    assert torch.equal(batch.scale.exposure()[1:], data[5].scale.exposure())
