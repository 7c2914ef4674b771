"""The TOML of a user's own scene: its content, refusals, and the curves of its keyframes."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from errors import BadInput
from provenance import ROOT
from render.scene_file.description import CameraKey, GainKey, PoseKey, camera_of, gain_of, motion_of, read_description
from scenes.animation import Camera, FreeMotion, KeyframedTrack, Track


def described(folder, text):
    path = folder / "my.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_description(path)


def test_the_example_of_the_docs(tmp_path):
    """It has all keys, and the values that it gives as defaults are the defaults."""
    (example,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "scenes.md").read_text(), re.DOTALL)
    parsed = described(tmp_path, example)
    assert (parsed.resolution, parsed.frames, parsed.bounces) == ((256, 144), 16, 2)
    assert [(key.time, key.up, key.fov) for key in parsed.camera] == [(0, None, None), (1, (0, 1, 0), 24)]
    assert parsed.motion[0].shape == "ball" and parsed.motion[0].keyframes[2] == PoseKey(1, (0.3, 0, 0), (0, 90, 0))
    assert parsed.light[0].light == "lamp" and parsed.light[0].keyframes[1] == GainKey(1, 0.25)
    assert parsed.splits.test.judged == (0, 4, 14, 15)
    plain = described(tmp_path, "file = 'a.xml'")
    assert (parsed.resolution, parsed.frames) == (plain.resolution, plain.frames)
    assert replace(parsed.splits.train, camera=None) == plain.splits.train and parsed.splits.val == plain.splits.val
    assert replace(parsed.splits.test, judged=()) == plain.splits.test


REFUSED = {
    "": "file",
    "file = 3": "str",
    "file = 'a'\ncolour = 1": "colour",
    "file = 'a'\nresolution = [0, 4]": "resolution",
    "file = 'a'\nresolution = [4]": "resolution",
    "file = 'a'\nframes = 0": "frames",
    "file = 'a'\nframes = 1.5": "frames",
    "file = 'a'\n[splits.holiday]\nclips = 1": "unknown field `holiday`",
    "file = 'a'\n[splits.test]\nclips = -1": "clips",
    "file = 'a'\n[splits.test]\nreference_spp = 3": "reference_spp",
    "file = 'a'\n[splits.test]\ncamera = 'keyframes'": "add \\[\\[camera\\]\\] tables",
    "file = 'a'\n[[camera]]\ntime = 2\nposition = [0,0,0]\ntarget = [0,0,1]": "time",
    "file = 'a'\n[[camera]]\ntime = 0\nposition = [nan,0,0]\ntarget = [0,0,1]": "float",
    "file = 'a'\n[[camera]]\ntime = 0\nposition = [0,0,0]\ntarget = [0,0,inf]": "float",
    "file = 'a'\n[[camera]]\ntime = 0\nposition = [0,0,0]\ntarget = [0,0,1]\nfov = 180": "fov",
    "file = 'a'\n[[motion]]\nshape = 'b'\nkeyframes = []": "keyframes",
    "file = 'a'\n[[motion]]\nshape = 'b'\nkeyframes = [{time=1},{time=0}]": "do not increase",
    "file = 'a'\n[[light]]\nlight = 'b'\nkeyframes = [{time=0,gain=-1}]": "gain",
    "file = 'a'\n[[light]]\nlight = 'b'\nkeyframes = [{time=0,gain=inf}]": "gain",
    "file = 'a'\n[splits.test]\nfloor = inf": "floor",
    "file = 'a'\n[splits.test]\nfloor = 4000": "floor",
    "file = 'a'\n[splits.test]\nreference_spp = 8589934592": "reference_spp",
    "file = 'a'\nframes = 9999999999": "frames",
    "file = 'a'\n" + 2 * "[[light]]\nlight = 'b'\nkeyframes = [{time=0,gain=1}]\n": "'b' has keyframes twice",
    "file = 'a": "docs/scenes.md",
}


@pytest.mark.parametrize("text", REFUSED)
def test_refused_content(tmp_path, text):
    with pytest.raises(BadInput, match=REFUSED[text]) as refusal:
        described(tmp_path, text)
    assert "my.toml" in str(refusal.value) and "\n" not in str(refusal.value)


def test_files_that_are_no_toml(tmp_path):
    for content in (b"\xff\xfe\x00", b"\x00" * 10, b"file = '\xc3\x28'"):
        with pytest.raises(BadInput, match=r"my\.toml"):
            described(tmp_path, content)
    with pytest.raises(BadInput, match="cannot be read"):
        read_description(tmp_path / "gone.toml")
    with pytest.raises(BadInput, match="cannot be read"):
        read_description(tmp_path)


TIMES = st.lists(st.integers(0, 1000), min_size=1, max_size=6, unique=True).map(sorted)


@given(TIMES, st.integers(0, 2**32))
def test_keyframes_are_passed_at_their_times(times, seed):
    keys = np.random.default_rng(seed).normal(size=(len(times), 3))
    track = KeyframedTrack(keys, times=np.array(times, float))
    for time, key in zip(times, keys, strict=True):
        np.testing.assert_allclose(track.at(time), key, atol=1e-9)
    np.testing.assert_array_equal(track.at(-5), keys[0])
    np.testing.assert_array_equal(track.at(2000), keys[-1])


@given(st.integers(2, 6), st.integers(0, 2**32))
def test_even_times_are_an_even_track(count, seed):
    """Which thereby passes its keys without jumps, and is held before the first and after the last."""
    keys = np.random.default_rng(seed).normal(size=(count, 2))
    even = Track(keys, 0, 10)
    keyframed = KeyframedTrack(keys, times=np.linspace(0, 10, count))
    for frame in np.linspace(-2, 12, 57):
        np.testing.assert_allclose(keyframed.at(frame), even.at(frame), atol=1e-9)


def test_its_derivative_is_continuous():
    times = np.array([0.0, 1.0, 4.0, 4.5, 9.0])
    track = KeyframedTrack(np.random.default_rng(0).normal(size=(5, 3)), times=times)
    for time in times[1:-1]:
        before = (track.at(time) - track.at(time - 1e-6)) / 1e-6
        after = (track.at(time + 1e-6) - track.at(time)) / 1e-6
        np.testing.assert_allclose(before, after, atol=1e-3)


def test_gains_stay_between_their_keys():
    gain = gain_of([GainKey(0, 1), GainKey(0.5, 0), GainKey(0.6, 0), GainKey(1, 4)], 11)
    values = np.array([gain.at(frame) for frame in np.linspace(0, 10, 101)])
    assert values.min() == 0 and values.max() == 4 and gain.at(2.5) == pytest.approx(0.5)


def test_motion_is_rigid_and_turns_about_its_pivot():
    pivot = np.array([1.0, 2, 3])
    motion = motion_of([PoseKey(0), PoseKey(1, (5, 0, 0), (0, 90, 0))], pivot, 5)
    assert isinstance(motion, FreeMotion)
    np.testing.assert_allclose(motion.matrix(0), np.eye(4), atol=1e-12)
    for frame in np.linspace(0, 4, 9):
        turn = motion.matrix(frame)[:3, :3]
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
    end = motion.matrix(4)
    np.testing.assert_allclose(end @ [*pivot, 1], [*np.add(pivot, [5, 0, 0]), 1], atol=1e-12)
    np.testing.assert_allclose(end[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # as a right hand turns about y
    both = motion_of([PoseKey(0, (0, 0, 0), (90, 90, 0))], np.zeros(3), 1).matrix(0)
    np.testing.assert_allclose(both[:3, :3] @ [0, 1, 0], [1, 0, 0], atol=1e-12)  # about x, to z; then about y


def test_a_camera_of_one_frame_and_one_key_takes_the_rest_from_the_file():
    above = Track.constant([0.0, 0, 1])
    file = Camera(above, Track.constant([0.0, 0, 0]), Track.constant(33.0), up=above)
    camera = camera_of([CameraKey(0.5, (1, 2, 3), (0, 0, 0))], file, 1)
    np.testing.assert_array_equal(camera.eye.at(0), [1, 2, 3])
    assert camera.x_fov.at(0) == 33
    np.testing.assert_array_equal(camera.up.at(0), [0, 0, 1])
