"""The ablations that the papers publish, as data: which networks are trained, how, and what the papers found."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor

from datasets.frame import Frame
from errors import BadInput
from models.denoiser import Denoiser, State
from models.parameters import WINDOWS
from models.rae import AUXILIARY, RAE, RAEState
from models.registry import create
from models.wskp import KP, WSKP
from train.losses.rae import RAETerms
from train.recipe import Recipe
from train.recipes import recipe_for

SHARE = 1 / 4  # of the profile's epochs; an ablation trains up to eleven networks
SINGLE = [(window,) for window in WINDOWS]
CUMULATIVE = [WINDOWS[:count] for count in range(1, len(WINDOWS) + 1)]  # the first is the first of SINGLE
PLAIN = (5,)  # sizes of convolutions without RepVGG: one, as large as the branches' sum

Pair = tuple[str, str]


@dataclass(frozen=True)
class Variant:
    """One network of an ablation. `label` names its folder."""

    label: str
    base: str  # the denoiser whose recipe it is trained by
    create: Callable[[], Denoiser]
    loss: RAETerms | None = None  # instead of the recipe's
    paper: str = "-"  # what the paper measured, on its own scenes

    def recipe(self, profile: str) -> Recipe:
        """The base's recipe in a profile, for SHARE of its epochs. Raises BadInput for an unknown profile."""
        recipe = recipe_for(self.base, profile)
        return replace(recipe, epochs=max(1, round(SHARE * recipe.epochs)), loss=self.loss or recipe.loss)


@dataclass(frozen=True)
class Finding:
    """What a paper found: by `metric`, the first variant of each pair is better than the second."""

    text: str
    metric: str
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Ablation:
    """A table or figure of a paper."""

    source: str
    variants: tuple[Variant, ...]
    metrics: tuple[str, ...]  # of its table, and of its plot if that shows points
    findings: tuple[Finding, ...]
    plot: Literal["curves", "windows", "points"] = "points"
    moving: bool = False  # judge on clips in which meshes move

    @property
    def timed(self) -> bool:
        return "fusion_ms" in self.metrics


def rising(*labels: str) -> tuple[Pair, ...]:
    """Pairs of an order from the worst to the best."""
    return tuple((better, worse) for worse, better in pairwise(labels))


class TexturedRAE(RAE):
    """RAE on colour that is not demodulated: every surface counts as white (§5.1)."""

    @staticmethod
    def white(frame: Frame) -> Frame:
        return replace(frame, channels=frame.channels | {"albedo": torch.ones_like(frame.albedo)})

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, RAEState]:
        return super().predict(self.white(frame), state)

    def target(self, frame: Frame) -> Tensor:
        """Radiance without emission, (B, 3, H, W)."""
        return super().target(self.white(frame))

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return super().forward(self.white(frame), state)


def rae_inputs() -> Ablation:
    names = tuple(AUXILIARY)
    added = [Variant(f"+{name}", "rae", partial(RAE, names[: i + 1])) for i, name in enumerate(names)]
    start = [Variant("textured", "rae", partial(TexturedRAE, ())), Variant("untextured", "rae", partial(RAE, ()))]
    order = rising(*(variant.label for variant in [*start, *added]))
    findings = (
        Finding("demodulation and each further input lower the training loss", "train_loss", order),
        Finding("demodulation and each further input help (on test clips)", "ssim", order),
    )
    metrics = ("train_loss", "rmse", "psnr", "ssim")
    return Ablation("Chaitanya et al. 2017, §5.1, Fig. 3", (*start, *added), metrics, findings, "curves")


def rae_loss() -> Ablation:
    spatial, gradient = RAETerms(gradient=0.0, temporal=0.0), RAETerms(temporal=0.0)
    variants = (
        Variant("spatial", "rae", RAE, spatial, "SSIM 0.9335"),
        Variant("+gradient", "rae", RAE, gradient),
        Variant("+temporal", "rae", RAE, RAETerms(), "SSIM 0.9417"),
    )
    finding = Finding("all three terms together beat the spatial one alone", "ssim", (("+temporal", "spatial"),))
    return Ablation("Chaitanya et al. 2017, §4.4", variants, ("ssim", "psnr", "temporal_error"), (finding,))


def label_of(windows: Sequence[int]) -> str:
    return "+".join(map(str, windows))


def wskp_windows() -> Ablation:
    choices = [*SINGLE, *CUMULATIVE[1:]]
    variants = tuple(Variant(label_of(windows), "wskp6", partial(WSKP, windows=windows)) for windows in choices)
    every, counts = label_of(WINDOWS), [label_of(windows) for windows in CUMULATIVE]
    findings = (
        Finding("all windows together beat each alone", "psnr", tuple((every, label_of(alone)) for alone in SINGLE)),
        Finding("the more windows, the better", "psnr", rising(*counts)),
        Finding("alone, windows over 9 are the worse the larger", "psnr", rising("13", "11", "9")),
        Finding("the more windows, the slower", "fusion_ms", rising(*reversed(counts))),
    )
    source = "Fan et al. 2021, §7.1, Fig. 9 and 10"
    return Ablation(source, variants, ("psnr", "ssim", "fusion_ms"), findings, "windows")


def wskp_repvgg() -> Ablation:
    def paper(*rooms: str) -> str:
        return ", ".join(f"{name} {room}" for name, room in zip(("Living room", "Sponza"), rooms, strict=True))

    variants = (
        Variant("wskp6-plain", "wskp6", partial(WSKP, sizes=PLAIN), None, paper("33.470 / 0.9754", "33.925 / 0.9813")),
        Variant("wskp6", "wskp6", WSKP, None, paper("34.063 / 0.9789", "34.600 / 0.9830")),
        Variant("kp-plain", "kp", partial(KP, sizes=PLAIN), None, paper("33.962 / 0.9771", "34.541 / 0.9829")),
        Variant("kp", "kp", KP, None, paper("34.090 / 0.9781", "34.595 / 0.9830")),
    )
    pairs = (("wskp6", "wskp6-plain"), ("kp", "kp-plain"))
    findings = tuple(Finding("RepVGG blocks help both networks", metric, pairs) for metric in ("psnr", "ssim"))
    return Ablation("Fan et al. 2021, §7.1, Table 5 (PSNR / SSIM)", variants, ("psnr", "ssim"), findings)


def ntd() -> Ablation:
    names = {
        "ntd-a": "A: serious ghosting and overblur",
        "ntd-b": "B: minor ghosting",
        "ntd": "C: neither",
    }
    variants = tuple(Variant(name, name, partial(create, name), None, paper) for name, paper in names.items())
    text = "dual vectors, then the occlusion loss, help where things come into view"
    finding = Finding(text, "disocclusion_l1", rising(*names))
    metrics = ("disocclusion_l1", "psnr", "ssim", "temporal_error")
    return Ablation("Zeng et al., §6.3, Table 1 and Fig. 10 (in words)", variants, metrics, (finding,), moving=True)


ABLATIONS: dict[str, Callable[[], Ablation]] = {
    "rae-inputs": rae_inputs,
    "rae-loss": rae_loss,
    "wskp-windows": wskp_windows,
    "wskp-repvgg": wskp_repvgg,
    "ntd": ntd,
}


def ablation_for(what: str) -> Ablation:
    """Raises BadInput for an unknown one."""
    if what not in ABLATIONS:
        raise BadInput(f"unknown ablation '{what}'; those are {', '.join(ABLATIONS)}")
    return ABLATIONS[what]()
