"""`one` (models/networks/one.py) as a step: inputs, network and affinity filter in one graph."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.compiled.one import MAX_EXPOSED, SIDE_MULTIPLE
from models.export.neighbours import affinity_level, mesh_sums
from models.export.recurrent import RecurrentStep, demodulation
from models.export.scale import Scale, updated_scale
from models.export.step import Warp, image
from models.filters.neighbours import means_of, summands
from models.networks.one import (
    HISTORY,
    PATCH,
    Decoded,
    One,
    PixelInputs,
    decode,
    exposed_images,
    per_pixel_inputs,
    surface_inputs,
)
from models.operators import MAX_IRRADIANCE

READS = (
    "noisy",
    "emission",
    "albedo",
    "normal",
    "depth",
    "roughness",
    "mesh_id",
    "camera_to_world",
    "samples",
)
ONE_HISTORY = image(
    "history",
    sum(HISTORY),
    "denoised and accumulated irradiance, linear RGB each; the accumulation's length in samples; latent channels",
)
TO_VIEW = (-1.0, 1.0, -1.0)  # see Frame.to_view
MARGIN = (0, 2, 0, 2)  # one more pixel of half the resolution, at the right and the bottom


def pointwise(layers: nn.Sequential) -> nn.Sequential:
    """The same layers on images: linear ones as convolutions of 1 x 1."""
    plain: list[nn.Module] = []
    for layer in layers:
        if isinstance(layer, nn.Linear):
            convolution = nn.Conv2d(layer.in_features, layer.out_features, 1, bias=layer.bias is not None)
            convolution.load_state_dict(layer.state_dict() | {"weight": layer.weight[:, :, None, None]})
            layer = convolution
        plain.append(layer)
    return nn.Sequential(*plain)


def of_pixels(layer: nn.Module) -> nn.Sequential:
    """A layer on patches of 2 x 2 pixels as one on pixels."""
    assert isinstance(layer, nn.Conv2d)
    outputs, inputs = layer.weight.shape[:2]
    convolution = nn.Conv2d(inputs // PATCH, outputs, 2, stride=2)
    weight = layer.weight.view(outputs, 2, 2, inputs // PATCH).permute(0, 3, 1, 2)
    convolution.load_state_dict({"weight": weight, "bias": layer.bias})
    return nn.Sequential(convolution, nn.ReLU())


def resized(x: Tensor, height: int, width: int) -> Tensor:
    """x (1, C, h, w) with borders repeated, or cut off, at the right and the bottom: (1, C, height, width).

    By indices: tracers cannot tell how far an image is from a multiple of 8.
    """
    for dim, size in ((-2, height), (-1, width)):
        x = x.index_select(dim, torch.arange(size).clamp(max=x.shape[dim] - 1))
    return x


class Coarsest(nn.Sequential):
    """The network's layers at 1/8 of the resolution, with zeros beside: tracers must know that there are two pixels."""

    def forward(self, x: Tensor) -> Tensor:
        inside = F.pad(torch.ones_like(x[:, :1]), MARGIN)[..., ::2, ::2]
        x = F.pad(x, MARGIN)
        for layer in self:
            x = layer(x) * inside
        return x


class WithoutMargin(nn.Module):
    """What `Coarsest` has added, cut off at twice its resolution."""

    def forward(self, x: Tensor) -> Tensor:
        return x[..., :-2, :-2]


class OneStep(RecurrentStep):
    """`one`, prepared for inference, which must not be used any more."""

    def __init__(self, denoiser: One, warp: Warp):
        super().__init__(READS, ONE_HISTORY, warp)
        self.steps = tuple(denoiser.steps)
        self.trunk = denoiser.network
        self.trunk.enter = nn.Sequential(of_pixels(self.trunk.enter[0]), *[*self.trunk.enter][1:])
        self.trunk.detail = pointwise(self.trunk.detail)
        self.trunk.down_c = Coarsest(*self.trunk.down_c)
        self.trunk.up_b = nn.Sequential(self.trunk.up_b, WithoutMargin())  # type: ignore[assignment]
        self.requires_grad_(False)

    def pixel_inputs(self, x: dict[str, Tensor], noisy: Tensor, surface: Tensor) -> PixelInputs:
        """As One.pixel_inputs."""
        mesh = x["mesh_id"].to(noisy) + 1
        close = mesh_sums(summands(noisy), mesh, 1)
        means = means_of(close, mesh_sums(close, mesh, 3))
        history = self.past(x)
        has_history = (history[:, 6:7] > 0).to(noisy) * surface  # after the first frame, no length is 0
        return PixelInputs(noisy, *means, history, has_history)

    def network_inputs(self, x: dict[str, Tensor], inputs: PixelInputs, scale: Scale) -> Tensor:
        """As models.networks.one.network_inputs, for pixels."""
        images = torch.cat(exposed_images(inputs), dim=1)
        colours = torch.log1p((images.clamp(min=0) * scale.exposure).clamp(max=MAX_EXPOSED))
        to_view = torch.tensor(TO_VIEW)[:, None] * x["camera_to_world"][:3, :3].T
        normal = (to_view @ x["normal"].view(3, -1)).view_as(x["normal"])
        surfaces = surface_inputs(x["albedo"], normal, scale.normalised_depth(x["depth"]), x["roughness"])
        return torch.cat([colours, *per_pixel_inputs(inputs, x["samples"]), *surfaces], dim=1)

    def network(self, channels: Tensor) -> Tensor:
        """The head outputs (1, ·, H, W)."""
        height, width = channels.shape[-2:]
        whole = (SIDE_MULTIPLE * ((size + SIDE_MULTIPLE - 1) // SIDE_MULTIPLE) for size in (height, width))
        return resized(self.trunk(resized(channels, *whole)), height, width) + self.trunk.detail(channels)

    def forward(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        x = tensors
        noisy, divisor, surface = demodulation(x)
        noisy = noisy.clamp(0.0, MAX_IRRADIANCE) * surface
        state, scale = updated_scale(x["scale"], noisy * divisor, x["depth"])
        inputs = self.pixel_inputs(x, noisy, surface)
        head = self.network(self.network_inputs(x, inputs, scale))
        decoded = Decoded(*decode(head, inputs, x["samples"]))
        filtered = decoded.accumulated
        planes = (each.split(1, dim=1) for each in (decoded.sharpness, decoded.centre, decoded.importance))
        for step, sharpness, centre, importance in zip(self.steps, *planes, strict=True):
            filtered = affinity_level(filtered, decoded.features, sharpness, centre, importance, surface, step)
        output = torch.lerp(inputs.history[:, :3], filtered, decoded.alpha[:, 1:]) * surface
        return {
            "radiance": output * divisor + x["emission"],
            "new_history": torch.cat([output, decoded.accumulated, decoded.length, decoded.latent], dim=1),
            "new_scale": state,
        }
