"""WSKP (models/wskp.py) as a step: accumulation, network and shared kernels in one graph."""

import torch
from torch import Tensor, nn

from datasets.channels import ALBEDO_FLOOR
from datasets.frame import LARGEST, Frame
from models.export.box_windows import BoxWindows
from models.export.reprojection import View, expectation, fetch, places, table_of
from models.export.scale import Scale, updated_scale
from models.export.step import MESHES, Carried, Port, Step, Warp, image
from models.parameters import GAMMA, SMALLEST_ALPHA
from models.repvgg import RepVGGBlock
from models.surfaces import to_previous_camera
from models.wskp import WSKP

IMAGES = (
    image("noisy", 3, "noisy radiance of direct and indirect light, linear RGB; what is not finite counts as 0"),
    image("emission", 3, "radiance of light seen directly, linear RGB; added to the output as it is"),
    image("albedo", 3, "reflectance in [0, 1]; 1 for background"),
    image("normal", 3, "shading normal in world space, of unit length; 0 for background"),
    image("depth", 1, "distance along the viewing axis, in any unit; 0 for background"),
)
FOR_WARP = (
    image("mesh_id", 1, "number of the mesh; 0 for background", torch.int32),
    image("motion", 2, "x and y from the pixel to where its surface was in the frame before, pixels"),
    Port("K", (3, 3), "projection of this camera: pixel = (K p) / p_z of a point p in the camera's frame"),
    Port("camera_to_world", (4, 4), "rigid pose of this camera, whose z axis looks forward; only its rotation is read"),
    Port(
        "to_previous_camera",
        (MESHES, 4, 4),
        "rigid, by mesh_id: from this camera's frame to that of the frame before, along with the mesh; multiply in "
        "float64: inverse(previous camera_to_world) · previous object_to_world · inverse(object_to_world) · "
        "camera_to_world, and without the objects in row 0",
    ),
)
HISTORY = image("history", 4, "accumulated irradiance, linear RGB, and its length in frames")
SCALE = Port("scale", (4,), "running means of ln(luminance / 0.18) and ln(median depth), and how many frames count")


def plain_convolutions(network: nn.Module) -> nn.Module:
    """The merged network with plain convolutions: our pairs of pixels are for our processors."""
    for block in network.modules():
        if isinstance(block, RepVGGBlock) and block.merged is not None:
            outputs, inputs, size, _ = block.merged.weight.shape
            plain = nn.Conv2d(inputs, outputs, size, padding=size // 2, dtype=block.merged.weight.dtype)
            plain.load_state_dict(block.merged.state_dict())
            block.merged = plain
    return network.requires_grad_(False)


class WSKPStep(Step):
    """wskp3 or wskp6, prepared for inference, which must not be used any more."""

    def __init__(self, denoiser: WSKP, warp: Warp):
        super().__init__()
        self.precision = denoiser.precision
        self.seen = tuple(denoiser.inputs)
        self.network = plain_convolutions(denoiser.network)
        self.fusion = BoxWindows(denoiser.windows)
        self.warp = warp
        self.images = IMAGES + (FOR_WARP if warp == "inside" else ())
        then = [port for port in self.images if port.name in ("depth", "normal", "mesh_id", "K", "camera_to_world")]
        before = (
            Carried(Port(f"previous_{port.name}", port.shape, "that of the frame before", port.dtype), port.name)
            for port in then
        )
        self.carried = (
            Carried(HISTORY, "new_history", warped=warp == "outside"),
            Carried(SCALE, "new_scale"),
            *(before if warp == "inside" else ()),
        )
        self.outputs = (
            image("radiance", 3, "denoised radiance with emission, linear RGB"),
            image("new_history", 4, "the next frame's history"),
            Port("new_scale", (4,), "the next frame's scale"),
        )

    def feeds(self, frame: Frame) -> dict[str, Tensor]:
        brought = {
            "noisy": frame.direct + frame.indirect,
            "emission": frame.emission,
            "albedo": frame.albedo,
            "normal": frame.normal,
            "depth": frame.depth,
        }
        if self.warp == "inside":
            brought |= {
                "mesh_id": frame.mesh_id.int(),
                "motion": frame.motion,
                "K": frame.now.K[0].float(),
                "camera_to_world": frame.now.camera_to_world[0].float(),
                "to_previous_camera": to_previous_camera(frame.now, frame.previous, 0).float(),
            }
        return brought

    def past(self, x: dict[str, Tensor]) -> Tensor:
        """The history (1, 4, H, W) where this frame's surfaces were, 0 where they were not."""
        if self.warp == "outside":
            return x["history"]
        pixels = places(*x["depth"].shape[-2:])
        now, then = (
            View(*(x[prefix + name] for name in ("depth", "normal", "mesh_id", "K", "camera_to_world")))
            for prefix in ("", "previous_")
        )
        table = table_of(x["history"], then, pixels)
        return fetch(table, expectation(now, x["to_previous_camera"], pixels), x["motion"], pixels)

    def features(self, x: dict[str, Tensor], radiance: Tensor, scale: Scale) -> Tensor:
        """models.features.network_features of accumulated `radiance`."""
        features = {
            "colour": (radiance * scale.exposure).clamp(0, 1) ** (1 / GAMMA),
            "albedo": x["albedo"],
            "normal": x["normal"] / 2 + 0.5,
            "depth": torch.where(x["depth"] > 0, x["depth"] / (x["depth"] + scale.depth), 1),
        }
        return torch.cat([features[name] for name in self.seen], dim=1)

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        x = tensors
        surface = (x["depth"] > 0).to(x["depth"])
        divisor = x["albedo"].clamp(min=ALBEDO_FLOOR)
        noisy = torch.where(x["noisy"].abs() < LARGEST, x["noisy"], 0) / divisor
        past, frames = self.past(x).split([3, 1], dim=1)
        length = frames + 1
        # Without a history its length is 0: the weight of the newest frame is 1.
        irradiance = past + (1 / length).clamp(min=SMALLEST_ALPHA) * (noisy - past)
        radiance = irradiance * divisor
        state, scale = updated_scale(x["scale"], radiance, x["depth"])
        predicted = self.network(self.features(x, radiance, scale).to(self.precision)).to(radiance)
        importance, mixture = predicted.chunk(2, dim=1)
        filtered = self.fusion(irradiance, importance, mixture, surface)
        return {
            "radiance": filtered * divisor * surface + x["emission"],
            "new_history": torch.cat([irradiance, length], dim=1),
            "new_scale": state,
        }
