"""The Frame: the one type that goes from data sets to denoisers and metrics."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.cameras import Cameras
from datasets.channels import ALBEDO_FLOOR, CHANNELS, SAMPLE_BUFFERS, Kind
from datasets.clip import WHOLE_IMAGE, Clip, ImageWindow, second_layer_of
from errors import BadInput

Signal = Literal["total", "indirect"]
MAX_MAGNITUDE = 1e35  # of a channel: the sum of two, divided by the smallest albedo, is still finite in float32
MAX_SURFACE = 100.0  # of albedo, roughness and components of normals: what networks make of them is finite
BOUNDED = ("albedo", "normal", "roughness")  # channels that it bounds, and so their other forms


def largest_magnitude(name: str) -> float:
    """What the numbers of a channel count as at most."""
    return MAX_SURFACE if (CHANNELS[name].of or name) in BOUNDED else MAX_MAGNITUDE


def disoccluded(motion: Tensor, dual_motion: Tensor) -> Tensor:
    """Whether what a pixel shows was hidden in the previous frame: (B, 1, H, W) of bool.

    Both vectors (B, 2, H, W), in pixels, are equal where the surface was visible (Zeng et al. 2021, §3.2), up to the
    rounding that 1/64 px allows for.
    """
    return (dual_motion - motion).abs().amax(dim=1, keepdim=True) > 1 / 64


def times_each(images: Tensor, factor: Tensor) -> Tensor:
    """Images side by side, (B, 3 P, H, W), each times `factor` (B, 3, H, W)."""
    return (images.unflatten(1, (-1, 3)) * factor[:, None]).flatten(1, 2)


class ChannelTensor:
    """A channel as an attribute of Frame. Raises BadInput where it was not loaded."""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def __get__(self, frame: "Frame", owner: type) -> Tensor:
        return frame.channel(self.name)


@dataclass(frozen=True)
class Moment:
    """What identifies a frame of a sequence: its size (B, H, W) and cameras."""

    shape: tuple[int, int, int]
    cameras: Cameras


@dataclass(frozen=True)
class Frame:
    """One frame of one noise realisation: `channels` are tensors (B, C, H, W), float32.

    Units and ranges are those of the data set (docs/format.md). Channels of two sample buffers are (B, 2, 3, H, W).
    """

    channels: dict[str, Tensor]
    now: Cameras
    previous: Cameras  # of the frame that motion vectors lead to
    source: str = ""  # names the clip in messages
    spp: Tensor | None = None  # samples per pixel of the noisy channels, (B, 1, 1, 1); None if unknown
    parts: Tensor | None = None  # noisy radiance of parts of the light, as of lights, side by side: (B, 3 P, H, W)
    masks: int = 0  # how many parts, the last ones, are no light: their history does not follow changes of light
    # In training alone:
    colour_gain: Tensor | None = None  # what networks multiply their exposure by (RAE §4.3), (B, 3, 1, 1); None for 1
    whole: Tensor | None = None  # what running_scale measures in the frame that this is a crop of, (B, 2)

    direct = ChannelTensor()
    indirect = ChannelTensor()
    direct_buffers = ChannelTensor()
    indirect_buffers = ChannelTensor()
    direct_reference = ChannelTensor()
    indirect_reference = ChannelTensor()
    emission = ChannelTensor()
    albedo = ChannelTensor()
    normal = ChannelTensor()
    depth = ChannelTensor()
    roughness = ChannelTensor()
    mesh_id = ChannelTensor()
    motion = ChannelTensor()
    dual_motion = ChannelTensor()
    shadow_motion = ChannelTensor()
    reflection_motion = ChannelTensor()
    gradient = ChannelTensor()
    hit_distance = ChannelTensor()
    light_distance = ChannelTensor()
    light_angle = ChannelTensor()

    def channel(self, name: str) -> Tensor:
        """A channel by its name. Raises BadInput where it was not loaded."""
        if name not in self.channels:
            raise BadInput(f"{self.source}: the channel '{name}' was not loaded for this frame")
        return self.channels[name]

    def with_channels(self, channels: Mapping[str, Tensor]) -> "Frame":
        return replace(self, channels=self.channels | dict(channels))

    def without(self, *kinds: Kind) -> "Frame":
        kept = {name: tensor for name, tensor in self.channels.items() if CHANNELS[name].kind not in kinds}
        return replace(self, channels=kept)

    @property
    def has_layers(self) -> bool:
        """Whether smooth glass is in view, whose second layer is described."""
        return "glass_reflectance" in self.channels

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        shape = next(iter(self.channels.values())).shape
        return shape[0], shape[-2], shape[-1]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        return self.shape[1:]

    def ones(self, components: int) -> Tensor:
        """(B, components, 1, 1)."""
        return next(iter(self.channels.values())).new_ones(self.shape[0], components, 1, 1)

    @property
    def part_count(self) -> int:
        """P, the number of parts of the light."""
        return 0 if self.parts is None else self.parts.shape[1] // 3

    @property
    def moment(self) -> Moment:
        return Moment(self.shape, self.now)

    def follows(self, moment: Moment) -> bool:
        """Whether this frame comes right after `moment`: it has the same size and its previous cameras are those.

        So a cut needs no flag: the first frame of another shot has other previous cameras. Between two still shots from
        the same place neither camera nor meshes differ, and a cut goes unnoticed: pass None as the state there.
        """
        return moment.shape == self.shape and self.previous.almost_equal(moment.cameras)

    @property
    def samples(self) -> Tensor:
        """Samples per pixel of the noisy channels, (B, 1, 1, 1); 1 if unknown."""
        return self.ones(1) if self.spp is None else self.spp

    @property
    def gain(self) -> Tensor:
        """What networks multiply their exposure by, (B, 3, 1, 1)."""
        return self.ones(3) if self.colour_gain is None else self.colour_gain

    @property
    def divisor(self) -> Tensor:
        """What demodulation divides by: max(albedo, 0.01), (B, 3, H, W)."""
        return self.albedo.clamp(min=ALBEDO_FLOOR)

    @cached_property
    def surface(self) -> Tensor | None:
        """1 where a pixel shows a surface and 0 for background, (B, 1, H, W); None where all show one."""
        return None if self.depth.amin() > 0 else (self.depth > 0).to(self.depth)

    def finite(self) -> "Frame":
        """The frame with 0 instead of NaN and infinities in all channels, and the rest clamped to +-largest_magnitude.

        The extremes of a channel show whether it has any such number, at a fraction of the cost of mending every pixel.
        """
        mended = {}
        for name, tensor in self.channels.items():
            limit = largest_magnitude(name)
            low, high = tensor.aminmax()
            if not torch.maximum(-low, high) <= limit:  # NaN passes no comparison
                mended[name] = tensor.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).clamp(-limit, limit)
        frame = self.with_channels(mended) if mended else self
        if frame.parts is None or torch.isfinite(frame.parts.sum()):
            return frame
        return replace(frame, parts=torch.nan_to_num(frame.parts, 0.0, 0.0, 0.0))

    @property
    def has_buffers(self) -> bool:
        """Whether the noisy channels are also there as two independent sample buffers."""
        return not self.channels.keys().isdisjoint(SAMPLE_BUFFERS.values())

    def buffer(self, which: int) -> "Frame":
        """The frame with the samples of buffer 0 (A) or 1 (B) alone."""
        noisy = {
            name: self.channels[buffers][:, which]
            for name, buffers in SAMPLE_BUFFERS.items()
            if {name, buffers} <= self.channels.keys()
        }
        return replace(self.without("buffers", "second").with_channels(noisy), spp=self.samples / 2)

    def map(self, function: Callable[[Tensor], Tensor]) -> "Frame":
        return replace(self, channels={name: function(tensor) for name, tensor in self.channels.items()})

    def radiance(self, signal: Signal) -> Tensor:
        """Noisy radiance (B, 3, H, W): emission + direct + indirect, or indirect alone."""
        return self.indirect if signal == "indirect" else self.emission + self.direct + self.indirect

    def irradiance(self, signal: Signal) -> Tensor:
        """Noisy irradiance (B, 3, H, W): radiance without emission, divided by the albedo."""
        return (self.indirect if signal == "indirect" else self.direct + self.indirect) / self.divisor

    def reference_buffers(self, signal: Signal) -> Tensor:
        """Radiance without emission (B, 2, 3, H, W) of the reference, in two buffers whose noise is independent."""
        return self.indirect_reference if signal == "indirect" else self.direct_reference + self.indirect_reference

    def reference_irradiance(self, signal: Signal) -> Tensor:
        """Irradiance (B, 3, H, W) of the reference."""
        return self.reference_buffers(signal).mean(dim=1) / self.divisor

    def remodulate(self, irradiance: Tensor, signal: Signal) -> Tensor:
        """Radiance (B, 3, H, W) of denoised irradiance: times `divisor`, see `complete`. Reads albedo, too."""
        return self.complete(irradiance * self.divisor, signal)

    def demodulate(self, radiance: Tensor, signal: Signal) -> Tensor:
        """Irradiance (B, 3, H, W) of denoised radiance: without emission, over `divisor`."""
        reflected = radiance - self.emission if signal == "total" else radiance
        return (reflected / self.divisor).clamp(min=0)

    def complete(self, reflected: Tensor, signal: Signal) -> Tensor:
        """Radiance (B, 3, H, W) of what was denoised: background reflects nothing; "total" has noise-free emission.

        Reads depth, and emission for "total".
        """
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

    def to(self, device: torch.device | str) -> "Frame":
        """The frame with all tensors on `device`; the frame itself if they are there."""
        if self.now.K.device == torch.device(device):
            return self

        def move(tensor: Tensor) -> Tensor:
            return tensor.to(device)

        others = (self.spp, self.parts, self.colour_gain, self.whole)
        spp, parts, gain, whole = (None if x is None else move(x) for x in others)
        moved = replace(self.map(move), spp=spp, parts=parts, colour_gain=gain, whole=whole)
        return replace(moved, now=self.now.map(move), previous=self.previous.map(move))

    @staticmethod
    def stack(frames: Sequence["Frame"]) -> "Frame":
        """One frame of the batches of all `frames`, which have the same channels and size."""
        wholes = [frame.whole for frame in frames if frame.whole is not None]
        return Frame(
            {name: torch.cat([frame.channels[name] for frame in frames]) for name in frames[0].channels},
            now=Cameras.stack([frame.now for frame in frames]),
            previous=Cameras.stack([frame.previous for frame in frames]),
            source=frames[0].source,
            spp=torch.cat([frame.samples for frame in frames]),
            colour_gain=torch.cat([frame.gain for frame in frames]),
            whole=torch.cat(wholes) if wholes else None,
        )


def read_frame(
    clip: Clip,
    index: int,
    channels: Iterable[str],
    realisation: int = 0,
    previous: int | None = None,
    window: ImageWindow = WHOLE_IMAGE,
    in_layers: bool = True,
) -> Frame:
    """Frame `index` (B = 1) of a clip, with the named channels of one noise realisation, cut to `window`.

    In mirrors and glass they are of what these show (clip.visible_channel). Where the clip has a second layer, its
    forms of these channels come with them, unless not `in_layers`. Sample buffers are left out where it has none.

    `previous` is the frame that is played before this one, by default the one before it in the clip. For another one
    (in reversed playback, or while the camera stands still), motion vectors are computed.

    Raises BadInput where another channel was not rendered or is damaged, and in reversed playback for channels that
    only the renderer can compute.
    """
    stored_previous = max(index - 1, 0)  # where the clip's own motion vectors lead
    if previous is None:
        previous = stored_previous
    tensors = {}
    names = dict.fromkeys(channels)
    if in_layers and previous == stored_previous:
        names |= dict.fromkeys(second_layer_of(names, clip.layers))
    for name in names:
        channel = CHANNELS[name]
        if not channel.is_image or (channel.kind == "buffers" and name not in clip.channels):
            continue
        if channel.is_temporal and previous != stored_previous:
            array = temporal_channel(clip, name, index, previous, window)
        else:
            array = clip.read_visible(name, index, window, realisation)
        tensors[name] = to_tensor(array, has_buffers=channel.has_buffers)
    return Frame(
        tensors,
        now=Cameras.of(clip.visible_view(index), window),
        previous=Cameras.of(clip.visible_view(previous), window),
        source=str(clip.path),
        spp=torch.full((1, 1, 1, 1), float(clip.facts["noisy_spp"])),
    )


def temporal_channel(clip: Clip, name: str, index: int, previous: int, window: ImageWindow) -> NDArray[np.float32]:
    """A temporal channel (h, w, 2), to a frame that is not the one before in the clip.

    Dual motion vectors depend on what hid a surface and gradients on how light changes: only the renderer can compute
    them. But while time stands still nothing is hidden and nothing changes: dual motion equals motion, and both are 0
    like the gradient.
    """
    if name != "motion" and previous != index:
        raise BadInput(f"{clip.path}: the channel '{name}' exists for forward playback only; train without reversing")
    return clip.motion_to(index, previous, window)


def to_tensor(array: NDArray[np.generic], has_buffers: bool = False) -> Tensor:
    """(H, W, C) as (1, C, H, W), or two buffers (2, H, W, C) as (1, 2, C, H, W); float32."""
    tensor = torch.from_numpy(np.ascontiguousarray(np.moveaxis(array.astype(np.float32), -1, -3)))
    assert tensor.ndim == (4 if has_buffers else 3)
    return tensor[None]


def to_image(tensor: Tensor) -> NDArray[Any]:
    """(1, C, H, W), on any device, as (H, W, C)."""
    return tensor[0].permute(1, 2, 0).cpu().numpy()
