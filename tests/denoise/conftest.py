"""Short sequences with ground truth, shared by the tests here."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from datasets.cameras import Cameras
from datasets.clip import Dataset
from datasets.frame import Frame, read_frame
from eval.bench.synthetic_frames import synthetic_frame

READS = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id", "motion", "dual_motion")


@pytest.fixture(scope="session")
def box(tiny: Path) -> list[Frame]:
    """A camera moves through the Cornell box, where nothing else does."""
    clip = next(clip for clip in Dataset(tiny).clips("test") if clip.scene == "cornell_box")
    return [read_frame(clip, index, READS) for index in range(5)]


@pytest.fixture(scope="session")
def spheres() -> list[Frame]:
    """A camera and spheres move under the sky."""
    return [synthetic_frame(index, 40, 56) for index in range(4)]


def as_foreign(frame: Frame) -> Frame:
    """A frame as a renderer gives it that separates neither meshes nor direct light."""
    surface = (frame.depth > 0).float()
    changed = {
        "direct": (frame.direct + frame.indirect) * surface,
        "indirect": torch.zeros_like(frame.indirect),
        "mesh_id": surface,
        "dual_motion": frame.motion,
    }
    still = torch.eye(4, dtype=torch.float64)[None, None]
    now, before = (Cameras(each.K, each.camera_to_world, still) for each in (frame.now, frame.previous))
    return replace(frame, channels=frame.channels | changed, now=now, previous=before)
