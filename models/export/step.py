"""What an exported denoiser is: one frame and its state in, radiance and the next state out, all plain tensors."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor, nn

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import BOUNDED, MAX_MAGNITUDE, MAX_SURFACE, Frame
from models.denoiser import Denoiser
from models.export.history import GraphGBuffer, reprojected
from models.history.coarse_light import COARSE_TILE
from models.history.geometry import to_previous_camera

Warp = Literal["inside", "outside"]

HEIGHT = "height"
WIDTH = "width"
MESHES = "meshes_and_1"
TILE_ROWS = "tile_rows_and_1"
TILE_COLUMNS = "tile_columns_and_1"
PREVIOUS = "previous_"  # begins the names of what is the previous frame's


@dataclass(frozen=True)
class Port:
    """A tensor that goes into a step or comes out of it. State is 0 before the first frame and after a cut."""

    name: str
    shape: tuple[int | str, ...]  # numbers, and names of sizes that may differ from call to call
    meaning: str  # for users, with its unit
    of_frame: Callable[[Frame], Tensor] | None = None  # how a frame (B = 1) provides it; by default as its channel
    dtype: torch.dtype = torch.float32
    source: str = ""  # of state: the output, or the input, of the previous frame that it is
    warped: bool = False  # of state: whether the caller must reproject it first, with 0 where it was not visible


def image(name: str, channels: int, *facts: Any) -> Port:
    """A port for images (1, channels, H, W); `facts` are the fields after `shape`."""
    return Port(name, (1, channels, HEIGHT, WIDTH), *facts)


FRAME_PORTS = (
    image("noisy", 3, "noisy direct and indirect light; non-finite values count as 0", lambda f: f.direct + f.indirect),
    image("emission", 3, "directly visible light sources; added to the output unchanged"),
    image("albedo", 3, "reflectance in [0, 1]; 1 for background"),
    image("normal", 3, "shading normal in world space, of unit length; 0 for background"),
    image("depth", 1, "distance along the viewing axis, in any unit; 0 for background"),
    image("roughness", 1, "GGX alpha; 1 for diffuse surfaces and background"),
    image("mesh_id", 1, "mesh number; 0 for background", lambda f: f.mesh_id.int(), torch.int32),
    image("motion", 2, "x and y from the pixel to its surface in the previous frame, in pixels"),
    Port("K", (3, 3), "intrinsics: pixel = (K p) / p_z of p in camera space", of_frame=lambda f: f.now.K[0].float()),
    Port(
        "camera_to_world",
        (4, 4),
        "rigid camera pose, z axis forward; only its rotation is used",
        of_frame=lambda f: f.now.camera_to_world[0].float(),
    ),
    Port(
        "to_previous_camera",
        (MESHES, 4, 4),
        "rigid transforms, indexed by mesh_id, from this frame's camera space to the previous one's, along with the "
        "mesh: inverse(previous camera_to_world) · previous object_to_world · inverse(object_to_world) · "
        "camera_to_world; row 0 without the object matrices; multiply in float64",
        of_frame=lambda f: to_previous_camera(f.now, f.previous, 0).float(),
    ),
    Port("samples", (1,), "samples per pixel of noisy; 1 where unknown", of_frame=lambda f: f.samples.view(1)),
)
WARP_READS = ("mesh_id", "motion", "K", "camera_to_world", "to_previous_camera")
SCALE = Port("scale", (4,), "running means of ln(luminance / 0.18) and ln(median depth), and frame counts of both")


def tiles_and_1(side: int) -> int:
    """How many tiles of a coarse correction cover a side of the image, and one more: tracers need to see two."""
    return (side + 2 * COARSE_TILE - 1) // COARSE_TILE


class Step(nn.Module):
    """One frame of a denoiser (B = 1) as a function of tensors by name.

    Its state is a history image, the running scale and, with the warp inside, the previous frame's G-buffer and camera.
    """

    reads: ClassVar[tuple[str, ...]]  # names of the FRAME_PORTS that it takes, apart from those of the warp
    history: ClassVar[Port]
    other_state: ClassVar[tuple[Port, ...]] = ()  # beside it, never reprojected

    def __init__(self, denoiser: Denoiser, warp: Warp):
        super().__init__()
        self.precision = denoiser.precision
        self.warp = warp  # whether the step reprojects the history itself
        reads = (*self.reads, *WARP_READS) if warp == "inside" else self.reads
        ports = {port.name: port for port in FRAME_PORTS}
        # What each frame brings, then what is state. Of the outputs, the first is the radiance.
        self.images = tuple(ports[name] for name in dict.fromkeys(reads))
        previous = (
            replace(port, name=PREVIOUS + port.name, meaning="that of the previous frame", source=port.name)
            for port in self.images
            if port.name in GraphGBuffer._fields and warp == "inside"
        )
        history = replace(self.history, source="new_history", warped=warp == "outside")
        others = [replace(port, source=f"new_{port.name}") for port in (SCALE, *self.other_state)]
        self.carried = (history, *others, *previous)
        self.inputs = (*self.images, *self.carried)
        self.outputs = (
            image("radiance", 3, "denoised radiance including emission, linear RGB"),
            *(Port(port.source, port.shape, f"the next frame's {port.name}") for port in (history, *others)),
        )

    def forward(self, x: dict[str, Tensor]) -> dict[str, Tensor]:
        """The outputs, by name, of all inputs by name."""
        raise NotImplementedError

    def frame_inputs(self, frame: Frame) -> dict[str, Tensor]:
        """The `images` of a frame (B = 1), by name."""
        return {p.name: p.of_frame(frame) if p.of_frame else frame.channel(p.name) for p in self.images}

    def initial_state(self, frame: Frame) -> dict[str, Tensor]:
        """The state before a sequence of frames of this one's size."""
        sizes = dict(zip((HEIGHT, WIDTH), frame.size, strict=True))
        sizes |= {name: tiles_and_1(side) for name, side in zip((TILE_ROWS, TILE_COLUMNS), frame.size, strict=True)}
        shapes = ([size if isinstance(size, int) else sizes[size] for size in port.shape] for port in self.carried)
        return {p.name: torch.zeros(shape, dtype=p.dtype) for p, shape in zip(self.carried, shapes, strict=True)}

    def reprojected_history(self, x: dict[str, Tensor]) -> Tensor:
        """The history (1, C, H, W) at this frame's surfaces, 0 where it is not valid."""
        if self.warp == "outside":
            return x["history"]
        now, previous = (
            GraphGBuffer(*(x[prefix + name] for name in GraphGBuffer._fields)) for prefix in ("", PREVIOUS)
        )
        return reprojected(x["history"], now, previous, x["to_previous_camera"], x["motion"])


def bounded(x: dict[str, Tensor]) -> dict[str, Tensor]:
    """A step's inputs with the bounds that Frame.finite sets to surfaces."""
    names = [name for name in x if name.removeprefix(PREVIOUS) in BOUNDED]
    return x | {name: x[name].clamp(-MAX_SURFACE, MAX_SURFACE) for name in names}


def demodulation(x: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Noisy irradiance and its divisor (1, 3, H, W), and 1 for pixels that show a surface, else 0, (1, 1, H, W)."""
    divisor = x["albedo"].clamp(min=ALBEDO_FLOOR)
    noisy = torch.where(x["noisy"].abs() < MAX_MAGNITUDE, x["noisy"], 0) / divisor
    return noisy, divisor, (x["depth"] > 0).to(x["depth"])
