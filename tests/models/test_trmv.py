"""TRMV: history follows the cause of light, and is SVGF's where only the camera moves."""

import pytest
import torch
from torch import Tensor

from datasets.frame import Frame
from eval.bench.synthetic_frames import synthetic_frame
from models import registry
from models.filters.trmv import mean_offset, reliable_vectors
from tests.helpers.frames import chain, flat_frame, run

SIZE = 36


def stripes(frame: int) -> Tensor:
    """Stripes of light and shadow (1, 3, H, W), 9 px wide, on a flat wall; they move right by 2 px per frame."""
    x = torch.arange(SIZE) - 2 * frame
    return torch.where(x % 18 < 9, 1.0, 0.1).expand(1, 3, SIZE, SIZE).contiguous()


def vectors(dx: float, dy: float = 0.0) -> Tensor:
    return torch.tensor([dx, dy])[None, :, None, None].repeat(1, 1, SIZE, SIZE)


def error(name: str, frames: list[Frame]) -> float:
    """Of the last frame, away from the borders."""
    output = run(registry.create(name), frames)[-1]
    return (output - stripes(len(frames) - 1))[..., 4:-4, 14:-4].abs().mean().item()


@pytest.mark.parametrize("cause", ["shadow", "reflection"])
def test_moving_shadows_and_reflections_do_not_lag(cause):
    """A quarter of the samples report that shadows move."""
    generator = torch.Generator().manual_seed(0)
    frames = []
    for index in range(6):
        shaded = torch.rand(1, 1, SIZE, SIZE, generator=generator) < 0.25
        causes = {
            "shadow": {"shadow_motion": torch.where(shaded, vectors(-2), 0)},
            "reflection": {"roughness": torch.full((1, 1, SIZE, SIZE), 0.1), "reflection_motion": vectors(-2)},
        }
        frames.append(flat_frame(SIZE, SIZE, irradiance=stripes(index)).with_channels(causes[cause]))
    assert error("trmv", chain(frames)) < 0.2 * error("svgf", chain(frames))


def test_without_moving_causes_it_is_svgf():
    frames = [synthetic_frame(index, 40, 60) for index in range(4)]
    frames = [frame.with_channels({"dual_motion": frame.motion}) for frame in frames]
    ours, theirs = (run(registry.create(name), frames) for name in ("trmv", "svgf"))
    torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_offsets_are_means_over_the_same_mesh():
    mesh = torch.ones(1, 1, SIZE, SIZE)
    mesh[..., 20:] = 2
    motion = vectors(1, 0)
    offset = torch.zeros(1, 2, SIZE, SIZE)
    offset[:, :, 10, 10] = torch.tensor([3.0, -1])
    offset[:, :, 12, 12] = torch.tensor([5.0, 1])
    offset[:, :, 10, 22] = 100
    frame = flat_frame(SIZE, SIZE, mesh_id=mesh).with_channels({"motion": motion})
    mean, share = mean_offset(motion + offset, frame)
    torch.testing.assert_close(mean[0, :, 11, 11], torch.tensor([4.0, 0]))
    torch.testing.assert_close(share[0, 0, 11, 11], torch.tensor(2 / 81))
    torch.testing.assert_close(mean[0, :, 10, 18], torch.tensor([0.0, 0]))  # beside another mesh
    torch.testing.assert_close(share[0, 0, 10, 22], torch.tensor(1 / 54))  # 9 rows of two threes of columns


def test_each_kind_of_light_has_its_vectors():
    motion = {"dual_motion": vectors(1), "shadow_motion": vectors(2), "reflection_motion": vectors(3)}
    frame = flat_frame(SIZE, SIZE).with_channels(motion)

    def vectors_for(**channels: Tensor) -> list[float]:
        direct, indirect = reliable_vectors(frame.with_channels(channels))
        return [direct[0, 0, 18, 18].item(), indirect[0, 0, 18, 18].item()]

    smooth = torch.full((1, 1, SIZE, SIZE), 0.1)
    few = torch.zeros(1, 2, SIZE, SIZE)
    few[..., ::4, ::4] = 2.0
    assert vectors_for() == [2, 1]
    assert vectors_for(roughness=smooth) == [3, 3]
    assert vectors_for(roughness=smooth, reflection_motion=few) == [2, 1]  # plastic
    assert vectors_for(shadow_motion=few) == [1, 1]
