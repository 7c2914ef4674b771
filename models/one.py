"""`one`: our own recurrent denoiser, made of convex kernels on irradiance and of history that surfaces vouch for."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from datasets.frame import Frame, Signal
from models import compiled
from models.affinity import affinity_level
from models.compiled import one as kernels
from models.denoiser import Denoiser, State, matching_state
from models.neighbours import mesh_means
from models.operators import pad_to_multiple
from models.parameters import (
    BRIGHTEST,
    FEWEST_SAMPLES,
    LARGEST_IRRADIANCE,
    LARGEST_LOGIT,
    LATENT,
    ONE_INPUTS,
    STEPS,
    outputs_of_one,
)
from models.reprojection import reproject
from models.running_scale import RunningScale, running_scale
from models.surfaces import Surfaces

DETAIL = 24  # hidden channels of what looks at every pixel alone
MULTIPLE = 8  # of the sides of an image that the network takes
CACHED = 8192  # pixels that are taken together, so that what is known of them stays in the cache


def conv(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, 3, padding=1), nn.ReLU(inplace=True))


def half(inputs: int, outputs: int) -> nn.Sequential:
    """At half the resolution."""
    return nn.Sequential(nn.Conv2d(inputs, outputs, 2, stride=2), nn.ReLU(inplace=True))


class Trunk(nn.Module):
    """A small U-Net at 1/2, 1/4 and 1/8 of the resolution, and what it says of every pixel."""

    def __init__(self, inputs: int, outputs: int, widths: tuple[int, int, int]):
        super().__init__()
        a, b, c = widths
        self.enter = nn.Sequential(half(inputs, a), conv(a, a))
        self.down_b = nn.Sequential(half(a, b), conv(b, b))
        self.down_c = nn.Sequential(half(b, c), conv(c, c), conv(c, c))
        self.up_b = nn.ConvTranspose2d(c, b, 2, stride=2)
        self.join_b = conv(b, b)
        self.up_a = nn.ConvTranspose2d(b, a, 2, stride=2)
        self.join_a = conv(a, a)
        self.leave = nn.ConvTranspose2d(a, outputs, 2, stride=2)
        self.detail = nn.Sequential(nn.Linear(inputs, DETAIL), nn.ReLU(), nn.Linear(DETAIL, outputs, bias=False))

    def of_patches(self, x: Tensor) -> Tensor:
        """What the U-Net adds to `detail`."""
        a = self.enter(x)
        b = self.down_b(a)
        c = self.down_c(b)
        b = self.join_b(b + self.up_b(c))
        a = self.join_a(a + self.up_a(b))
        leaving: Tensor = self.leave(a)
        return leaving

    def add_detail(self, outputs: Tensor, x: Tensor) -> None:
        """Add what `detail` says of x to `outputs`, whose channels come last in memory, in their place."""
        first, _, last = self.detail
        assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
        pixels, sums = (each.movedim(1, -1).view(-1, each.shape[1]) for each in (x, outputs))
        for some, total in zip(pixels.split(CACHED), sums.split(CACHED), strict=True):
            hidden = torch.addmm(first.bias, some, first.weight.t()).relu_()
            torch.addmm(total, hidden, last.weight.t(), out=total)

    def forward(self, x: Tensor) -> Tensor:
        """(B, outputs, H, W) of x (B, inputs, H, W), channels last in memory, whose sides are multiples of 8."""
        outputs = self.of_patches(x)
        if outputs.requires_grad or outputs.dtype != x.dtype:  # in training and, by autocast, in validation
            return outputs + self.detail(x.movedim(1, -1)).movedim(-1, 1)
        outputs = outputs.contiguous(memory_format=torch.channels_last)
        self.add_detail(outputs, x)
        return outputs


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


@dataclass(frozen=True)
class Evidence:
    """What is known of each pixel before the network speaks; irradiance, all (B, ·, H, W)."""

    noisy: Tensor
    near: Tensor  # mean over 3 x 3 pixels of the same mesh
    around: Tensor  # over 9 x 9
    deviation: Tensor  # relative one of luminance over 9 x 9
    output: Tensor  # of the frame before, or `around` where it was not found
    accumulated: Tensor
    length: Tensor  # 0 where not found
    latent: Tensor
    found: Tensor


def evidence_of(noisy: Tensor, means: tuple[Tensor, Tensor, Tensor], past: Tensor, found: Tensor) -> Evidence:
    """What follows from a frame's `noisy` irradiance, what mesh_means says of it, and the history.

    `past` (B, 7 + LATENT, H, W) holds output, accumulation, its length and latent channels where they were `found`
    (B, 1, H, W), 1 or 0.
    """
    near, around, deviation = means
    output = torch.where(found > 0, past[:, :3], around)
    accumulated = torch.where(found > 0, past[:, 3:6], noisy)
    length, latent = (past[:, 6:] * found).split([1, LATENT], dim=1)
    return Evidence(noisy, near, around, deviation, output, accumulated, length, latent, found)


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


@compiled.by(kernels.interpret)
def interpret(
    said: Tensor, noisy: Tensor, accumulated: Tensor, length: Tensor, found: Tensor, samples: Tensor
) -> tuple[Tensor, ...]:
    """What the outputs (B, ·, H, W) of the network mean, in the order of Said.

    The others are as in Evidence, samples (B, 1, 1, 1).

    The prior of the accumulation is the even mean of all samples: the network says how far to leave it. Where nothing
    was found there is nothing to mix with.
    """
    levels = (said.shape[1] - sum(outputs_of_one(0))) // 3
    features, sharpness, own, importance, alphas, latent = said.split(outputs_of_one(levels), dim=1)
    past = length.clamp(min=FEWEST_SAMPLES)
    prior = torch.cat([torch.log(past / samples), torch.zeros_like(past)], dim=1)
    alpha = torch.where(found > 0, torch.sigmoid(alphas - prior), 1)
    newest, kept = alpha[:, :1], 1 - alpha[:, :1]
    variance = newest.square() / samples + kept.square() / past
    logits = (each.clamp(-LARGEST_LOGIT, LARGEST_LOGIT) for each in (own, importance))
    accumulated = torch.lerp(accumulated, noisy, newest)
    return features, F.softplus(sharpness), *logits, alpha, torch.tanh(latent), accumulated, 1 / variance


@compiled.by(kernels.network_inputs)
def network_inputs(
    frame: Frame,
    scale: RunningScale,
    images: Sequence[Tensor],
    deviation: Tensor,
    length: Tensor,
    found: Tensor,
    latent: Tensor,
) -> Tensor:
    """What the network sees, (B, ·, H, W): logarithms of exposed irradiance, numbers of the history, surfaces.

    `images`, each (B, 3, H, W), are irradiance; the others as in Evidence.
    """
    exposed = torch.stack(list(images), dim=1).clamp(min=0) * (scale.exposure() * frame.gain)[:, None]
    colours = torch.log1p(exposed.clamp(max=BRIGHTEST)).flatten(1, 2)
    newest = (1 / frame.samples).expand_as(length)
    numbers = (torch.log1p(deviation), newest, 1 / (length + frame.samples), found)
    surfaces = (frame.albedo, frame.view_normal(), scale.normalised_depth(frame.depth), frame.roughness)
    return torch.cat([colours, *numbers, latent, *surfaces], dim=1)


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
    refuses: ClassVar = {torch.float16: "it is slower than float32 on processors, which bfloat16 is not"}
    is_network = True
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
        return evidence_of(noisy, mesh_means(noisy, frame.mesh_id), past, found)

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        """Denoised irradiance (B, 3, H, W), and the state for the next frame."""
        before = matching_state(state, OneState, frame)
        surface = (frame.depth > 0).to(frame.depth)
        noisy = frame.irradiance(self.signal).clamp(0.0, LARGEST_IRRADIANCE) * surface
        scale = running_scale(noisy * frame.divisor, frame.depth, before.scale if before else None, frame.whole)
        known = self.evidence(frame, noisy, surface, before)
        height, width = frame.size
        images = (known.noisy, known.near, known.around, known.output, known.accumulated)
        seen = network_inputs(frame, scale, images, known.deviation, known.length, known.found, known.latent)
        x = pad_to_multiple(seen, MULTIPLE)
        outputs = self.network(x.to(self.precision, memory_format=torch.channels_last))[..., :height, :width]
        past = (known.accumulated, known.length, known.found)
        said = Said(*interpret(outputs.to(noisy), noisy, *past, frame.samples.to(noisy)))
        image = said.accumulated
        planes = (each.split(1, dim=1) for each in (said.sharpness, said.own, said.importance))
        for step, sharpness, own, importance in zip(self.steps, *planes, strict=True):
            image = affinity_level(image, said.features, sharpness, own, importance, surface, step)
        output = torch.lerp(known.output, image, said.alpha[:, 1:]) * surface
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
