"""Crops are exposed like the whole frames that they are cut from, as they are in use."""

from dataclasses import replace

import pytest
import torch

from datasets.clip import Clip, Dataset
from datasets.frame import Frame, read_frame
from models.registry import create
from train import sequences as module
from train.augmentation import Augmentation
from train.sequences import TrainingSequences, WholeFrames, collate

Played = tuple[Clip, int, int]


class Recorded(WholeFrames):
    """Notes which frames and realisations were asked for."""

    def __init__(self, signal):
        super().__init__(signal)
        self.asked: list[Played] = []

    def __call__(self, clip, index, realisation):
        self.asked.append((clip, index, realisation))
        return super().__call__(clip, index, realisation)


@pytest.fixture(scope="module")
def clips(tiny):
    return Dataset(tiny).clips("train")


def is_part_of(crop: Frame, whole: Frame) -> bool:
    """Whether the noise of a crop of 32 x 32 pixels is somewhere in the whole frame."""
    windows = whole.indirect.unfold(2, 32, 1).unfold(3, 32, 1)
    return bool((windows == crop.indirect[:, :, None, None]).all(dim=-1).all(dim=-1).all(dim=1).any())


@pytest.mark.parametrize("name, reverse", [("rae", True), ("ntd", False)])
@torch.no_grad()
def test_crops_get_the_scale_of_their_whole_frames(clips, name, reverse):
    """Played backward, with a camera that stops and with gains; without what frames say the crop's own is another."""
    denoiser = create(name)
    measure = Recorded(denoiser.signal)
    augmentation = Augmentation(reverse=reverse, stop=True, gain=True)
    sequences = TrainingSequences(clips, denoiser.reads, 4, 32, augmentation, 0)
    sequences.whole_frames = measure
    unlike = 0
    for index in range(6):
        measure.asked.clear()
        crops = sequences[index]
        cropped = None
        whole = None
        last = measure.asked[0][1]
        for crop, (clip, position, realisation) in zip(crops, measure.asked, strict=True):
            frame = read_frame(clip, position, denoiser.reads, realisation, previous=last)
            assert is_part_of(crop, frame)
            _, cropped = denoiser.predict(crop, cropped)
            _, whole = denoiser.predict(frame, whole)
            last = position
        torch.testing.assert_close(cropped.scale.exposure(), whole.scale.exposure())
        torch.testing.assert_close(cropped.scale.log_depth.value, whole.scale.log_depth.value)
        own, with_whole = (denoiser.predict(each, None)[1].scale for each in (replace(crop, whole=None), crop))
        unlike += not torch.allclose(own.exposure(), with_whole.exposure(), rtol=0.05)
    assert unlike >= 3


def test_each_frame_is_measured_once(clips, monkeypatch):
    measure = WholeFrames("total")
    first = measure(clips[0], 3, 1)
    other = [measure(*asked) for asked in ((clips[0], 3, 0), (clips[0], 4, 1), (clips[1], 3, 1))]
    assert not any(torch.equal(first, each) for each in other)
    monkeypatch.setattr(module, "measure", lambda *_: pytest.fail("measured again"))
    assert torch.equal(measure(clips[0], 3, 1), first)


def test_what_whole_frames_say_survives_batches(clips):
    sequences = TrainingSequences(clips, ("indirect", "depth"), 2, 32, Augmentation(), 0, "indirect")
    batch = collate([sequences[0], sequences[1]]).to("cpu")
    assert torch.equal(batch.frames[1].whole, torch.cat([sequences[0][1].whole, sequences[1][1].whole]))
    assert batch.frames[0].whole.shape == (2, 2)
