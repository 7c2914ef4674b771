"""Clips of scenes with mirrors: what is stored, and the input of denoisers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from datasets.channels import MIRRORED, USUAL_CHANNELS
from datasets.clip import Clip
from datasets.exr import write_exr
from datasets.frame import read_frame
from denoise.exr_image import ExrImage
from denoise.frames import OwnFrameBuilder
from render.clip import Sampling, write_clip
from scenes.animation import Scene
from tests.helpers.mirrors import FRAMES, HAND_MIRROR, SILVER, SIZE, painted, room

LAST = FRAMES - 1
OTHER_MOTION = ("dual_motion", "shadow_motion", "reflection_motion")
VISIBLE = (*MIRRORED, *OTHER_MOTION, "gradient", "emission", "direct")


def clip_of(scene: Scene, folder: Path, channels: tuple[str, ...] = USUAL_CHANNELS) -> Clip:
    path = folder / "test" / "room" / "000"
    write_clip(path, scene, (FRAMES, *SIZE), Sampling(1, 1, 2), 0, channels)
    return Clip(path)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    return clip_of(room(SILVER), tmp_path_factory.mktemp("mirror"))


def test_the_input_of_denoisers_is_what_mirrors_show(clip):
    frame = read_frame(clip, LAST, VISIBLE)
    planes = {name: np.moveaxis(np.float32(clip.read(name, LAST)), -1, 0) for name in (*VISIBLE, *MIRRORED.values())}
    stored = {name: planes[name] for name in VISIBLE}
    shown = {name: planes[mirrored] for name, mirrored in MIRRORED.items()}
    picture = stored["mesh_id"][0] == 1
    meshes = clip.view(LAST).object_to_world.shape[0]
    assert meshes >= stored["mesh_id"].max()
    shown["mesh_id"] += meshes * (picture & (shown["mesh_id"] > 0))
    for name in MIRRORED:
        np.testing.assert_array_equal(frame.channel(name)[0], shown[name], err_msg=name)
    for name in OTHER_MOTION:
        visible = frame.channel(name)[0].numpy()
        np.testing.assert_array_equal(visible[:, picture], shown["motion"][:, picture], err_msg=name)
        np.testing.assert_array_equal(visible[:, ~picture], stored[name][:, ~picture], err_msg=name)
    gradient = frame.gradient[0].numpy()
    assert stored["gradient"][:, picture].any() and not gradient[:, picture].any()
    np.testing.assert_array_equal(gradient[:, ~picture], stored["gradient"][:, ~picture])
    for name in ("emission", "direct"):
        np.testing.assert_array_equal(frame.channel(name)[0], stored[name], err_msg=name)
    assert picture.mean() > 0.4 and (frame.mesh_id[0, 0].numpy()[picture] > meshes).all()


def test_what_is_seen_directly_is_no_history_of_the_same_surface_in_a_mirror(clip):
    frame = read_frame(clip, LAST, ("mesh_id",))
    poses, ids = frame.now.object_to_world[0], frame.mesh_id[0, 0].long()
    own, shown = (torch.from_numpy(np.int64(clip.read(name, LAST)[..., 0])) for name in ("mesh_id", "mirrored_mesh_id"))
    in_both = np.intersect1d(ids[(own == 1) & (shown > 0)], ids[own > 1])
    assert in_both.size == 0 and np.intersect1d(shown[own == 1], own[own > 1]).size > 0
    here = ids > 0
    torch.testing.assert_close(poses[ids[here] - 1], torch.from_numpy(clip.view(LAST).object_to_world)[shown[here] - 1])


def test_motion_to_any_frame_is_that_of_visible_surfaces(clip):
    np.testing.assert_allclose(clip.motion_to(LAST, LAST - 1), clip.read("mirrored_motion", LAST), atol=2e-2)
    assert not clip.motion_to(LAST, LAST).any()


def test_derived_motion_is_the_mirrors_own(clip, tmp_path):
    scene = room(SILVER)
    still = replace(scene, shapes=tuple(replace(shape, motion=scene.shapes[0].motion) for shape in scene.shapes))
    derived = clip_of(still, tmp_path)
    assert "derived" in derived.channels["motion"] and "file" in derived.channels["mirrored_motion"]
    mirror = ((clip.read("mesh_id", LAST) == 1) & (derived.read("mesh_id", LAST) == 1))[..., 0]
    np.testing.assert_allclose(derived.read("motion", LAST)[mirror], clip.read("motion", LAST)[mirror], atol=1e-3)
    assert np.abs(derived.read("motion", LAST) - derived.read("mirrored_motion", LAST)).max() > 0.5


def test_only_what_is_rendered_is_rendered_of_mirrors(tmp_path):
    reads = ("direct", "indirect", "direct_reference", "indirect_reference", "emission", "albedo", "depth", "mesh_id")
    few = clip_of(room(SILVER), tmp_path / "few", (*reads, "K", "camera_to_world", "object_to_world"))
    expected = {MIRRORED[name] for name in ("albedo", "depth", "mesh_id")}
    assert {name for name in few.channels if name in MIRRORED.values()} == expected
    scene = room(painted(0.5))
    none = clip_of(scene, tmp_path / "none")
    unseen = clip_of(replace(scene, shapes=(*scene.shapes, HAND_MIRROR)), tmp_path / "unseen")
    assert not set(MIRRORED.values()) & (none.channels.keys() | unseen.channels.keys())
    assert not [path.name for path in unseen.path.iterdir() if "mirrored" in path.name]


def assert_the_same_from_exr(clip: Clip, reads: tuple[str, ...], folder: Path) -> None:
    """Frames that are exported to `folder` are read as those of the clip are."""
    builder = OwnFrameBuilder(reads)
    for index in range(FRAMES):
        path = folder / f"{index}.exr"
        write_exr(path, clip, index)
        frame, _ = builder.build(ExrImage(path))
        expected = read_frame(clip, index, reads)
        assert frame.channels.keys() == expected.channels.keys()
        for name, tensor in expected.channels.items():
            assert torch.equal(frame.channels[name], tensor), name


def test_exported_frames_look_the_same(clip, tmp_path):
    assert_the_same_from_exr(clip, VISIBLE, tmp_path)
