"""Patterns become frames in order, with all passes or a clear error."""

import pytest

from denoise.sequence import gaps, sequence_of, split_at_cuts
from errors import BadInput


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def touch(*names: str) -> None:
        for name in names:
            (tmp_path / name).parent.mkdir(exist_ok=True)
            (tmp_path / name).touch()

    return touch


def test_frames_are_in_the_order_of_their_numbers(folder):
    folder("v2_10.exr", "v2_9.exr", "v2_100.exr")
    frames = sequence_of({"colour": ["*.exr"]})
    assert [frame.number for frame in frames] == [9, 10, 100]
    assert [frame.name for frame in frames] == ["v2_9.exr", "v2_10.exr", "v2_100.exr"]
    assert sequence_of({"colour": ["v2_9.exr", "v2_100.exr", "v2_10.exr"]}) == frames  # as the shell expands them
    assert gaps(frames) == [100]
    assert [[frame.number for frame in shot] for shot in split_at_cuts(frames, [10])] == [[9], [10], [100]]


def test_the_number_that_differs_is_the_frame(folder):
    folder("0001_beauty_v2.exr", "0002_beauty_v2.exr")
    assert [frame.number for frame in sequence_of({"colour": ["*.exr"]})] == [1, 2]


@pytest.mark.parametrize("form", ["f.{:05d}.exr", "f_{}.exr", "{:03d}.exr"])
def test_frames_before_zero(folder, form):
    folder(*map(form.format, (-2, -1, 0, 1)))
    assert [frame.number for frame in sequence_of({"colour": ["*.exr"]})] == [-2, -1, 0, 1]
    for numbers, expected in (("-2--1", [-2, -1]), ("-1-0", [-1, 0]), ("-2", [-2]), ("0-1", [0, 1])):
        assert [frame.number for frame in sequence_of({"colour": ["*.exr"]}, numbers)] == expected


def test_a_dash_between_words_is_no_minus(folder):
    folder("shot-01-2.exr", "shot-01-3.exr")
    assert [frame.number for frame in sequence_of({"colour": ["*.exr"]})] == [2, 3]


def test_one_file_needs_no_number(folder):
    folder("still.exr", "a.exr", "b.exr")
    assert len(sequence_of({"colour": ["still.exr"]})) == 1
    with pytest.raises(BadInput, match="have no frame numbers"):
        sequence_of({"colour": ["?.exr"]})


def test_passes_are_matched_by_number(folder):
    folder("hdr/1.exr", "hdr/2.exr", "alb/0001.exr", "alb/0002.exr", "alb/0003.exr", "nrm/1.exr")
    frames = sequence_of({"colour": ["hdr/*"], "albedo": ["alb/*"]})
    assert [str(frame.passes["albedo"]) for frame in frames] == ["alb/0001.exr", "alb/0002.exr"]
    with pytest.raises(BadInput, match=r"'nrm/\*' \(normal\) lacks frame 2"):
        sequence_of({"colour": ["hdr/*"], "normal": ["nrm/*"]})
    assert len(sequence_of({"colour": ["hdr/*"], "normal": ["nrm/*"]}, "1-1")) == 1


def test_single_files_belong_together(folder):
    folder("scene_1spp.exr", "albedo.exr")
    (frame,) = sequence_of({"colour": ["scene_1spp.exr"], "albedo": ["albedo.exr"]})
    assert frame.number == 1 and frame.passes["albedo"].name == "albedo.exr"


def test_missing_files_and_frames_are_named(folder):
    folder("1.exr")
    with pytest.raises(BadInput, match=r"no file matches 'x\*'"):
        sequence_of({"colour": ["x*"]})
    with pytest.raises(BadInput, match="no frame within --frames 5-6"):
        sequence_of({"colour": ["*.exr"]}, "5-6")
    with pytest.raises(BadInput, match="'a-b' is not a range"):
        sequence_of({"colour": ["*.exr"]}, "a-b")
    with pytest.raises(BadInput, match="--reset-at 7"):
        split_at_cuts(sequence_of({"colour": ["*.exr"]}), [7])
