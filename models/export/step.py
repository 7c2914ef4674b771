"""What an exported denoiser is: one frame and its state in, radiance and the next state out, all plain tensors."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import MAX_MAGNITUDE, Frame
from models.denoiser import Denoiser
from models.export.history import GraphGBuffer, expected_surfaces, pixel_coordinates, reprojected, reprojection_table
from models.history.geometry import to_previous_camera

Warp = Literal["inside", "outside"]
Tensors = Mapping[str, Tensor]
OfFrame = Callable[[Frame], Tensor]  # B = 1

HEIGHT = "height"
WIDTH = "width"
MESHES = "meshes_and_1"


@dataclass(frozen=True)
class Port:
    """A tensor that goes into a step or comes out of it."""

    name: str
    shape: tuple[int | str, ...]  # numbers, and names of sizes that may differ from call to call
    meaning: str  # for users, with its unit
    dtype: torch.dtype = torch.float32
    of_frame: OfFrame | None = None  # how a frame provides it, if it does


def image(name: str, channels: int, of_frame: OfFrame | None, meaning: str, dtype: torch.dtype = torch.float32) -> Port:
    """A port for images (1, channels, H, W)."""
    return Port(name, (1, channels, HEIGHT, WIDTH), meaning, dtype, of_frame)


@dataclass(frozen=True)
class StatePort:
    """An input that comes from the previous frame: zeros before the first frame and after a cut."""

    port: Port
    source: str  # the output, or the input, of the previous frame that it is
    warped: bool = False  # whether the caller must reproject it first, with 0 where the surface was not visible


FRAME_PORTS = (
    image("noisy", 3, lambda f: f.direct + f.indirect, "noisy direct and indirect light; non-finite values count as 0"),
    image("emission", 3, lambda f: f.emission, "directly visible light sources; added to the output unchanged"),
    image("albedo", 3, lambda f: f.albedo, "reflectance in [0, 1]; 1 for background"),
    image("normal", 3, lambda f: f.normal, "shading normal in world space, of unit length; 0 for background"),
    image("depth", 1, lambda f: f.depth, "distance along the viewing axis, in any unit; 0 for background"),
    image("roughness", 1, lambda f: f.roughness, "GGX alpha; 1 for diffuse surfaces and background"),
    image("mesh_id", 1, lambda f: f.mesh_id.int(), "mesh number; 0 for background", torch.int32),
    image("motion", 2, lambda f: f.motion, "x and y from the pixel to its surface in the previous frame, in pixels"),
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


class Step(nn.Module):
    """One frame of a denoiser (B = 1) as a function of tensors by name.

    Its state is a history image, the running scale and, with the warp inside, the previous frame's G-buffer and camera.

    Attributes:
        reads: names of the FRAME_PORTS that it takes, apart from those of the warp.
        warp: whether the step reprojects the history itself.
        images: inputs that each frame brings.
        carried: inputs that are state.
        outputs: the first is the radiance.
    """

    reads: ClassVar[tuple[str, ...]]
    history: ClassVar[Port]

    def __init__(self, denoiser: Denoiser, warp: Warp):
        super().__init__()
        self.precision = denoiser.precision
        inside = warp == "inside"
        self.warp = warp
        ports = {port.name: port for port in FRAME_PORTS}
        self.images = tuple(ports[name] for name in dict.fromkeys([*self.reads, *(WARP_READS if inside else ())]))
        previous = (
            StatePort(Port(f"previous_{port.name}", port.shape, "that of the previous frame", port.dtype), port.name)
            for port in self.images
            if port.name in GraphGBuffer._fields
        )
        self.carried = (
            StatePort(self.history, "new_history", warped=not inside),
            StatePort(SCALE, "new_scale"),
            *(previous if inside else ()),
        )
        self.inputs = (*self.images, *(each.port for each in self.carried))
        self.outputs = (
            image("radiance", 3, None, "denoised radiance including emission, linear RGB"),
            Port("new_history", self.history.shape, "the next frame's history"),
            Port("new_scale", SCALE.shape, "the next frame's scale"),
        )

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """The outputs, by name, of all inputs by name."""
        raise NotImplementedError

    def frame_inputs(self, frame: Frame) -> dict[str, Tensor]:
        """The `images` of a frame (B = 1), by name."""
        return {port.name: port.of_frame(frame) for port in self.images if port.of_frame}

    def initial_state(self, frame: Frame) -> dict[str, Tensor]:
        """The state before a sequence of frames of this one's size."""
        sizes = dict(zip((HEIGHT, WIDTH), frame.size, strict=True))
        ports = [each.port for each in self.carried]
        shapes = ([size if isinstance(size, int) else sizes[size] for size in port.shape] for port in ports)
        return {port.name: torch.zeros(shape, dtype=port.dtype) for port, shape in zip(ports, shapes, strict=True)}

    def next_state(self, inputs: Tensors, outputs: Tensors) -> dict[str, Tensor]:
        """The state after a frame, not yet warped."""
        tensors = {**inputs, **outputs}
        return {each.port.name: tensors[each.source] for each in self.carried}

    def reprojected_history(self, x: dict[str, Tensor]) -> Tensor:
        """The history (1, C, H, W) at this frame's surfaces, 0 where it is not valid."""
        if self.warp == "outside":
            return x["history"]
        pixels = pixel_coordinates(*x["depth"].shape[-2:])
        now, previous = (
            GraphGBuffer(*(x[prefix + name] for name in GraphGBuffer._fields)) for prefix in ("", "previous_")
        )
        table = reprojection_table(x["history"], previous, pixels)
        return reprojected(table, expected_surfaces(now, x["to_previous_camera"], pixels), x["motion"], pixels)


def demodulation(x: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Noisy irradiance and its divisor (1, 3, H, W), and 1 for pixels that show a surface, else 0, (1, 1, H, W)."""
    divisor = x["albedo"].clamp(min=ALBEDO_FLOOR)
    noisy = torch.where(x["noisy"].abs() < MAX_MAGNITUDE, x["noisy"], 0) / divisor
    return noisy, divisor, (x["depth"] > 0).to(x["depth"])
