"""Training sequences: deterministic, and consistent under every augmentation."""

from copy import copy
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from datasets.cameras import Cameras
from datasets.channels import CHANNELS, HIT_CHANNELS, USUAL_CHANNELS
from datasets.clip import Clip, Dataset
from datasets.frame import Frame, read_frame
from errors import BadInput
from models.history.running_scale import running_scale
from models.registry import create
from train import sequences as module
from train.augmentation import Augmentation, LightEdge, averaged, rotated
from train.sequences import TrainingSequences, WholeFrames

FORWARD_ALONE = tuple(name for name, channel in CHANNELS.items() if channel.is_temporal and name != "motion")
IMAGE_CHANNELS = tuple(name for name in USUAL_CHANNELS if CHANNELS[name].is_image and name not in FORWARD_ALONE)
AUGMENTATIONS = {
    "none": Augmentation(),
    "reverse": Augmentation(reverse=True),
    "stop": Augmentation(stop=True),
    "rotate": Augmentation(rotate=True),
    "all": Augmentation(reverse=True, stop=True, rotate=True, gain=True),
}


def sequences(clips, augmentation=AUGMENTATIONS["none"], crop=32, length=5, seed=0) -> TrainingSequences:
    return TrainingSequences(clips, IMAGE_CHANNELS, length, crop, augmentation, seed)


def pixel_positions(frame: Frame) -> torch.Tensor:
    """Centres (2, H, W) of all pixels, (x, y)."""
    height, width = frame.size
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y]).double()


def surface(frame: Frame, cameras: Cameras) -> torch.Tensor:
    """World points (3, N) of all pixels by the inverse of K, in homogeneous coordinates."""
    pixels = pixel_positions(frame).flatten(1)
    depth = frame.depth[0, 0].flatten().double()
    local = torch.linalg.inv(cameras.K[0]) @ torch.cat([pixels, torch.ones_like(pixels[:1])]) * depth
    return (cameras.camera_to_world[0] @ torch.cat([local, torch.ones_like(local[:1])]))[:3]


def projected(points: torch.Tensor, cameras: Cameras) -> torch.Tensor:
    """Pixel positions (2, N) of world points (3, N)."""
    local = torch.linalg.inv(cameras.camera_to_world[0]) @ torch.cat([points, torch.ones_like(points[:1])])
    homogeneous = cameras.K[0] @ local[:3]
    return homogeneous[:2] / homogeneous[2:]


def carried_back(frame: Frame) -> tuple[torch.Tensor, torch.Tensor]:
    """World points (3, N) of all pixels, carried by their meshes to the previous frame, and the rotations (N, 3, 3)."""
    mesh = frame.mesh_id[0, 0].long().flatten()
    relative = frame.previous.object_to_world[0] @ torch.linalg.inv(frame.now.object_to_world[0])
    relative = torch.cat([torch.eye(4, dtype=torch.float64)[None], relative])[mesh]
    points = torch.einsum("nij,jn->in", relative[:, :3, :3], surface(frame, frame.now)) + relative[:, :3, 3].T
    return points, relative[:, :3, :3]


@pytest.mark.parametrize("kind", AUGMENTATIONS)
def test_augmented_motion_cameras_and_images_agree(clips, kind):
    """Every surface point lands where the augmented motion vector points, on a pixel that shows the same surface."""
    moved = 0
    compared = 0
    for index in range(8):
        frames = sequences(clips, AUGMENTATIONS[kind])[index]
        for frame in frames:
            expected = projected(carried_back(frame)[0], frame.previous)
            target = (pixel_positions(frame) + frame.motion[0]).flatten(1)
            hit = (frame.mesh_id[0, 0].flatten() > 0) & (target.abs().amax(dim=0) < 1e4)
            assert (target - expected)[:, hit].abs().max() < 0.01
            moved += bool(frame.motion.abs().max() > 0.1)
        compared += sum(len(assert_alike_along_motion(*pair)) for pair in pairwise(frames))
    assert moved > 13 and compared > 10_000


def assert_alike_along_motion(before: Frame, frame: Frame) -> torch.Tensor:
    """Visible pixels, looked up in the frame before, have the same mesh, albedo and normal, nearly the same light.

    Returns their indices.
    """
    x, y = (pixel_positions(frame) + frame.motion[0]).floor().long().flatten(1)
    points, rotations = carried_back(frame)
    world_to_camera = torch.linalg.inv(frame.previous.camera_to_world[0])
    depth = world_to_camera[2, :3] @ points + world_to_camera[2, 3]
    now = ((frame.mesh_id[0, 0].flatten() > 0) & (x >= 0) & (x < 32) & (y >= 0) & (y < 32)).nonzero()[:, 0]
    now = now[(before.depth[0, 0, y[now], x[now]] / depth[now] - 1).abs() < 0.01]
    then = y[now] * 32 + x[now]
    new, old = (
        {name: f.channels[name][0].flatten(-2)[..., where] for name in IMAGE_CHANNELS}
        for f, where in ((frame, now), (before, then))
    )
    assert (new["mesh_id"] == old["mesh_id"]).float().mean() > 0.97
    assert ((new["albedo"] - old["albedo"]).abs().amax(dim=0) < 0.01).float().mean() > 0.97
    turned = torch.einsum("nij,jn->in", rotations[now].float(), new["normal"])
    assert ((turned * old["normal"]).sum(dim=0) > 0.99).float().mean() > 0.97
    light, light_before = (f["direct_reference"].mean(dim=(0, 1)) for f in (new, old))
    assert ((light - light_before).abs() / (light + light_before + 1e-6)).median() < 0.1
    return now


def test_rotation_turns_images_normals_and_cameras_alike(clips):
    frame = read_frame(clips[1], 4, IMAGE_CHANNELS, window=(slice(8, 40), slice(20, 52)))
    turned = rotated(frame)
    for name in set(IMAGE_CHANNELS) - {"motion"}:
        images = [f.channels[name].numpy() for f in (turned, frame)]
        np.testing.assert_array_equal(images[0], np.rot90(images[1], axes=(-2, -1)), name)
    # The same world points, only at other pixels.
    points, same = (surface(f, f.now).reshape(3, 32, 32) for f in (frame, turned))
    torch.testing.assert_close(same, torch.rot90(points, dims=(1, 2)))
    # A view-space normal that pointed right points up after a counter-clockwise turn.
    before = torch.rot90(frame.view_normal()[0], dims=(1, 2))
    after = turned.view_normal()[0]
    torch.testing.assert_close(after, torch.stack([-before[1], before[0], before[2]]), atol=2e-3, rtol=0)
    assert (before[2][rotated(frame).mesh_id[0, 0] > 0] > -0.01).all()  # toward the viewer
    full_turn = frame
    for _ in range(4):
        full_turn = rotated(full_turn)
    for name in IMAGE_CHANNELS:
        torch.testing.assert_close(full_turn.channels[name], frame.channels[name], rtol=0, atol=0)
    torch.testing.assert_close(full_turn.now.K, frame.now.K)
    torch.testing.assert_close(full_turn.now.camera_to_world, frame.now.camera_to_world)


def are_equal(a: Frame, b: Frame) -> bool:
    cameras = [(getattr(a, when), getattr(b, when)) for when in ("now", "previous")]
    return (
        all(torch.equal(a.channels[name], b.channels[name]) for name in IMAGE_CHANNELS)
        and all(torch.equal(vars(x)[key], vars(y)[key]) for x, y in cameras for key in vars(x))
        and torch.equal(a.gain, b.gain)
    )


def test_an_item_depends_on_seed_epoch_and_index_only(clips):
    a = sequences(clips, AUGMENTATIONS["all"])
    b = sequences(clips, AUGMENTATIONS["all"])
    for epoch in (3, 0):
        a.epoch = epoch
        b.epoch = epoch
        a[5]  # reading another item in between changes nothing
        for x, y in zip(a[2], b[2], strict=True):
            assert are_equal(x, y)
    first = a[0][0].direct
    a.epoch = 1
    assert not torch.equal(first, a[0][0].direct)
    assert not torch.equal(first, sequences(clips, AUGMENTATIONS["all"], seed=1)[0][0].direct)


def test_a_stopped_camera_repeats_everything_but_the_noise(clips):
    stopped = 0
    for index in range(40):
        frames = sequences(clips, AUGMENTATIONS["stop"])[index]
        for before, frame in pairwise(frames):
            if torch.equal(before.depth, frame.depth):
                stopped += 1
                assert (frame.motion == 0).all()
                torch.testing.assert_close(frame.now.camera_to_world, frame.previous.camera_to_world)
                assert torch.equal(before.direct_reference, frame.direct_reference)
                assert not torch.equal(before.direct, frame.direct)
    assert stopped > 5


def test_reversed_playback_uses_forward_vectors(clips):
    """Played backward, the vector of frame i points to where the surface stands in frame i + 1."""
    cameras = {clip.view(i).camera_to_world.tobytes(): i for clip in clips for i in range(clip.frames)}
    directions = set()
    for index in range(20):
        frames = sequences(clips, AUGMENTATIONS["reverse"])[index]
        order = [cameras[frame.now.camera_to_world[0].numpy().tobytes()] for frame in frames]
        steps = set(np.diff(order))
        assert len(steps) == 1
        directions |= steps
        for before, frame in pairwise(frames):
            torch.testing.assert_close(frame.previous.camera_to_world, before.now.camera_to_world)
    assert directions == {1, -1}
    clip = clips[1]
    forward = read_frame(clip, 3, ("motion",), previous=4).motion
    backward = read_frame(clip, 3, ("motion",)).motion
    assert (forward + backward).abs().max() > 0.005  # computed, not negated


@pytest.mark.parametrize("name", FORWARD_ALONE)
def test_channels_that_only_the_renderer_computes_refuse_reversed_playback(tiny, name):
    clip = Dataset(tiny).clips("test")[1]
    with pytest.raises(BadInput, match=f"'{name}' exists for forward playback only"):
        read_frame(clip, 3, (name,), previous=4)
    assert (read_frame(clip, 3, (name,), previous=3).channels[name] == 0).all()
    assert (read_frame(clip, 3, (name,)).channels[name] != 0).any()


def test_gains_are_random_per_sequence_and_exposures_do_not_change_colours(clips):
    gains = []
    for index in range(30):
        frames = sequences(clips, AUGMENTATIONS["all"])[index]
        assert all(torch.equal(frame.gain, frames[0].gain) for frame in frames)
        gains.append(frames[0].gain.flatten())
    gains = torch.stack(gains)
    assert (gains >= 0).all() and (gains <= 2).all() and 0.8 < gains.mean() < 1.2
    assert (sequences(clips)[0][0].gain == 1).all()
    gains = torch.cat([sequences(clips, Augmentation(exposure=True))[index][0].gain for index in range(20)]).flatten(1)
    assert torch.equal(gains[:, 0], gains[:, 1]) and torch.equal(gains[:, 0], gains[:, 2])
    assert 2**-1.5 <= gains.min() < 0.8 and 1.3 < gains.max() <= 2**1.5


def test_batches_stack_sequences_and_pad_meshes(clips):
    data = sequences(clips)
    batch = data.batch([0, 1])
    assert len(batch.frames) == 5 and batch.frames[0].direct.shape == (2, 3, 32, 32)
    assert batch.frames[0].direct_reference.shape == (2, 2, 3, 32, 32)
    torch.testing.assert_close(batch.frames[2].albedo[1:], data[1][2].albedo)
    small = data[0][0]
    large = data[1][0]
    fewer = replace(small.now, object_to_world=small.now.object_to_world[:, :3])
    mixed = Frame.stack([replace(small, now=fewer, previous=fewer), large])
    meshes = large.now.object_to_world.shape[1]
    assert mixed.now.object_to_world.shape == (2, meshes, 4, 4)
    assert torch.equal(mixed.now.object_to_world[0, 3:], torch.eye(4).double().expand(meshes - 3, 4, 4))


def test_too_short_or_small_clips_are_refused(clips):
    with pytest.raises(BadInput, match="smaller budget"):
        sequences(clips, length=9)
    with pytest.raises(BadInput, match="smaller budget"):
        sequences(clips, crop=65)


def test_first_frames_come_from_all_clips_even_from_those_too_short_for_sequences(clips):
    short = copy(clips[0])
    short.frames = 1
    given = IMAGE_CHANNELS, 5, 32, AUGMENTATIONS["none"], 0
    data = TrainingSequences([short, clips[1]], *given, firsts=8)
    firsts = data.batch([0, 1]).firsts
    assert firsts is not None and firsts.direct.shape == (16, 3, 32, 32)
    assert torch.equal(firsts.direct, Frame.stack([*data.first_frames(0), *data.first_frames(1)]).direct)
    assert len({float(image.sum()) for image in firsts.direct}) == 16  # of other places and times
    assert len(data) == len(TrainingSequences([clips[1]], *given))  # an epoch has the sequences of long clips
    assert TrainingSequences([clips[1]], *given).batch([0]).firsts is None
    with pytest.raises(BadInput, match="has 1 frames"):
        TrainingSequences([short], *given, firsts=3)


def test_demodulation_round_trip_and_unread_channels(clips):
    frame = read_frame(clips[0], 2, ("direct", "indirect", "emission", "albedo", "depth"))
    total = frame.remodulate(frame.irradiance("total"), "total")
    torch.testing.assert_close(total, frame.radiance("total"), rtol=1e-6, atol=0)
    torch.testing.assert_close(
        frame.remodulate(frame.irradiance("indirect"), "indirect"), frame.indirect, rtol=1e-6, atol=0
    )
    with pytest.raises(BadInput, match="'normal' was not loaded"):
        frame.view_normal()
    assert not hasattr(frame, "no_channel")


def test_sequences_of_several_samples_are_means_of_realisations(clips):
    """Each frame names its samples, and is the mean of as many realisations of it."""
    counts = set()
    for index in range(24):
        plain, several = (
            TrainingSequences(clips, ("direct", "indirect"), 3, 32, augmentation, seed=0)[index]
            for augmentation in (Augmentation(), Augmentation(samples=True))
        )
        for single, mean in zip(plain, several, strict=True):
            count = int(mean.samples.item())
            counts.add(count)
            if count == 1:
                assert torch.equal(single.direct, mean.direct)
            torch.testing.assert_close(single.direct_reference, mean.direct_reference)
        assert len({frame.samples.item() for frame in several}) == 1
    assert counts == {1, 2}  # there are two realisations


def test_means_of_frames_keep_everything_but_the_noise(clips):
    frames = [read_frame(clips[0], 3, IMAGE_CHANNELS, realisation) for realisation in (0, 1)]
    mean = averaged(frames)
    assert mean.samples.item() == 2 * frames[0].samples.item()
    for name in frames[0].channels:
        if name in ("direct", "indirect"):
            torch.testing.assert_close(mean.channels[name], (frames[0].channels[name] + frames[1].channels[name]) / 2)
        elif name in HIT_CHANNELS:  # of those that met anything
            both = np.ma.masked_equal([frame.channels[name].numpy() for frame in frames], 0)
            np.testing.assert_allclose(mean.channels[name], both.mean(axis=0).filled(0), rtol=1e-6)
        else:
            assert torch.equal(mean.channels[name], frames[0].channels[name])


def test_a_change_of_light_changes_noise_and_references_alike(clips):
    """All else stays, and what light is multiplied by is the same number for all of it."""
    changed = 0
    for index in range(20):
        for plain, lit in zip(
            *(sequences(clips, each)[index] for each in (Augmentation(), Augmentation(light=True))), strict=True
        ):
            light = (lit.direct_reference.sum(dim=(1, 2)) / plain.direct_reference.sum(dim=(1, 2)).clamp(min=1e-9))[0]
            changed += bool((light[plain.direct_reference.sum(dim=(1, 2))[0] > 0] - 1).abs().max() > 0.01)
            for name in plain.channels:
                if name in ("direct", "indirect", "direct_reference", "indirect_reference"):
                    where = plain.direct_reference.sum(dim=(1, 2))[0] > 1e-3
                    expected = plain.channels[name] * light
                    torch.testing.assert_close(lit.channels[name][..., where], expected[..., where])
                else:
                    assert torch.equal(lit.channels[name], plain.channels[name])
    assert 10 < changed < 60


# --- The scale of whole frames ---

Played = tuple[Clip, int, int]


class Recorded(WholeFrames):
    """Notes which frames and realisations were measured."""

    def __init__(self, signal):
        super().__init__(signal)
        self.requests: list[Played] = []

    def __call__(self, clip, index, realisations):
        self.requests.append((clip, index, *realisations))
        return super().__call__(clip, index, realisations)


@pytest.mark.parametrize("name, reverse", [("rae", True), ("ntd", False)])
@torch.no_grad()
def test_crops_get_the_scale_of_their_whole_frames(clips, name, reverse):
    """Played backward, with a camera that stops and with gains; without their scale the crop's own is another."""
    denoiser = create(name)
    measure = Recorded(denoiser.signal)
    augmentation = Augmentation(reverse=reverse, stop=True, gain=True)
    data = TrainingSequences(clips, denoiser.reads, 4, 32, augmentation, 0)
    data.whole_frames = measure
    unlike = 0
    for index in range(6):
        measure.requests.clear()
        crops = data[index]
        cropped = None
        whole = None
        last = measure.requests[0][1]
        for crop, (clip, position, realisation) in zip(crops, measure.requests, strict=True):
            frame = read_frame(clip, position, denoiser.reads, realisation, previous=last)
            windows = frame.indirect.unfold(2, 32, 1).unfold(3, 32, 1)  # one of which is the crop
            assert (windows == crop.indirect[:, :, None, None]).all(dim=-1).all(dim=-1).all(dim=1).any()
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
    first = measure(clips[0], 3, [1])
    other = [measure(*requests) for requests in ((clips[0], 3, [0]), (clips[0], 4, [1]), (clips[1], 3, [1]))]
    assert not any(torch.equal(first, each) for each in other)
    monkeypatch.setattr(module, "read_frame", lambda *_: pytest.fail("measured again"))
    assert torch.equal(measure(clips[0], 3, [1]), first)
    assert first[0, 0] != measure(clips[0], 3, [0, 1])[0, 0] > min(first[0, 0], other[0][0, 0])


def test_the_scale_of_a_mean_is_that_of_the_frame_that_it_makes(clips):
    frames = [read_frame(clips[0], 3, ("direct", "indirect", "albedo", "depth"), each) for each in (0, 1)]
    mean = averaged(frames)
    scale = running_scale(mean.irradiance("total") * mean.divisor, mean.depth, None)
    found = WholeFrames("total")(clips[0], 3, [0, 1])
    torch.testing.assert_close(found[0], torch.cat([scale.log_luminance.value, scale.log_depth.value]))
    data = TrainingSequences(clips, IMAGE_CHANNELS, 2, 64, Augmentation(samples=True), 0, "total")
    for frame in (frame for index in range(12) for frame in data[index]):  # a crop is all of the frame
        scale = running_scale(frame.irradiance("total") * frame.divisor, frame.depth, None)
        torch.testing.assert_close(frame.whole[0, :1], scale.log_luminance.value)


def test_the_scale_of_whole_frames_survives_batches(clips):
    data = TrainingSequences(clips, ("indirect", "depth"), 2, 32, Augmentation(), 0, "indirect")
    batch = data.batch([0, 1]).to("cpu")
    assert torch.equal(batch.frames[1].whole, torch.cat([data[0][1].whole, data[1][1].whole]))
    assert batch.frames[0].whole.shape == (2, 2)


# --- Edges of light ---


@given(st.integers(0, 2**32 - 1), st.integers(0, 11))
def test_light_lies_between_one_and_the_factor(seed, frame):
    edge = LightEdge.random(np.random.default_rng(seed), 12)
    light = edge.light(frame, 20, 30)
    assert light.shape == (20, 30) and light.dtype == torch.float32
    assert (light >= min(1, edge.factor) - 1e-6).all() and (light <= max(1, edge.factor) + 1e-6).all()


def test_an_edge_arrives_passes_the_middle_and_is_gone():
    edge = LightEdge(factor=0.25, angle=np.pi / 2, speed=4.0, passes=5.0, softness=0.1)
    before, middle, after = (edge.light(frame, 21, 9) for frame in (0, 5, 10))
    assert torch.allclose(before, torch.ones(21, 9), atol=1e-6)
    assert torch.allclose(after, torch.full((21, 9), 0.25), atol=1e-6)
    assert (
        torch.allclose(middle[10], torch.full((9,), 0.625)) and (middle[:10] < 0.3).all() and (middle[11:] > 0.9).all()
    )


def test_it_moves_along_its_angle():
    edge = LightEdge(factor=3.0, angle=0.0, speed=2.0, passes=2.0, softness=0.2)
    first, second = (edge.light(frame, 5, 41) for frame in (2, 3))
    assert torch.allclose(first[:, :-2], second[:, 2:], atol=1e-5)
