"""The channel table: every fact about a channel of a clip is in its row; and constants of a clip's light."""

from dataclasses import dataclass, replace
from typing import Literal

Kind = Literal[
    "noisy",  # radiance of the noisy samples
    "buffers",  # the same as two independent sample buffers, A and B; stored on request
    "reference",  # the same with many samples, also in two buffers
    "emission",  # radiance without noise
    "surface",  # what a primary ray hits
    "mirrored",  # a surface channel or motion, of what mirrors and glass show; stored where one is in view
    "second",  # of the second layer of glass; stored where smooth glass is in view
    "motion",  # vectors to the frame before
    "gradient",  # how light has changed since the frame before
    "hit",  # means over those of the noisy samples that hit something; 0 where none did
    "camera",  # matrices
]


@dataclass(frozen=True)
class Channel:
    kind: Kind
    axes: tuple[str | int, ...]  # F frames, S noise realisations, H rows, W columns, M meshes; a number: its own length
    dtype: str  # as stored; float32 instead, if it `widens`, where float16 would lose precision
    unit: str
    letters: str = ""  # of its components in EXR layers
    of: str | None = None  # the channel that this is another form of: a buffer, reference, mirrored or second one
    widens: bool = False
    essential: bool = False  # whether it is rendered whatever denoisers read
    step: str | None = None  # the optional step of rendering that makes it
    renderer_only: bool = False  # whether no other renderer writes it, and nothing else can take its place
    is_camera_motion: bool = False  # whether it follows from depth and cameras in a scene in which nothing else moves

    @property
    def is_image(self) -> bool:
        return self.kind != "camera"

    @property
    def has_buffers(self) -> bool:
        """Whether a frame has two images of it, of independent samples."""
        return self.kind in ("buffers", "reference")

    @property
    def is_reflected(self) -> bool:
        """Whether it is radiance that surfaces reflect."""
        return self.kind in ("noisy", "buffers", "reference") or (self.kind == "second" and self.unit == RADIANCE)

    @property
    def is_temporal(self) -> bool:
        """Whether it relates a frame to the one before."""
        return self.kind in ("motion", "gradient")

    def shape(self, **sizes: int) -> list[int]:
        """The stored shape, for the lengths of the axes given by name: F, S, H, W and M."""
        return [axis if isinstance(axis, int) else sizes[axis] for axis in self.axes]


RADIANCE = "W sr^-1 m^-2"
LENGTH = "world units"
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)  # of linear red, green and blue (ITU-R BT.709)
STRATUM = 3  # px, the side of the squares of which each has one sample of the channel gradient
BACKGROUND = {"albedo": 1.0, "roughness": 1.0}  # of pixels that show no surface; other surface channels are 0
ALBEDO_FLOOR = 0.01  # demodulation divides by the albedo, but by no less than this

IMAGES = ("F", "H", "W")
REALISATIONS = ("F", "S", "H", "W")
NOISY = Channel("noisy", (*REALISATIONS, 3), "<f2", RADIANCE, "RGB", widens=True, essential=True)
BUFFERS = replace(NOISY, kind="buffers", axes=("F", "S", 2, "H", "W", 3), essential=False)
REFERENCE_LIGHT = replace(NOISY, kind="reference", axes=("F", 2, "H", "W", 3))
MOTION = Channel("motion", (*IMAGES, 2), "<f4", "px", "XY")
TRACKED = replace(MOTION, step="shadow_motion", renderer_only=True)  # motion of what causes a pixel's light
HIT = Channel("hit", (*REALISATIONS, 1), "<f2", LENGTH, "Z", widens=True, step="hit_distance", renderer_only=True)

CHANNELS: dict[str, Channel] = {
    "direct": NOISY,
    "indirect": NOISY,
    "direct_buffers": replace(BUFFERS, of="direct"),
    "indirect_buffers": replace(BUFFERS, of="indirect"),
    "direct_reference": replace(REFERENCE_LIGHT, of="direct"),
    "indirect_reference": replace(REFERENCE_LIGHT, of="indirect"),
    "emission": Channel("emission", (*IMAGES, 3), "<f2", RADIANCE, "RGB", widens=True, essential=True),
    "albedo": Channel("surface", (*IMAGES, 3), "<f2", "1", "RGB", essential=True),
    "normal": Channel("surface", (*IMAGES, 3), "<f2", "1", "XYZ"),
    "depth": Channel("surface", (*IMAGES, 1), "<f4", LENGTH, "Z", essential=True),
    "roughness": Channel("surface", (*IMAGES, 1), "<f2", "GGX alpha", "Y"),
    "mesh_id": Channel("surface", (*IMAGES, 1), "<u2", "index", "I", essential=True),
    "motion": replace(MOTION, is_camera_motion=True),
    "dual_motion": replace(MOTION, step="dual_motion"),
    "shadow_motion": replace(TRACKED, is_camera_motion=True),
    "reflection_motion": TRACKED,
    "gradient": replace(TRACKED, kind="gradient", dtype="<f2", unit=RADIANCE, widens=True, step="gradient"),
    "hit_distance": replace(HIT, axes=(*REALISATIONS, 2), letters="XY"),
    "light_distance": HIT,
    "light_angle": replace(HIT, unit="rad", letters="Y"),
    "K": Channel("camera", ("F", 3, 3), "<f8", "px", essential=True),
    "camera_to_world": Channel("camera", ("F", 4, 4), "<f8", LENGTH, essential=True),
    "object_to_world": Channel("camera", ("F", "M", 4, 4), "<f8", LENGTH, essential=True),
}
# By the names of prefixes: layers that mirrors and glass show. A second one has light of its own.
CHANNELS |= {
    f"{kind}_{name}": replace(channel, kind=kind, of=name, essential=False, is_camera_motion=False)
    for kind in ("mirrored", "second")
    for name, channel in CHANNELS.items()
    if channel.kind == "surface" or name == "motion" or (kind, name) == ("second", "indirect")
}
CHANNELS["glass_reflectance"] = Channel("second", (*IMAGES, 1), "<f2", "1", "Y")
CHANNELS["second_samples"] = Channel("second", (*REALISATIONS, 1), "<f2", "1", "Y")


def channels_of(*kinds: Kind) -> tuple[str, ...]:
    """The names of all channels of some kinds, in the order of the table."""
    return tuple(name for name, channel in CHANNELS.items() if channel.kind in kinds)


def forms_of(kind: Kind) -> dict[str, str]:
    """The channels of one kind by the channel that each is another form of."""
    return {of: name for name in channels_of(kind) if (of := CHANNELS[name].of)}


NOISY_CHANNELS = channels_of("noisy")
REFERENCE_CHANNELS = channels_of("reference")
HIT_CHANNELS = channels_of("hit")
MOTION_CHANNELS = channels_of("motion")
SAMPLE_BUFFERS = forms_of("buffers")
MIRRORED = forms_of("mirrored")
SECOND = forms_of("second")
SECOND_LAYER = channels_of("second")
OPTIONAL_STEPS = tuple(dict.fromkeys(channel.step for channel in CHANNELS.values() if channel.step))  # of rendering
USUAL_CHANNELS = tuple(name for name in CHANNELS if CHANNELS[name].kind not in ("buffers", "mirrored", "second"))
