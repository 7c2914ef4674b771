"""A step whose history moves along with the surfaces: what it takes of a frame and of the one before, and that move."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import MAX_MAGNITUDE, Frame
from models.export.reprojection import View, expectation, fetch, places, table_of
from models.export.step import MESHES, Carried, Port, Step, Warp, image
from models.history.geometry import to_previous_camera

PORTS = {
    port.name: port
    for port in (
        image("noisy", 3, "noisy radiance of direct and indirect light, linear RGB; what is not finite counts as 0"),
        image("emission", 3, "radiance of light seen directly, linear RGB; added to the output as it is"),
        image("albedo", 3, "reflectance in [0, 1]; 1 for background"),
        image("normal", 3, "shading normal in world space, of unit length; 0 for background"),
        image("depth", 1, "distance along the viewing axis, in any unit; 0 for background"),
        image("roughness", 1, "GGX alpha; 1 for diffuse surfaces and background"),
        image("mesh_id", 1, "number of the mesh; 0 for background", torch.int32),
        image("motion", 2, "x and y from the pixel to where its surface was in the frame before, pixels"),
        Port("K", (3, 3), "projection of this camera: pixel = (K p) / p_z of a point p in the camera's frame"),
        Port(
            "camera_to_world",
            (4, 4),
            "rigid pose of this camera, whose z axis looks forward; only its rotation is read",
        ),
        Port(
            "to_previous_camera",
            (MESHES, 4, 4),
            "rigid, by mesh_id: from this camera's frame to that of the frame before, along with the mesh; multiply in "
            "float64: inverse(previous camera_to_world) · previous object_to_world · inverse(object_to_world) · "
            "camera_to_world, and without the objects in row 0",
        ),
        Port("samples", (1,), "samples a pixel of the noisy radiance; 1 where that is not known"),
    )
}
BROUGHT: dict[str, Callable[[Frame], Tensor]] = {
    "noisy": lambda frame: frame.direct + frame.indirect,
    "emission": lambda frame: frame.emission,
    "albedo": lambda frame: frame.albedo,
    "normal": lambda frame: frame.normal,
    "depth": lambda frame: frame.depth,
    "roughness": lambda frame: frame.roughness,
    "mesh_id": lambda frame: frame.mesh_id.int(),
    "motion": lambda frame: frame.motion,
    "K": lambda frame: frame.now.K[0].float(),
    "camera_to_world": lambda frame: frame.now.camera_to_world[0].float(),
    "to_previous_camera": lambda frame: to_previous_camera(frame.now, frame.previous, 0).float(),
    "samples": lambda frame: frame.samples.view(1),
}
FOR_WARP = ("mesh_id", "motion", "K", "camera_to_world", "to_previous_camera")
TESTED = ("depth", "normal", "mesh_id", "K", "camera_to_world")  # of both frames, in the order of View
SCALE = Port("scale", (4,), "running means of ln(luminance / 0.18) and ln(median depth), and how many frames count")


class RecurrentStep(Step):
    """A step with one image of history and the running scale as state."""

    def __init__(self, reads: Sequence[str], history: Port, warp: Warp):
        """It takes what it `reads`, names of PORTS, and with the warp inside what that needs."""
        super().__init__()
        inside = warp == "inside"
        self.warp = warp
        self.images = tuple(PORTS[name] for name in dict.fromkeys([*reads, *(FOR_WARP if inside else ())]))
        before = (
            Carried(Port(f"previous_{port.name}", port.shape, "that of the frame before", port.dtype), port.name)
            for port in self.images
            if port.name in TESTED
        )
        self.carried = (
            Carried(history, "new_history", warped=not inside),
            Carried(SCALE, "new_scale"),
            *(before if inside else ()),
        )
        self.outputs = (
            image("radiance", 3, "denoised radiance with emission, linear RGB"),
            Port("new_history", history.shape, "the next frame's history"),
            Port("new_scale", SCALE.shape, "the next frame's scale"),
        )

    def feeds(self, frame: Frame) -> dict[str, Tensor]:
        return {port.name: BROUGHT[port.name](frame) for port in self.images}

    def past(self, x: dict[str, Tensor]) -> Tensor:
        """The history (1, C, H, W) where this frame's surfaces were, 0 where they were not."""
        if self.warp == "outside":
            return x["history"]
        pixels = places(*x["depth"].shape[-2:])
        now, then = (View(*(x[prefix + name] for name in TESTED)) for prefix in ("", "previous_"))
        table = table_of(x["history"], then, pixels)
        return fetch(table, expectation(now, x["to_previous_camera"], pixels), x["motion"], pixels)


def demodulation(x: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
    """Noisy irradiance and its divisor (1, 3, H, W), and 1 for pixels that show a surface, else 0, (1, 1, H, W)."""
    divisor = x["albedo"].clamp(min=ALBEDO_FLOOR)
    noisy = torch.where(x["noisy"].abs() < MAX_MAGNITUDE, x["noisy"], 0) / divisor
    return noisy, divisor, (x["depth"] > 0).to(x["depth"])
