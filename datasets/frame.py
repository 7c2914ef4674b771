"""The Frame: the one type that goes from data sets to denoisers and metrics."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from datasets.channels import (
    ALBEDO_FLOOR,
    CAMERA_CHANNELS,
    CHANNELS,
    HIT_CHANNELS,
    MOTION_CHANNELS,
    NOISY_CHANNELS,
    SAMPLE_BUFFERS,
)
from datasets.clip import WHOLE_IMAGE, Clip, ImageWindow
from errors import BadInput
from scenes.camera import View

Signal = Literal["total", "indirect"]
LARGEST = 1e35  # whose sum with another, divided by the smallest albedo, is still finite in float32


def disoccluded(motion: Tensor, dual_motion: Tensor) -> Tensor:
    """Whether what a pixel shows was hidden in the previous frame: (B, 1, H, W) of bool.

    Both vectors (B, 2, H, W), in pixels, are equal where the surface was visible (Zeng et al. 2021, §3.2), up to the
    rounding that 1/64 px allows for.
    """
    return (dual_motion - motion).abs().amax(dim=1, keepdim=True) > 1 / 64


def mean_where_met(met: Tensor) -> Tensor:
    """The mean along the first axis of what samples met, of those that met anything: that are not 0."""
    return met.sum(dim=0) / (met > 0).sum(dim=0).clamp(min=1)


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
        return Cameras(
            torch.from_numpy(K)[None],
            torch.from_numpy(view.camera_to_world)[None],
            torch.from_numpy(view.object_to_world)[None],
        )

    def map(self, function: Callable[[Tensor], Tensor]) -> "Cameras":
        """The cameras with `function` of every matrix."""
        return Cameras(function(self.K), function(self.camera_to_world), function(self.object_to_world))

    def rot90(self, width: int) -> "Cameras":
        """The cameras that see the image turned by 90° counter-clockwise: rolled about the viewing axis.

        A position (x, y) of the image, `width` pixels wide, becomes (y, width - x).
        """
        roll = torch.eye(4, dtype=torch.float64)
        roll[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]], dtype=torch.float64)
        return replace(self, K=turn @ self.K @ roll[:3, :3], camera_to_world=self.camera_to_world @ roll)

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


@dataclass(frozen=True)
class Moment:
    """What identifies a frame among those of a sequence: its size (B, H, W) and cameras."""

    shape: tuple[int, int, int]
    cameras: Cameras


@dataclass(frozen=True)
class Frame:
    """One frame of one noise realisation: tensors (B, C, H, W), float32, as attributes named like the channels.

    Channels with halves, such as `direct_reference`, are (B, 2, 3, H, W). Using a channel that was not read raises
    BadInput.
    Units and ranges are those of the data set (docs/format.md). `gain` belongs to training augmentation (RAE §4.3):
    networks multiply their exposure by it, while radiance stays as rendered. `whole` belongs to training crops: what
    models.history.running_scale measures in the whole frame, (B, 2); None where this is the whole frame. `spp` are the
    samples a pixel of the noisy channels; None where that is not known.
    """

    channels: dict[str, Tensor]
    now: Cameras
    previous: Cameras  # of the frame that motion vectors lead to
    gain: Tensor  # (B, 3, 1, 1)
    source: str = ""  # names the clip in messages
    whole: Tensor | None = None
    spp: Tensor | None = None  # (B, 1, 1, 1)

    def __getattr__(self, name: str) -> Tensor:
        if name not in CHANNELS:
            raise AttributeError(name)
        if name not in self.channels:
            raise BadInput(f"{self.source}: the channel '{name}' was not loaded for this frame")
        return self.channels[name]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        height, width = next(iter(self.channels.values())).shape[-2:]
        return height, width

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        return (len(self.gain), *self.size)

    @property
    def moment(self) -> Moment:
        """What identifies this frame among those of its sequence."""
        return Moment(self.shape, self.now)

    def follows(self, moment: Moment) -> bool:
        """Whether this frame comes right after `moment`: it has the same size and its previous cameras are those.

        So a cut needs no flag: the first frame of another shot names other previous cameras. Between two still shots
        from the same place neither camera nor meshes differ, and a cut goes unnoticed: pass None as the state there.
        """
        return moment.shape == self.shape and all(
            a.shape == b.shape and torch.allclose(a, b, rtol=1e-9, atol=1e-12)
            for a, b in zip(vars(self.previous).values(), vars(moment.cameras).values(), strict=True)
        )

    @property
    def samples(self) -> Tensor:
        """Samples a pixel of the noisy channels, (B, 1, 1, 1); 1 where that is not known."""
        return torch.ones_like(self.gain[:, :1]) if self.spp is None else self.spp

    @property
    def divisor(self) -> Tensor:
        """What demodulation divides by: max(albedo, 0.01), (B, 3, H, W)."""
        return self.albedo.clamp(min=ALBEDO_FLOOR)

    @cached_property
    def surface(self) -> Tensor | None:
        """1 where a pixel shows a surface and 0 for background, (B, 1, H, W); None where all show one."""
        return None if self.depth.amin() > 0 else (self.depth > 0).to(self.depth)

    def finite(self) -> "Frame":
        """The frame with 0 instead of NaN and infinities in all channels: one bad pixel must not poison a filter.

        What is so large that demodulation would make it infinite is cut. The sum of a channel tells whether it has any
        such number, at a fraction of the cost of looking at every pixel.
        """
        bad = [name for name, tensor in self.channels.items() if not tensor.sum().abs() < LARGEST]
        mended = {
            name: torch.nan_to_num(self.channels[name], nan=0.0, posinf=0.0, neginf=0.0).clamp(-LARGEST, LARGEST)
            for name in bad
        }
        return replace(self, channels=self.channels | mended) if bad else self

    def with_more_samples(self, others: Sequence["Frame"]) -> "Frame":
        """The frame with the means over itself and `others`, further realisations of it, of noise and what it met."""
        frames = [self, *others]

        def stacked(name: str) -> Tensor:
            return torch.stack([frame.channels[name] for frame in frames])

        means = {name: stacked(name).mean(dim=0) for name in self.channels.keys() & set(NOISY_CHANNELS)}
        means |= {name: mean_where_met(stacked(name)) for name in self.channels.keys() & set(HIT_CHANNELS)}
        return replace(self, channels=self.channels | means, spp=len(frames) * self.samples)

    @property
    def has_buffers(self) -> bool:
        """Whether the samples of the noisy channels are known in two independent halves."""
        return self.channels.keys() & set(SAMPLE_BUFFERS.values()) != set()

    def buffer(self, which: int) -> "Frame":
        """The frame with half of its samples alone: those of half 0 or 1."""
        known = {name: halves for name, halves in SAMPLE_BUFFERS.items() if {name, halves} <= self.channels.keys()}
        noisy = {name: self.channels[halves][:, which] for name, halves in known.items()}
        others = {name: tensor for name, tensor in self.channels.items() if name not in SAMPLE_BUFFERS.values()}
        return replace(self, channels=others | noisy, spp=self.samples / 2)

    def lit(self, light: Tensor) -> "Frame":
        """The frame with all light but emission, noisy and in references, times `light` (H, W)."""
        lit = {name: tensor * light for name, tensor in self.channels.items() if CHANNELS[name].is_reflected}
        return replace(self, channels=self.channels | lit)

    def map(self, function: Callable[[Tensor], Tensor]) -> "Frame":
        """The frame with `function` of every channel; cameras and gain stay."""
        return replace(self, channels={name: function(tensor) for name, tensor in self.channels.items()})

    def radiance(self, signal: Signal) -> Tensor:
        """Noisy radiance (B, 3, H, W): emission + direct + indirect, or indirect alone."""
        return self.indirect if signal == "indirect" else self.emission + self.direct + self.indirect

    def irradiance(self, signal: Signal) -> Tensor:
        """Noisy irradiance (B, 3, H, W): radiance without emission, divided by the albedo."""
        reflected = self.indirect if signal == "indirect" else self.direct + self.indirect
        return reflected / self.divisor

    def reference_buffers(self, signal: Signal) -> Tensor:
        """Radiance without emission (B, 2, 3, H, W) of both halves of the reference, whose noise is independent."""
        return self.indirect_reference if signal == "indirect" else self.direct_reference + self.indirect_reference

    def reference_irradiance(self, signal: Signal) -> Tensor:
        """Irradiance (B, 3, H, W) of the reference, the mean of its halves."""
        return self.reference_buffers(signal).mean(dim=1) / self.divisor

    def remodulate(self, irradiance: Tensor, signal: Signal) -> Tensor:
        """Radiance (B, 3, H, W) of denoised irradiance: times `divisor`, see `complete`."""
        return self.complete(irradiance * self.divisor, signal)

    def complete(self, reflected: Tensor, signal: Signal) -> Tensor:
        """Radiance (B, 3, H, W) of what was denoised: background reflects nothing; "total" has noise-free emission."""
        surface = self.surface
        if surface is not None:
            reflected = torch.where(surface > 0, reflected, 0)
        return reflected + self.emission if signal == "total" else reflected

    @property
    def to_view(self) -> Tensor:
        """From world space to view space, (B, 3, 3): x right, y up, z toward the viewer."""
        flip = torch.tensor([-1.0, 1.0, -1.0])  # Mitsuba's camera looks along +z with x to the left
        return flip.to(self.normal)[:, None] * self.now.camera_to_world[:, :3, :3].mT.to(self.normal)

    def view_normal(self) -> Tensor:
        """Shading normals (B, 3, H, W) in view space."""
        return torch.einsum("bji,bihw->bjhw", self.to_view, self.normal)

    def rot90(self) -> "Frame":
        """The frame turned by 90° counter-clockwise: images, motion vectors and cameras alike."""
        width = self.size[1]
        channels = {name: torch.rot90(tensor, dims=(-2, -1)) for name, tensor in self.channels.items()}
        for name in channels.keys() & set(MOTION_CHANNELS):
            dx, dy = channels[name].unbind(dim=1)
            channels[name] = torch.stack([dy, -dx], dim=1)
        return replace(self, channels=channels, now=self.now.rot90(width), previous=self.previous.rot90(width))

    def to(self, device: torch.device | str) -> "Frame":
        """The frame with all tensors on `device`."""
        if self.gain.device == torch.device(device):
            return self

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device)

        whole, spp = (None if tensor is None else move(tensor) for tensor in (self.whole, self.spp))
        moved = replace(self.map(move), gain=move(self.gain), whole=whole, spp=spp)
        return replace(moved, now=self.now.map(move), previous=self.previous.map(move))

    @staticmethod
    def stack(frames: Sequence["Frame"]) -> "Frame":
        """One frame of the batches of all `frames`, which have the same channels and size."""
        wholes = [frame.whole for frame in frames if frame.whole is not None]
        return Frame(
            {name: torch.cat([frame.channels[name] for frame in frames]) for name in frames[0].channels},
            now=Cameras.stack([frame.now for frame in frames]),
            previous=Cameras.stack([frame.previous for frame in frames]),
            gain=torch.cat([frame.gain for frame in frames]),
            source=frames[0].source,
            whole=torch.cat(wholes) if wholes else None,
            spp=torch.cat([frame.samples for frame in frames]),
        )


def read_frame(
    clip: Clip,
    index: int,
    channels: Iterable[str],
    realisation: int = 0,
    previous: int | None = None,
    window: ImageWindow = WHOLE_IMAGE,
) -> Frame:
    """Frame `index` (B = 1) of a clip, with the named channels of one noise realisation, cut to `window`.

    In mirrors they are of what these show (see datasets.mirrors).

    `previous` is the frame that is played before this one, by default the one before it in the clip. Where it is
    another (in reversed playback, or while the camera stands still), motion vectors are computed for it.

    Halves of noisy channels are left out where the clip has none.

    Raises BadInput where another channel was not rendered or is damaged, and for what only the renderer knows in
    reversed playback.
    """
    stored_previous = max(index - 1, 0)  # where the clip's own motion vectors lead
    if previous is None:
        previous = stored_previous
    tensors = {}
    for name in channels:
        if name in CAMERA_CHANNELS or (name in SAMPLE_BUFFERS.values() and name not in clip.channels):
            continue
        if CHANNELS[name].is_temporal and previous != stored_previous:
            array = for_playback(clip, name, index, previous, window)
        else:
            array = clip.seen(name, index, window, realisation)
        tensors[name] = to_tensor(array, has_buffers=CHANNELS[name].has_buffers)
    return Frame(
        tensors,
        now=Cameras.of(clip.view(index), window),
        previous=Cameras.of(clip.view(previous), window),
        gain=torch.ones(1, 3, 1, 1),
        source=str(clip.path),
        spp=torch.full((1, 1, 1, 1), float(clip.facts["noisy_spp"])),
    )


def for_playback(clip: Clip, name: str, index: int, previous: int, window: ImageWindow) -> np.ndarray:
    """A temporal channel (h, w, 2), to a frame that is not the one before in the clip.

    Dual motion vectors depend on what hid a surface and gradients on how light changes, which only the renderer sees:
    they cannot be computed afterwards. But while time stands still nothing is hidden and nothing changes: dual motion
    equals motion, and both are 0 like the gradient.
    """
    if name != "motion" and previous != index:
        raise BadInput(f"{clip.path}: the channel '{name}' exists for forward playback only; train without reversing")
    return clip.motion_to(index, previous, window)


def to_tensor(array: np.ndarray, has_buffers: bool = False) -> Tensor:
    """(H, W, C) as (1, C, H, W), or with halves (2, H, W, C) as (1, 2, C, H, W); float32."""
    tensor = torch.from_numpy(np.ascontiguousarray(np.moveaxis(array.astype(np.float32), -1, -3)))
    assert tensor.ndim == (4 if has_buffers else 3)
    return tensor[None]
