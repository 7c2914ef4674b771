"""Frames made by hand, and denoisers run over them."""

from collections.abc import Iterable
from dataclasses import replace

import torch
from torch import Tensor

from datasets.cameras import Cameras
from datasets.frame import Frame, Signal
from models import registry
from models.denoiser import Denoiser, State

FOCAL_LENGTH = 10.0  # px
MESHES = 9


def flat_frame(
    height: int,
    width: int,
    motion: tuple[float, float] = (0.0, 0.0),
    depth: float = 2.0,
    mesh_id: Tensor | None = None,
    irradiance: Tensor | None = None,
) -> Frame:
    """A white wall that faces the camera at `depth`; its picture shifts by `motion` as the camera slides along it.

    `irradiance` (1, 3, H, W), by default 1, is all direct; `mesh_id` (1, 1, H, W) is 1 by default.
    """
    K = torch.tensor([[-FOCAL_LENGTH, 0, width / 2], [0, -FOCAL_LENGTH, height / 2], [0, 0, 1.0]], dtype=torch.float64)
    now = torch.eye(4, dtype=torch.float64)[None]
    before = now.clone()
    # x_prev - x = motion: the camera's frame has x to the left and y up, and so does its slide.
    before[0, 0, 3] = depth * motion[0] / FOCAL_LENGTH
    before[0, 1, 3] = depth * motion[1] / FOCAL_LENGTH
    ones = torch.ones(1, 1, height, width)
    normal = torch.zeros(1, 3, height, width)
    normal[:, 2] = -1
    channels = {
        "direct": ones.repeat(1, 3, 1, 1) if irradiance is None else irradiance,
        "indirect": torch.zeros(1, 3, height, width),
        "emission": torch.zeros(1, 3, height, width),
        "albedo": torch.ones(1, 3, height, width),
        "normal": normal,
        "depth": depth * ones,
        "roughness": ones,
        "mesh_id": ones if mesh_id is None else mesh_id.float(),
        "motion": torch.tensor(motion)[None, :, None, None].expand(1, 2, height, width).contiguous(),
    }
    channels["dual_motion"] = channels["motion"].clone()  # nothing is hidden
    channels["shadow_motion"] = channels["reflection_motion"] = channels["motion"]
    channels["gradient"] = torch.zeros(1, 2, height, width)  # and light does not change
    channels["hit_distance"] = torch.tensor([1.0, 0.5])[None, :, None, None].expand(1, 2, height, width).contiguous()
    channels["light_distance"] = 2 * ones
    channels["light_angle"] = 0.2 * ones
    bodies = torch.eye(4, dtype=torch.float64).expand(1, MESHES, 4, 4)
    return Frame(channels, Cameras(K[None], now, bodies), Cameras(K[None], before, bodies), "test")


def chain(frames: list[Frame]) -> list[Frame]:
    """The frames as a sequence: each one's previous camera is moved to where the frame before it has its own."""
    chained = frames[:1]
    for frame in frames[1:]:
        last = chained[-1].now
        step = frame.previous.camera_to_world.inverse() @ frame.now.camera_to_world
        now = replace(frame.now, camera_to_world=last.camera_to_world @ step)
        chained.append(replace(frame, now=now, previous=replace(last, K=frame.previous.K)))
    return chained


def prepared(name: str, signal: Signal | None = None) -> Denoiser:
    """A denoiser in the form for inference, with the same random weights every time."""
    torch.manual_seed(0)
    denoiser = registry.create(name, signal)
    denoiser.prepare()
    return denoiser


@torch.no_grad()
def play(denoiser: Denoiser, frames: Iterable[Frame]) -> tuple[list[Tensor], State | None]:
    """The denoised frames of a sequence, (B, 3, H, W) each, and the state after the last one."""
    outputs: list[Tensor] = []
    state: State | None = None
    for frame in frames:
        output, state = denoiser(frame, state)
        outputs.append(output)
    return outputs, state


def run(denoiser: Denoiser, frames: Iterable[Frame]) -> list[Tensor]:
    """The denoised frames of a sequence, (B, 3, H, W) each."""
    return play(denoiser, frames)[0]
