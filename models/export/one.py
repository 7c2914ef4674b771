"""`one` (models/networks/one.py) as a step: inputs, network and affinity filter in one graph.

Taps of its filters are slices, all in one tensor: exact in every engine, whereas convolutions round mesh ids and bright
pixels where engines shorten their inputs.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.compiled.affinity import MESH_DISTANCE, MIN_LOGIT
from models.compiled.light_gain import TILE
from models.compiled.one import SIDE_MULTIPLE
from models.export.history import in_whole_blocks, updated_scale
from models.export.step import (
    TILE_COLUMNS,
    TILE_ROWS,
    Port,
    Step,
    Warp,
    bounded,
    demodulation,
    image,
    tiles_and_1,
)
from models.filters.neighbours import means_of, summands
from models.history.coarse_light import COARSE_TILE, compared, correction_of
from models.history.light_gain import at_pixels, changes, gain_of
from models.networks.one import HISTORY, PATCH, WHOLE, Decoded, One, PixelInputs, carried, decode, input_channels
from models.operators import MAX_IRRADIANCE, MIN_DIVISOR

COARSE_PADDING = (0, 2, 0, 2)  # one more pixel of half the resolution, at the right and the bottom


def neighbour_taps(x: Tensor, step: int) -> Tensor:
    """The 3 x 3 taps `step` pixels apart of (1, C, H, W) but the middle one: (8, C, H, W), 0 outside the image."""
    padded = F.pad(x, (step, step, step, step))
    shifts = (slice(None, -2 * step), slice(step, -step), slice(2 * step, None))  # constants for images of any size
    rows = [padded[:, :, shift] for shift in shifts]
    taps = [row[..., shift] for row in rows for shift in shifts]
    return torch.cat(taps[:4] + taps[5:])


def mesh_sums(image: Tensor, mesh: Tensor, step: int) -> Tensor:
    """See models.filters.neighbours.mesh_sums. `mesh` (1, 1, H, W) is nowhere 0."""
    values, meshes = neighbour_taps(torch.cat([image, mesh], dim=1), step).split([image.shape[1], 1], dim=1)
    return image + torch.where(meshes == mesh, values, 0).sum(dim=0, keepdim=True)


def tile_sums(history: Tensor, noisy: Tensor, has_history: Tensor) -> Tensor:
    """See models.history.light_gain.tile_sums; with one row and one column of tiles more, which no pixel uses.

    The padding comes before `changes`: onnxruntime would merge it into the pooling, which takes no such wide padding.
    """
    padded = in_whole_blocks(torch.cat([history[:, :3], noisy, has_history], dim=1), TILE)
    return TILE**2 * F.avg_pool2d(changes(*padded.split([3, 3, 1], dim=1)), TILE)


def compared_sums(noisy: Tensor, denoised: Tensor, exposure: Tensor, surface: Tensor, motion: Tensor) -> Tensor:
    """Sums over tiles of models.history.coarse_light.compared; see tile_sums."""
    padded = in_whole_blocks(torch.cat([noisy, denoised, surface, motion], dim=1), COARSE_TILE)
    noisy, denoised, surface, motion = padded.split([3, 3, 1, 2], dim=1)
    return COARSE_TILE**2 * F.avg_pool2d(compared(noisy, denoised, exposure, surface, motion), COARSE_TILE)


def affinity_level(
    image: Tensor,
    features: Tensor,
    sharpness: Tensor,
    centre: Tensor,
    importance: Tensor,
    surface: Tensor,
    mesh: Tensor,
    step: int,
    guide: Tensor | None = None,
) -> Tensor:
    """See models.networks.one.affinity_level; `image` is 0 for background."""
    values = torch.cat([image, surface], dim=1)
    difference = neighbour_taps(features, step) - features
    distance = (difference * difference).sum(dim=1, keepdim=True)
    if guide is not None:
        bright, strength = guide.split(1, dim=1)
        change = neighbour_taps(bright, step) - bright
        distance = distance + strength * change * change
    taps = neighbour_taps(torch.cat([importance, mesh, values], dim=1), step)
    importances, meshes, neighbours = taps[:, :1], taps[:, 1:2], taps[:, 2:]
    distance = torch.where(meshes == mesh, distance, distance + MESH_DISTANCE)
    weight = torch.exp((importances - sharpness * distance).clamp(min=MIN_LOGIT))
    total = (weight * neighbours).sum(dim=0, keepdim=True) + torch.exp(centre) * values
    return torch.where(surface > 0, total[:, :-1] / total[:, -1:].clamp(min=MIN_DIVISOR), 0)


def pointwise(layer: nn.Module) -> nn.Module:
    """A layer on pixels as one on images: linear ones become convolutions of 1 x 1."""
    if not isinstance(layer, nn.Linear):
        return layer
    convolution = nn.Conv2d(layer.in_features, layer.out_features, 1, bias=layer.bias is not None)
    convolution.load_state_dict(layer.state_dict() | {"weight": layer.weight[:, :, None, None]})
    return convolution


def on_pixels(layer: nn.Module) -> nn.Sequential:
    """A layer on patches of 2 x 2 pixels as a strided one on pixels."""
    assert isinstance(layer, nn.Conv2d)
    outputs, inputs = layer.weight.shape[:2]
    convolution = nn.Conv2d(inputs // PATCH, outputs, 2, stride=2)
    weight = layer.weight.view(outputs, 2, 2, inputs // PATCH).permute(0, 3, 1, 2)
    convolution.load_state_dict({"weight": weight, "bias": layer.bias})
    return nn.Sequential(convolution, nn.ReLU())


def resized(x: Tensor, height: int, width: int) -> Tensor:
    """x (1, C, h, w) with borders repeated, or cropped, at the right and the bottom: (1, C, height, width).

    By indices, since a tracer cannot express how far a size is from a multiple of 8.
    """
    for dim, size in ((-2, height), (-1, width)):
        x = x.index_select(dim, torch.arange(size).clamp(max=x.shape[dim] - 1))
    return x


class Coarsest(nn.Sequential):
    """The layers at 1/8 of the resolution and the next, on images padded with zeros: a tracer needs two pixels."""

    def forward(self, x: Tensor) -> Tensor:
        *layers, up = self
        inside = F.pad(torch.ones_like(x[:, :1]), COARSE_PADDING)[..., ::2, ::2]
        x = F.pad(x, COARSE_PADDING)
        for layer in layers:
            x = layer(x) * inside
        return up(x)[..., :-2, :-2]


class OneStep(Step):
    """`one`. The denoiser is prepared for inference and must not be used afterwards."""

    reads = (
        *("noisy", "emission", "albedo", "normal", "depth", "roughness", "mesh_id"),
        *("motion", "camera_to_world", "samples"),
    )
    history = image(
        "history",
        sum(HISTORY),
        "output and accumulated irradiance, linear RGB each; effective length of the accumulation in samples; latent",
    )

    other_state = (
        Port(
            "residual",
            (1, 3, TILE_ROWS, TILE_COLUMNS),
            f"of tiles of {COARSE_TILE} px, (height + {2 * COARSE_TILE - 1}) // {COARSE_TILE} rows, columns likewise: "
            "relative residual of denoised luminance, its variance, how many frames; not reprojected",
        ),
    )

    def __init__(self, denoiser: One, warp: Warp):
        super().__init__(denoiser, warp)
        self.trunk = denoiser.network
        self.trunk.enter = nn.Sequential(on_pixels(self.trunk.enter[0]), *[*self.trunk.enter][1:])
        self.trunk.detail = nn.Sequential(*map(pointwise, self.trunk.detail))
        self.trunk.down_c = Coarsest(*self.trunk.down_c, self.trunk.up_b)
        self.trunk.up_b = nn.Identity()  # type: ignore[assignment]
        self.requires_grad_(False)

    def forward(self, x: dict[str, Tensor]) -> dict[str, Tensor]:
        x = bounded(x)
        noisy, divisor, surface = demodulation(x)
        noisy = noisy.clamp(0.0, MAX_IRRADIANCE) * surface
        state, exposure, depth = updated_scale(x["scale"], noisy * divisor, x["depth"])
        mesh = x["mesh_id"].to(noisy) + 1
        sums_3x3 = mesh_sums(summands(noisy), mesh, 1)
        means = means_of(sums_3x3, mesh_sums(sums_3x3, mesh, 3))
        history = self.reprojected_history(x)
        has_history = (history[:, WHOLE : WHOLE + 1] > 0).to(noisy) * surface  # after the first frame, no length is 0
        gain = at_pixels(gain_of(tile_sums(history, noisy, has_history)), *noisy.shape[-2:])
        history = torch.cat([history[:, :WHOLE] * gain, history[:, WHOLE:]], dim=1)
        inputs = PixelInputs(noisy, *means, history, has_history)
        to_view = torch.tensor((-1.0, 1.0, -1.0))[:, None] * x["camera_to_world"][:3, :3].T  # see Frame.to_view
        normal = (to_view @ x["normal"].view(3, -1)).view_as(x["normal"])
        surfaces = (x["albedo"], normal, depth, x["roughness"])
        channels = input_channels(inputs, exposure, x["samples"], surfaces)
        size = channels.shape[-2:]
        whole = (SIDE_MULTIPLE * ((side + SIDE_MULTIPLE - 1) // SIDE_MULTIPLE) for side in size)
        head = resized(self.trunk(resized(channels, *whole)), *size) + self.trunk.detail(channels)
        decoded = Decoded(*decode(head, inputs, x["samples"]))
        images = carried(decoded, history, surface, mesh, exposure, affinity_level)
        coarse = correction_of(
            compared_sums(noisy, images[0], exposure, surface, x["motion"]),
            x["residual"],
            (tiles_and_1(size[0]) - 1, tiles_and_1(size[1]) - 1),
        )
        return {
            "radiance": coarse.corrected(images[0]) * divisor + x["emission"],
            "new_history": torch.cat(images, dim=1),
            "new_scale": state,
            "new_residual": coarse.residual,
        }
