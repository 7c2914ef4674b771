"""The channel table: what a clip holds, in which shape, precision and unit; and constants of its light."""

from typing import NamedTuple


class Channel(NamedTuple):
    """One row of the table.

    Axes are F frames, S noise realisations, H rows, W columns and M meshes; a number stands for its own length.
    """

    axes: tuple[str | int, ...]
    dtype: str  # as stored, unless it widens
    unit: str
    widens: bool = False  # to float32 where float16 would lose precision

    @property
    def components(self) -> int:
        """Numbers per pixel of a channel that is an image."""
        return int(self.axes[-1])

    @property
    def is_image(self) -> bool:
        """Whether the channel has pixels."""
        return "H" in self.axes

    @property
    def has_halves(self) -> bool:
        """Whether a frame has two images of it, of independent samples."""
        return self.axes[-4:-3] == (2,)

    def shape(self, **sizes: int) -> list[int]:
        """The stored shape, for the lengths of the axes given by name: F, S, H, W and M."""
        return [axis if isinstance(axis, int) else sizes[axis] for axis in self.axes]


RADIANCE_UNIT = "W sr^-1 m^-2"
LUMINANCE_WEIGHTS = (0.2126, 0.7152, 0.0722)  # of linear red, green and blue (ITU-R BT.709)
ALBEDO_FLOOR = 0.01  # demodulation divides by the albedo, but by no less than this

CHANNELS: dict[str, Channel] = {
    "direct": Channel(("F", "S", "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "indirect": Channel(("F", "S", "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "direct_halves": Channel(("F", "S", 2, "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "indirect_halves": Channel(("F", "S", 2, "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "direct_reference": Channel(("F", 2, "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "indirect_reference": Channel(("F", 2, "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "emission": Channel(("F", "H", "W", 3), "<f2", RADIANCE_UNIT, widens=True),
    "albedo": Channel(("F", "H", "W", 3), "<f2", "1"),
    "normal": Channel(("F", "H", "W", 3), "<f2", "1"),
    "depth": Channel(("F", "H", "W", 1), "<f4", "world units"),
    "roughness": Channel(("F", "H", "W", 1), "<f2", "GGX alpha"),
    "mesh_id": Channel(("F", "H", "W", 1), "<u2", "index"),
    "motion": Channel(("F", "H", "W", 2), "<f4", "px"),
    "dual_motion": Channel(("F", "H", "W", 2), "<f4", "px"),
    "shadow_motion": Channel(("F", "H", "W", 2), "<f4", "px"),
    "reflection_motion": Channel(("F", "H", "W", 2), "<f4", "px"),
    "gradient": Channel(("F", "H", "W", 2), "<f2", RADIANCE_UNIT, widens=True),
    "hit_distance": Channel(("F", "S", "H", "W", 2), "<f2", "world units", widens=True),
    "light_distance": Channel(("F", "S", "H", "W", 1), "<f2", "world units", widens=True),
    "light_angle": Channel(("F", "S", "H", "W", 1), "<f2", "rad", widens=True),
    "K": Channel(("F", 3, 3), "<f8", "px"),
    "camera_to_world": Channel(("F", 4, 4), "<f8", "world units"),
    "object_to_world": Channel(("F", "M", 4, 4), "<f8", "world units"),
}

SURFACE_CHANNELS = ("albedo", "normal", "depth", "roughness", "mesh_id", "motion")  # of what a pixel shows
MIRRORED = {name: f"mirrored_{name}" for name in SURFACE_CHANNELS}  # of what mirrors show, where any is in view
CHANNELS |= {mirrored: CHANNELS[name] for name, mirrored in MIRRORED.items()}
TRACKED_CHANNELS = ("shadow_motion", "reflection_motion")  # of what causes a pixel's light
MOTION_CHANNELS = ("motion", "dual_motion", *TRACKED_CHANNELS)
TEMPORAL_CHANNELS = (*MOTION_CHANNELS, "gradient")  # which relate a frame to the one before
CAMERA_CHANNELS = ("K", "camera_to_world", "object_to_world")
NOISY = ("direct", "indirect")
HIT_CHANNELS = ("hit_distance", "light_distance", "light_angle")  # of the samples in NOISY; 0 where none met anything
SAMPLED = (*NOISY, *HIT_CHANNELS)  # which each noise realisation has of its own
HALVES = {"direct": "direct_halves", "indirect": "indirect_halves"}  # the samples of noisy channels, in two halves
# Halves are stored where asked for.
USUAL_CHANNELS = tuple(name for name in CHANNELS if name not in {*HALVES.values(), *MIRRORED.values()})
REFERENCES = ("direct_reference", "indirect_reference")
