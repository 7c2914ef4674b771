"""Cameras of a batch of frames, as tensors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.clip import WHOLE_IMAGE, ImageWindow
from scenes.camera import View


@dataclass(frozen=True)
class Cameras:
    """What projects the surfaces of a batch of frames; float64. See scenes.camera for the conventions."""

    K: Tensor  # (B, 3, 3)
    camera_to_world: Tensor  # (B, 4, 4)
    object_to_world: Tensor  # (B, M, 4, 4), entry mesh_id - 1: rigid transform from the rest pose

    @staticmethod
    def of(view: View, window: ImageWindow = WHOLE_IMAGE) -> "Cameras":
        """The cameras (B = 1) of an image that is cut to `window`."""
        K = view.K.copy()
        K[:2, 2] -= [window[1].start or 0, window[0].start or 0]
        return Cameras(*(torch.from_numpy(matrix)[None] for matrix in view._replace(K=K)))

    def map(self, function: Callable[[Tensor], Tensor]) -> "Cameras":
        return Cameras(*map(function, vars(self).values()))

    def almost_equal(self, other: "Cameras") -> bool:
        return all(
            a.shape == b.shape and torch.allclose(a, b, rtol=1e-9, atol=1e-12)
            for a, b in zip(vars(self).values(), vars(other).values(), strict=True)
        )

    @staticmethod
    def stack(cameras: Sequence["Cameras"]) -> "Cameras":
        """One batch of all `cameras`. Scenes with fewer meshes than others are padded with meshes at rest."""
        meshes = max(each.object_to_world.shape[1] for each in cameras)

        def padded(poses: Tensor) -> Tensor:
            batch, count = poses.shape[:2]
            rest = torch.eye(4, dtype=torch.float64).expand(batch, meshes - count, 4, 4)
            return torch.cat([poses, rest], dim=1)

        return Cameras(
            torch.cat([each.K for each in cameras]),
            torch.cat([each.camera_to_world for each in cameras]),
            torch.cat([padded(each.object_to_world) for each in cameras]),
        )
