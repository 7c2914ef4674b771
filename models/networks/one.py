"""`one`: our own recurrent denoiser, made of convex kernels on irradiance and of history that surfaces vouch for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models import compiled
from models.compiled import one as kernels
from models.denoiser import Denoiser, State, matching_state
from models.filters.neighbours import mesh_means
from models.history.reprojection import reproject
from models.history.running_scale import RunningScale, running_scale
from models.history.surfaces import Surfaces
from models.networks.affinity import affinity_level
from models.networks.convolution import ConvReLU
from models.operators import pad_to_multiple
from models.parameters import (
    BRIGHTEST,
    FEWEST_SAMPLES,
    LARGEST_IRRADIANCE,
    LARGEST_LOGIT,
    LATENT,
    MULTIPLE,
    ONE_INPUTS,
    STEPS,
    outputs_of_one,
)

DETAIL = 24  # hidden channels of what looks at every pixel alone
PATCH = 4  # pixels, 2 x 2


class Trunk(nn.Module):
    """A small U-Net at 1/2, 1/4 and 1/8 of the resolution, and what is added to it of every pixel by itself."""

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
        # Applied where the inputs are made and the outputs read: see network_inputs and interpret.
        self.detail = nn.Sequential(nn.Linear(inputs, DETAIL), nn.ReLU(), nn.Linear(DETAIL, outputs, bias=False))

    @property
    def hidden(self) -> nn.Linear:
        """The first layer of `detail`."""
        layer = self.detail[0]
        assert isinstance(layer, nn.Linear)
        return layer

    @property
    def last(self) -> nn.Linear:
        """The second layer of `detail`."""
        layer = self.detail[2]
        assert isinstance(layer, nn.Linear)
        return layer

    def forward(self, patches: Tensor) -> Tensor:
        """What the U-Net says, (B, outputs, H, W), of patches_of (B, inputs, H, W)."""
        a = self.enter(patches)
        b = self.down_b(a)
        c = self.down_c(b)
        b = self.join_b(self.up_b(c).add_(b))
        a = self.join_a(self.up_a(b).add_(a))
        said: Tensor = self.leave(a)
        return said


@dataclass(frozen=True)
class OneState(State):
    """What is carried: irradiance denoised and merely accumulated, that one's effective length, latent channels."""

    output: Tensor  # (B, 3, H, W)
    accumulated: Tensor  # (B, 3, H, W)
    length: Tensor  # (B, 1, H, W), samples
    latent: Tensor  # (B, LATENT, H, W)
    surfaces: Surfaces
    scale: RunningScale
    alpha: Tensor  # (B, 2, H, W), of accumulation and output; to look at

    def pictures(self) -> dict[str, Tensor]:
        return {
            "history length": self.length,
            "accumulated": self.accumulated,
            "weight of the frame in accumulation": self.alpha[:, :1],
            "weight of the frame in output": self.alpha[:, 1:],
        }


class Evidence(NamedTuple):
    """What is known of each pixel before the network speaks; irradiance, all (B, ·, H, W)."""

    noisy: Tensor
    near: Tensor  # mean over 3 x 3 pixels of the same mesh
    around: Tensor  # over 9 x 9
    deviation: Tensor  # relative one of luminance over 9 x 9
    past: Tensor  # output of the frame before, accumulation, its length, latent channels; 7 + LATENT channels
    found: Tensor  # whether the past was found, 1 or 0; else it means nothing


class Said(NamedTuple):
    """What the network says of every pixel, in the form that the filter takes, and the accumulation that follows."""

    features: Tensor  # (B, COMPARED, H, W)
    sharpness: Tensor  # (B, levels, H, W), as the others of affinity_level
    own: Tensor
    importance: Tensor
    alpha: Tensor  # (B, 2, H, W), the weights of this frame in the accumulation and in the output
    latent: Tensor  # (B, LATENT, H, W)
    accumulated: Tensor  # (B, 3, H, W)
    length: Tensor  # (B, 1, H, W)


def meaning(said: Tensor, known: Evidence, samples: Tensor) -> tuple[Tensor, ...]:
    """What the outputs (B, ·, H, W) of the network mean, in the order of Said; samples are (B, 1, 1, 1).

    The prior of the accumulation is the even mean of all samples: the network says how far to leave it. Where nothing
    was found there is nothing to mix with.
    """
    levels = (said.shape[1] - sum(outputs_of_one(0))) // 3
    features, sharpness, own, importance, alphas, latent = said.split(outputs_of_one(levels), dim=1)
    past = known.past[:, 6:7].clamp(min=FEWEST_SAMPLES)
    prior = torch.cat([torch.log(past / samples), torch.zeros_like(past)], dim=1)
    alpha = torch.where(known.found > 0, torch.sigmoid(alphas - prior), 1)
    newest, kept = alpha[:, :1], 1 - alpha[:, :1]
    variance = newest.square() / samples + kept.square() / past
    logits = (each.clamp(-LARGEST_LOGIT, LARGEST_LOGIT) for each in (own, importance))
    accumulated = torch.lerp(known.past[:, 3:6], known.noisy, newest)
    # Every level of the filter reads the features: let none have to bring them together.
    return features.contiguous(), F.softplus(sharpness), *logits, alpha, torch.tanh(latent), accumulated, 1 / variance


@compiled.by(kernels.interpret)
def interpret(said: Tensor, hidden: Tensor, last: nn.Linear, known: Evidence, samples: Tensor) -> tuple[Tensor, ...]:
    """The meaning of what the U-Net said and what `last` makes of `hidden` (B, ·, H, W)."""
    return meaning(said + last(hidden.movedim(1, -1)).movedim(-1, 1), known, samples)


def patches_of(x: Tensor) -> Tensor:
    """Patches of 2 x 2 pixels, (B, 4 C, ⌈H / 8⌉ 4, ⌈W / 8⌉ 4), of x (B, C, H, W), whose borders are repeated.

    The channels of a pixel lie side by side: in the order of rows, columns, channels.
    """
    x = pad_to_multiple(x, MULTIPLE)
    batch, channels, height, width = x.shape
    pixels = x.view(batch, channels, height // 2, 2, width // 2, 2).permute(0, 3, 5, 1, 2, 4)
    return pixels.reshape(batch, PATCH * channels, height // 2, width // 2)


@compiled.by(kernels.network_inputs)
def network_inputs(frame: Frame, scale: RunningScale, known: Evidence, hidden: nn.Linear) -> tuple[Tensor, Tensor]:
    """What the network sees of pixels: logarithms of exposed irradiance, numbers of the history, surfaces.

    As patches_of images (B, ·, H, W); and what looks at every pixel alone makes of those, the outputs of the layer
    `hidden`, (B, ·, H, W).
    """
    output, accumulated, length, latent = known.past.split([3, 3, 1, LATENT], dim=1)
    found = known.found > 0
    output = torch.where(found, output, known.around)
    accumulated = torch.where(found, accumulated, known.noisy)
    exposed = torch.stack([known.noisy, known.near, known.around, output, accumulated], dim=1).clamp(min=0)
    exposed = exposed * (scale.exposure() * frame.gain)[:, None]
    colours = torch.log1p(exposed.clamp(max=BRIGHTEST)).flatten(1, 2)
    newest = (1 / frame.samples).expand_as(length)
    oldest = 1 / (length * known.found + frame.samples)
    numbers = (torch.log1p(known.deviation), newest, oldest, known.found, latent * known.found)
    surfaces = (frame.albedo, frame.view_normal(), scale.normalised_depth(frame.depth), frame.roughness)
    seen = torch.cat([colours, *numbers, *surfaces], dim=1)
    alone = torch.relu(hidden(seen.movedim(1, -1).to(hidden.weight.dtype))).movedim(-1, 1)
    return patches_of(seen), alone


class One(Denoiser):
    """Recurrent kernel prediction. Where no surface vouches for history, the weight of the frame is 1."""

    reads = (
        "direct",
        "indirect",
        "emission",
        "albedo",
        "normal",
        "depth",
        "roughness",
        "mesh_id",
        "motion",
    )
    refuses = dict.fromkeys((torch.float16,), "it is slower than float32 on processors, which bfloat16 is not")
    is_network = True
    convex = True
    widths: ClassVar[tuple[int, int, int]] = (40, 56, 64)

    def __init__(self, *, steps: Sequence[int] = STEPS, signal: Signal | None = None):
        """`steps` are the pixels between the taps of each level of the filter."""
        super().__init__(signal=signal)
        self.steps = steps
        self.inputs = dict(ONE_INPUTS)
        self.network = Trunk(sum(ONE_INPUTS.values()), sum(outputs_of_one(len(steps))), self.widths)

    def evidence(self, frame: Frame, noisy: Tensor, surface: Tensor, before: OneState | None) -> Evidence:
        found = torch.zeros_like(surface)
        past = found.expand(-1, 7 + LATENT, -1, -1)
        if before is not None:
            carried = torch.cat([before.output, before.accumulated, before.length, before.latent], dim=1)
            past, where = reproject(frame, carried, before.surfaces)
            found = where.to(noisy) * surface
        return Evidence(noisy, *mesh_means(noisy, frame.mesh_id), past, found)

    def speak(self, frame: Frame, scale: RunningScale, known: Evidence) -> Said:
        """What the network says of all that is known."""
        patches, hidden = network_inputs(frame, scale, known, self.network.hidden)
        height, width = frame.size
        said = self.network(patches.to(self.precision, memory_format=torch.channels_last))[..., :height, :width]
        said = said.to(known.noisy)
        return Said(*interpret(said, hidden, self.network.last, known, frame.samples.to(known.noisy)))

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        """Denoised irradiance (B, 3, H, W), and the state for the next frame."""
        before = matching_state(state, OneState, frame)
        surface = (frame.depth > 0).to(frame.depth)
        noisy = frame.irradiance(self.signal).clamp(0.0, LARGEST_IRRADIANCE) * surface
        scale = running_scale(noisy * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        known = self.evidence(frame, noisy, surface, before)
        said = self.speak(frame, scale, known)
        image = said.accumulated
        planes = (each.split(1, dim=1) for each in (said.sharpness, said.own, said.importance))
        for step, sharpness, own, importance in zip(self.steps, *planes, strict=True):
            image = affinity_level(image, said.features, sharpness, own, importance, surface, step)
        output = torch.lerp(known.past[:, :3], image, said.alpha[:, 1:]) * surface
        return output, OneState(
            frame.moment,
            output,
            said.accumulated,
            said.length,
            said.latent,
            Surfaces.of(frame),
            scale,
            said.alpha.detach(),
        )

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        irradiance, after = self.predict(frame, state)
        return frame.remodulate(irradiance, self.signal), after
