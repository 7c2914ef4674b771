"""`one`: our own recurrent denoiser: convex kernels, history that follows the light, and a coarse correction."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple, cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal, times_each
from models import compiled
from models.compiled import affinity as affinity_kernels
from models.compiled import one as kernels
from models.compiled import one_in_c
from models.compiled.affinity import MESH_DISTANCE, MIN_LOGIT
from models.compiled.one import (
    DARKEST,
    FILTER_PASSES,
    GUIDANCE,
    GUIDED_PASSES,
    HEAD_CHANNELS,
    INPUT_CHANNELS,
    LATENT,
    MAX_EXPOSED,
    MAX_LOGIT,
    MIN_LENGTH,
    OUTLIER,
    SIDE_MULTIPLE,
    SPREADING_PASSES,
)
from models.compiled.one_in_c import OneInC, StateInC
from models.denoiser import NO_FLOAT16, Denoiser, State, matching_state
from models.filters.neighbours import mesh_means, taps_3x3
from models.history.coarse_light import CoarseLight, correct_coarsely
from models.history.geometry import GBuffer
from models.history.light_gain import follow_light
from models.history.reprojection import reproject
from models.history.running_scale import RunningScale, running_scale
from models.networks.convolution import ConvReLU
from models.operators import MAX_IRRADIANCE, MIN_DIVISOR, STRIP_PIXELS, image_luminance, pad_to_multiple

DETAIL = 24  # hidden channels of the per-pixel layers
PATCH = 4  # pixels, 2 x 2
NETWORK_REACH = 32  # rows above and below that predictions depend on: 28 by the network, 4 by means of its inputs
NETWORK_SURFACE = ("albedo", "normal", "depth", "roughness", "mesh_id")  # channels that decoded_rows reads
MAX_PART = 100 * MAX_IRRADIANCE  # of either sign: parts of the light may cancel each other
HISTORY = (3, 3, 1, LATENT)  # channels: output and accumulated irradiance, the latter's effective length, latent
WHOLE = 6  # of these, the first: irradiance


class Trunk(nn.Module):
    """A small U-Net at 1/2, 1/4 and 1/8 of the resolution, and per-pixel layers that are added to it."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, int, int]):
        super().__init__()
        a, b, c = widths
        self.enter = nn.Sequential(ConvReLU(PATCH * inputs, a, 1), ConvReLU(a, a, 1))
        self.down_b = nn.Sequential(ConvReLU(a, b, 2, stride=2), ConvReLU(b, b))
        self.down_c = nn.Sequential(ConvReLU(b, c, 2, stride=2), ConvReLU(c, c), ConvReLU(c, c))
        self.up_b = nn.ConvTranspose2d(c, b, 2, stride=2)
        self.join_b = ConvReLU(b, b)
        self.up_a = nn.ConvTranspose2d(b, a, 2, stride=2)
        self.join_a = ConvReLU(a, a)
        self.leave = nn.ConvTranspose2d(a, outputs, 2, stride=2)
        # Per pixel; applied where inputs are computed and outputs decoded: see network_inputs and decode_head.
        self.detail = nn.Sequential(nn.Linear(inputs, DETAIL), nn.ReLU(), nn.Linear(DETAIL, outputs, bias=False))

    def forward(self, patches: Tensor) -> Tensor:
        """The U-Net's outputs (B, outputs, H, W) from patches_of (B, inputs, H, W)."""
        a = self.enter(patches)
        b = self.down_b(a)
        c = self.down_c(b)
        b = self.join_b(self.up_b(c).add_(b))
        a = self.join_a(self.up_a(b).add_(a))
        return cast(Tensor, self.leave(a))


@dataclass(frozen=True)
class OneState(State):
    """Denoised and accumulated irradiance, the latter's effective length, and latent channels."""

    output: Tensor  # (B, 3, H, W), before the coarse correction
    accumulated: Tensor  # (B, 3, H, W)
    length: Tensor  # (B, 1, H, W), samples
    latent: Tensor  # (B, LATENT, H, W)
    gbuffer: GBuffer
    scale: RunningScale
    alpha: Tensor  # (B, 2, H, W), of accumulation and output; for debugging
    part_output: Tensor  # of the P parts of the light, (B, 3 P, H, W)
    part_accumulated: Tensor
    coarse: CoarseLight

    def pictures(self) -> dict[str, Tensor]:
        return {
            "history length": self.length,
            "accumulated": self.accumulated,
            "weight of the frame in accumulation": self.alpha[:, :1],
            "weight of the frame in output": self.alpha[:, 1:],
            "coarse correction": self.coarse.corrected(torch.ones_like(self.length)),
        }


class PixelInputs(NamedTuple):
    """The irradiance inputs of each pixel, all (B, ·, H, W)."""

    noisy: Tensor
    mean_3x3: Tensor  # over pixels of the same mesh
    mean_9x9: Tensor
    deviation: Tensor  # of luminance over 9 x 9, relative
    history: Tensor  # reprojected channels HISTORY of the previous frame
    has_history: Tensor  # 1 where reprojection was validated, else 0: there history is undefined


class Decoded(NamedTuple):
    """Head outputs in the form that the filter takes, and the new accumulation."""

    features: Tensor  # (B, FEATURES, H, W)
    sharpness: Tensor  # (B, levels, H, W), as the next two: see affinity_level
    centre: Tensor
    importance: Tensor
    alpha: Tensor  # (B, 2, H, W), weights of this frame in the accumulation and in the output
    latent: Tensor  # (B, LATENT, H, W)
    accumulated: Tensor  # (B, 3, H, W)
    length: Tensor  # (B, 1, H, W)
    outliers: Tensor  # (B, 1, H, W), the share of the accumulation that is spread


def decode(head: Tensor, inputs: PixelInputs, samples: Tensor) -> tuple[Tensor, ...]:
    """Decoded, in order, from head outputs (B, ·, H, W) and the frame's samples (B, 1, 1, 1).

    The prior of the accumulation is the plain mean of all samples: α = σ(a - ln(length / samples)).
    """
    features, sharpness, centre, importance, alphas, latent = head.split([*HEAD_CHANNELS.values()], dim=1)
    length = inputs.history[:, 6:7].clamp(min=MIN_LENGTH)
    prior = torch.cat([torch.log(length / samples), torch.zeros_like(length)], dim=1)
    alpha = torch.where(inputs.has_history > 0, torch.sigmoid(alphas - prior), 1)
    newest, kept = alpha[:, :1], 1 - alpha[:, :1]
    variance = newest.square() / samples + kept.square() / length
    logits = (each.clamp(-MAX_LOGIT, MAX_LOGIT) for each in (centre, importance))
    accumulated = torch.lerp(inputs.history[:, 3:6], inputs.noisy, newest)
    bright, most = image_luminance(accumulated), OUTLIER * image_luminance(inputs.mean_9x9)
    outliers = (bright - most).clamp(min=0) / bright.clamp(min=MIN_DIVISOR)
    # Every level of the filter reads the features: make them contiguous once.
    features = features.contiguous()
    return features, F.softplus(sharpness), *logits, alpha, torch.tanh(latent), accumulated, 1 / variance, outliers


@compiled.by(kernels.decode_head)
def decode_head(
    head: Tensor, hidden: Tensor, last: nn.Linear, inputs: PixelInputs, samples: Tensor
) -> tuple[Tensor, ...]:
    """`decode` of the U-Net's outputs plus the layer `last` of `hidden` (B, ·, H, W)."""
    return decode(head + last(hidden.movedim(1, -1)).movedim(-1, 1), inputs, samples)


def plain_level(
    image: Tensor,
    features: Tensor,
    sharpness: Tensor,
    own: Tensor,
    importance: Tensor,
    surface: Tensor,
    mesh_id: Tensor,
    step: int,
    guide: Tensor | None = None,
) -> Tensor:
    """See affinity_level: the way that PyTorch takes."""
    count = features.shape[1]
    taps = taps_3x3(torch.cat([features, importance, surface, mesh_id, image], dim=1), step)
    distance = (taps[:, :count] - features[:, :, None]).square().sum(dim=1)
    distance = torch.where(taps[:, count + 2] == mesh_id, distance, distance + MESH_DISTANCE)
    if guide is not None:
        values, strength = guide.split(1, dim=1)
        distance = distance + strength * (taps_3x3(values, step)[:, 0] - values).square()
    exponent = (taps[:, count] - sharpness * distance).clamp(min=MIN_LOGIT)
    weight = torch.exp(torch.cat([exponent[:, :4], own, exponent[:, 5:]], dim=1)) * taps[:, count + 1]
    total = (taps[:, count + 3 :] * weight[:, None]).sum(dim=2)
    return torch.where(surface > 0, total / weight.sum(dim=1, keepdim=True).clamp(min=MIN_DIVISOR), 0)


class AffinityLevel(torch.autograd.Function):
    """Both directions by kernels for the processor."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        """The arguments are those of affinity_level, but the guide comes before the surface."""
        *given, surface, mesh_id, step = arguments
        out, total = affinity_kernels.filter_level(given, surface, mesh_id, step)
        ctx.step = step
        ctx.save_for_backward(*given, surface, mesh_id, out, total)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *given, surface, mesh_id, out, total = ctx.saved_tensors
        pulled = affinity_kernels.pull_level(gradients[0], given, surface, mesh_id, out, total, ctx.step)
        return *pulled, None, None, None


def affinity_level(
    image: Tensor,
    features: Tensor,
    sharpness: Tensor,
    own: Tensor,
    importance: Tensor,
    surface: Tensor,
    mesh_id: Tensor,
    step: int,
    guide: Tensor | None = None,
) -> Tensor:
    """One level of an à-trous transform by learned features: a convex mean over 3 x 3 taps `step` pixels apart.

    The weight of tap q for pixel p is exp(importance_q - sharpness_p |f_p - f_q|²), that of p itself exp(own_p): Isik
    et al. 2021, Eq. 4, with two weights more. Only pixels that show a surface count; the others become 0.
    Taps of another mesh are farther away: MESH_DISTANCE is added to the squared distance.
    image (B, C, H, W); features (B, F, H, W), F a multiple of 4; sharpness >= 0, own, importance, surface (1 or 0) and
    mesh_id (B, 1, H, W). own and importance lie in [-10, 10], so that no sum overflows. A guide (B, 2, H, W), values g
    and their strength k, adds k_p (g_p - g_q)² to the squared distance; strength gets no gradients.
    """
    maps = features, sharpness, own, importance
    if not compiled.usable(image):
        return plain_level(image, *maps, surface, mesh_id, step, guide)
    given = image, *maps, features[:, :0] if guide is None else guide
    return cast(Tensor, AffinityLevel.apply(*given, surface, mesh_id, step))


def luminance_guide(light: Tensor, length: Tensor, exposure: Tensor) -> Tensor:
    """The guide (B, 2, H, W) of the last levels, stronger the more samples there are, since these have less noise.

    light (B, ·, H, W): colours, parts of the light and the sum of weights; length (B, 1, H, W) in samples.
    """
    exposed = image_luminance(exposure * light[:, :3] / light[:, -1:].clamp(min=MIN_DIVISOR))
    return torch.cat([torch.log1p((exposed / DARKEST).clamp(max=MAX_EXPOSED)), GUIDANCE * length.detach()], dim=1)


def carried(
    decoded: Decoded,
    past: Tensor,
    surface: Tensor,
    mesh_id: Tensor,
    exposure: Tensor,
    level: Callable[..., Tensor] = affinity_level,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The channels HISTORY after a frame: the new accumulation, filtered level by level, is blended into the `past`.

    Outliers pass through coarse levels twice, which spreads them wider and cuts nothing off. After all levels some
    filter once more, guided by the luminance that there is by then. A channel of ones takes the same way: it
    becomes the sum of all weights, by which the result is divided. Weights are those of the whole, so that parts of the
    light add up to it: their images may follow the accumulation and the past output.
    """
    planes = (each.split(1, dim=1) for each in (decoded.sharpness, decoded.centre, decoded.importance))
    maps = [*zip(*planes, strict=True)]

    def filtered(image: Tensor, index: int, step: int, *guide: Tensor) -> Tensor:
        return level(image, decoded.features, *maps[index], surface, mesh_id, step, *guide)

    light = torch.cat([decoded.accumulated, surface], dim=1)
    outliers = decoded.outliers * light
    light = light - outliers
    for each in SPREADING_PASSES:
        outliers = filtered(outliers, *each)
    light = light + outliers
    for each in FILTER_PASSES:
        light = filtered(light, *each)
    for each in GUIDED_PASSES:
        light = filtered(light, *each, luminance_guide(light, decoded.length, exposure))
    image = light[:, :-1] / light[:, -1:].clamp(min=MIN_DIVISOR)
    output = torch.lerp(past[:, : image.shape[1]], image, decoded.alpha[:, 1:]) * surface
    return output, decoded.accumulated, decoded.length, decoded.latent


def patches_of(x: Tensor) -> Tensor:
    """Patches of 2 x 2 pixels, (B, 4 C, ⌈H / 8⌉ 4, ⌈W / 8⌉ 4), of x (B, C, H, W), whose borders are repeated.

    The channels of a pixel lie side by side: in the order of rows, columns, channels.
    """
    x = pad_to_multiple(x, SIDE_MULTIPLE)
    batch, channels, height, width = x.shape
    pixels = x.view(batch, channels, height // 2, 2, width // 2, 2).permute(0, 3, 5, 1, 2, 4)
    return pixels.reshape(batch, PATCH * channels, height // 2, width // 2)


def input_channels(inputs: PixelInputs, exposure: Tensor, samples: Tensor, surfaces: Sequence[Tensor]) -> Tensor:
    """The network's inputs (B, ·, H, W), in the order of INPUT_CHANNELS, for `samples` (B, 1, 1, 1) a pixel.

    `exposure` is that of the 15 channels of irradiance; `surfaces` are albedo, normals in view space, normalised depth
    and roughness.
    """
    output, accumulated, length, latent = inputs.history.split(HISTORY, dim=1)
    valid = inputs.has_history > 0
    past = torch.where(valid, output, inputs.mean_9x9), torch.where(valid, accumulated, inputs.noisy)
    light = torch.cat([inputs.noisy, inputs.mean_3x3, inputs.mean_9x9, *past], dim=1)
    per_pixel = (
        torch.log1p(inputs.deviation),
        (1 / samples).expand_as(length),
        1 / (length * inputs.has_history + samples),
        inputs.has_history,
        latent * inputs.has_history,
    )
    colours = torch.log1p((light.clamp(min=0) * exposure).clamp(max=MAX_EXPOSED))
    return torch.cat([colours, *per_pixel, *surfaces], dim=1)


@compiled.by(kernels.network_inputs)
def network_inputs(frame: Frame, scale: RunningScale, inputs: PixelInputs, hidden: nn.Linear) -> tuple[Tensor, Tensor]:
    """patches_of the network's inputs, and ReLU of the layer `hidden` of each pixel, (B, ·, H, W)."""
    exposure = (scale.exposure() * frame.gain).repeat(1, 5, 1, 1)
    surfaces = (frame.albedo, frame.view_normal(), scale.normalised_depth(frame.depth), frame.roughness)
    channels = input_channels(inputs, exposure, frame.samples, surfaces)
    pixels = torch.relu(hidden(channels.movedim(1, -1).to(hidden.weight.dtype))).movedim(-1, 1)
    return patches_of(channels), pixels


def fetched(before: OneState | None, frame: Frame, noisy: Tensor, surface: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of the previous frame, reprojected: the channels HISTORY, those of parts, and 1 where they are valid, else 0.

    Irradiance among them follows the changes of `noisy`, the frame's (B, 3, H, W).
    """
    parts = 3 * frame.part_count
    has_history = torch.zeros_like(surface)
    if before is None:
        nothing = has_history.expand(-1, sum(HISTORY), -1, -1)
        return nothing, has_history.expand(-1, 2 * parts, -1, -1), has_history
    lights = parts - 3 * frame.masks
    light, light_accumulated = (image[:, :lights] for image in (before.part_output, before.part_accumulated))
    mask, mask_accumulated = (image[:, lights:] for image in (before.part_output, before.part_accumulated))
    images = before.output, before.accumulated, light, light_accumulated
    others = before.length, before.latent, mask, mask_accumulated
    history, valid = reproject(frame, torch.cat([*images, *others], dim=1), before.gbuffer)
    has_history = valid.to(history) * surface
    history = follow_light(history, noisy, has_history, WHOLE + 2 * lights)
    if parts == 0:
        return history, history[:, :0], has_history
    sizes = WHOLE, lights, lights, 1 + LATENT, parts - lights, parts - lights
    whole, light, light_accumulated, rest, mask, mask_accumulated = history.split(sizes, dim=1)
    of_parts = torch.cat([light, mask, light_accumulated, mask_accumulated], dim=1)
    return torch.cat([whole, rest], dim=1), of_parts, has_history


def part_irradiance(frame: Frame, whole: Tensor, clamped: Tensor) -> Tensor:
    """Irradiance (B, 3 P, H, W) of the parts of the light, scaled where the `whole` (B, 3, H, W) was clamped."""
    assert frame.parts is not None
    factor = 1 / frame.divisor
    if not torch.equal(whole, clamped):
        factor = factor * torch.where(whole == clamped, 1, clamped / torch.where(whole == 0, 1, whole))
    return times_each(frame.parts, factor).clamp_(-MAX_PART, MAX_PART)


class One(Denoiser):
    """Recurrent kernel prediction. Without validated history, the weight of the current frame is 1."""

    made_from = "ours"
    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "mesh_id", "motion")
    refuses = NO_FLOAT16
    is_network = True
    inputs = INPUT_CHANNELS
    widths: ClassVar[tuple[int, int, int]] = (40, 56, 64)
    in_c: OneInC | None = None  # what computes in its place where it can, see use_c

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.network = Trunk(sum(INPUT_CHANNELS.values()), sum(HEAD_CHANNELS.values()), self.widths)

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        """Denoised irradiance (B, 3, H, W), and the state for the next frame."""
        before = matching_state(state, OneState, frame)
        if before and before.part_output.shape[1] != 3 * frame.part_count:
            before = None  # the parts would not add up to the whole
        surface = (frame.depth > 0).to(frame.depth)
        noisy = frame.irradiance(self.signal).clamp(0.0, MAX_IRRADIANCE) * surface
        decoded, past, scale = self.decoded(frame, before, noisy, surface)
        exposure = scale.exposure() * frame.gain
        output, accumulated, length, latent = carried(decoded, past, surface, frame.mesh_id, exposure)
        images = output[:, :3], accumulated[:, :3], length, latent
        parts = output[:, 3:], accumulated[:, 3:]
        coarse = correct_coarsely(noisy, images[0], exposure, surface, frame.motion, before.coarse if before else None)
        state = OneState(frame.moment, *images, GBuffer.of(frame), scale, decoded.alpha.detach(), *parts, coarse)
        return coarse.corrected(images[0]), state

    def decoded(
        self, frame: Frame, before: OneState | None, noisy: Tensor, surface: Tensor
    ) -> tuple[Decoded, Tensor, RunningScale]:
        """What the network predicts, the reprojected history, of large images its output alone, and the running scale.

        The filter needs nothing else: what only the network reads is freed on return. Parts of the light, if there
        are any, follow the whole in the accumulation, which has the same weights, and in the history's output.
        """
        scale = running_scale(noisy * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        history, part_history, has_history = fetched(before, frame, noisy, surface)
        decoded, past = self.decoded_frame(frame, scale, noisy, history, has_history)
        if frame.parts is not None:
            outputs, accumulated = part_history.chunk(2, dim=1)
            parts = part_irradiance(frame, frame.irradiance(self.signal), noisy)
            both = [decoded.accumulated, torch.lerp(accumulated, parts, decoded.alpha[:, :1])]
            decoded = decoded._replace(accumulated=torch.cat(both, dim=1))
            past = torch.cat([past[:, :3], outputs], dim=1)
        return decoded, past, scale

    def decoded_frame(
        self, frame: Frame, scale: RunningScale, noisy: Tensor, history: Tensor, has_history: Tensor
    ) -> tuple[Decoded, Tensor]:
        """What the network predicts, and the history, of large images its output alone."""
        height, width = frame.size
        if height * width <= STRIP_PIXELS or torch.is_grad_enabled():
            return self.decoded_rows(frame, scale, noisy, history, has_history), history
        # Large images in strips of rows: the network's activations would take most of the memory.
        rows = max(1, STRIP_PIXELS // 2 // width // SIDE_MULTIPLE) * SIDE_MULTIPLE
        channels = *HEAD_CHANNELS.values(), 3, 1, 1
        whole = Decoded(*(noisy.new_empty(len(noisy), count, height, width) for count in channels))
        for top in range(0, height, rows):
            first = max(0, top - NETWORK_REACH)
            needed = slice(first, top + rows + NETWORK_REACH)
            part = replace(frame, channels={name: frame.channels[name][..., needed, :] for name in NETWORK_SURFACE})
            strip = self.decoded_rows(part, scale, *(each[..., needed, :] for each in (noisy, history, has_history)))
            for image, values in zip(whole, strip, strict=True):
                image[..., top : top + rows, :] = values[..., top - first : top - first + rows, :]
        return whole, history[:, :3].clone()  # what else there is of the history is freed

    def decoded_rows(
        self, frame: Frame, scale: RunningScale, noisy: Tensor, history: Tensor, has_history: Tensor
    ) -> Decoded:
        """What the network predicts for a frame, or for some of its rows, of which it needs NETWORK_SURFACE."""
        inputs = PixelInputs(noisy, *mesh_means(noisy, frame.mesh_id), history, has_history)
        first, _, last = cast(Sequence[nn.Linear], self.network.detail)  # ReLU in between
        patches, hidden = network_inputs(frame, scale, inputs, first)
        height, width = frame.size
        head = self.network(patches.to(self.precision, memory_format=torch.channels_last))[..., :height, :width]
        return Decoded(*decode_head(head.to(inputs.noisy), hidden, last, inputs, frame.samples.to(inputs.noisy)))

    def c_digest(self) -> str | None:
        return one_in_c.digest() if self.widths == One.widths and one_in_c.is_available() else None

    def use_c(self) -> None:
        if self.c_digest():
            self.in_c = OneInC(self.network.state_dict())

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        if self.in_c and compiled.enabled and self.in_c.takes(frame):
            return self.in_c.denoise(frame, state, self.signal)
        irradiance, after = self.predict(frame, state)
        return frame.remodulate(irradiance, self.signal), after

    def parts(self, frame: Frame, state: State) -> Tensor:
        """Denoised radiance (B, 3 P, H, W) of the parts of the light of a frame, of which it returned the `state`.

        Kernels and weights of history are those of the whole, so parts that add up to the noisy light do so denoised.
        """
        assert isinstance(state, OneState | StateInC) and frame.parts is not None
        if isinstance(state, StateInC):
            assert state.parts is not None
            return state.parts
        lights = state.part_output.shape[1] - 3 * frame.masks
        light, masks = state.part_output[:, :lights], state.part_output[:, lights:]
        reflected = times_each(torch.cat([state.coarse.corrected(light), masks], dim=1), frame.divisor)
        return reflected if frame.surface is None else torch.where(frame.surface > 0, reflected, frame.parts)
