"""The ablations that the papers publish, and that of our own network, as data: what is trained, how, what was found."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

from errors import BadInput
from eval.ablation.one_without import WithoutHistory, WithoutLatent
from eval.ablation.textured_rae import TexturedRAE
from eval.extra_denoisers import WINDOW_SETS, windows_label
from eval.papers.tables import WSKP_TABLE_5
from models.denoiser import Denoiser
from models.one import One
from models.parameters import STEPS, WINDOWS
from models.rae import AUXILIARY, RAE
from models.registry import create
from models.wskp import KP, WSKP
from train.losses.displayed import DisplayedTerms
from train.losses.network_loss import LossTerms
from train.losses.rae import RAETerms
from train.recipe import Recipe
from train.recipes import recipe_for

SHARE_OF_EPOCHS = 1 / 4  # of a budget's; an ablation trains up to eleven networks
SINGLE_WINDOWS = [(window,) for window in WINDOWS]
WINDOWS_SO_FAR = list(WINDOW_SETS.values())  # the first is the first of SINGLE_WINDOWS
ONE_CONVOLUTION = (5,)  # instead of RepVGG's branches: its size is that of their sum

Pair = tuple[str, str]  # labels


@dataclass(frozen=True)
class AblationVariant:
    """One network of an ablation.

    Attributes:
        label: names its folder.
        base: the denoiser whose recipe it is trained by.
        create: makes it with fresh weights.
        loss: instead of the recipe's.
        paper: what the paper measured, on its own scenes.
    """

    label: str
    base: str
    create: Callable[[], Denoiser]
    loss: LossTerms | None = None
    paper: str = "-"

    def recipe(self, budget: str) -> Recipe:
        """The base's recipe in a budget, for SHARE_OF_EPOCHS of its epochs, and with its paper's loss in any.

        Raises BadInput for an unknown budget.
        """
        recipe = recipe_for(self.base, budget)
        loss = self.loss or recipe_for(self.base, "paper").loss
        return replace(recipe, epochs=max(1, round(SHARE_OF_EPOCHS * recipe.epochs)), loss=loss)


@dataclass(frozen=True)
class Finding:
    """What a paper found: by `metric`, the first variant of each pair is better than the second."""

    text: str
    metric: str
    pairs: tuple[Pair, ...]


@dataclass(frozen=True)
class Ablation:
    """A table or figure of a paper.

    Attributes:
        source: the paper, and where in it.
        metrics: those of its table, and of its plot if that shows points.
        plot: "curves" of the loss, quality against "windows", or a panel of "points" for each metric.
        moving: judge on clips in which meshes move.
    """

    source: str
    variants: tuple[AblationVariant, ...]
    metrics: tuple[str, ...]
    findings: tuple[Finding, ...]
    plot: Literal["curves", "windows", "points"] = "points"
    moving: bool = False

    @property
    def timed(self) -> bool:
        return "fusion_ms" in self.metrics


def rising(*labels: str) -> tuple[Pair, ...]:
    """Pairs of an order from the worst to the best."""
    return tuple((better, worse) for worse, better in pairwise(labels))


def rae_inputs() -> Ablation:
    names = tuple(AUXILIARY)
    added = [
        AblationVariant(f"+{name}", "rae", partial(RAE, names[:count])) for count, name in enumerate(names, start=1)
    ]
    variants = (
        AblationVariant("textured", "rae", partial(TexturedRAE, ())),
        AblationVariant("untextured", "rae", partial(RAE, ())),
        *added,
    )
    order = rising(*(variant.label for variant in variants))
    return Ablation(
        source="Chaitanya et al. 2017, §5.1, Fig. 3",
        variants=variants,
        metrics=("train_loss", "rmse", "psnr", "ssim"),
        findings=(
            Finding("demodulation and each further input lower the training loss", "train_loss", order),
            Finding("demodulation and each further input help (on test clips)", "ssim", order),
        ),
        plot="curves",
    )


def rae_loss() -> Ablation:
    return Ablation(
        source="Chaitanya et al. 2017, §4.4",
        variants=(
            AblationVariant("spatial", "rae", RAE, RAETerms(gradient=0.0, temporal=0.0), paper="SSIM 0.9335"),
            AblationVariant("+gradient", "rae", RAE, RAETerms(temporal=0.0)),
            AblationVariant("+temporal", "rae", RAE, RAETerms(), paper="SSIM 0.9417"),
        ),
        metrics=("ssim", "psnr", "temporal_error"),
        findings=(Finding("all three terms together beat the spatial one alone", "ssim", (("+temporal", "spatial"),)),),
    )


def wskp_windows() -> Ablation:
    alone = [windows_label(windows) for windows in SINGLE_WINDOWS]
    so_far = [windows_label(windows) for windows in WINDOWS_SO_FAR]
    every = so_far[-1]
    return Ablation(
        source="Fan et al. 2021, §7.1, Fig. 9 and 10",
        variants=tuple(
            AblationVariant(windows_label(windows), "wskp6", partial(WSKP, windows=windows))
            for windows in (*SINGLE_WINDOWS, *WINDOWS_SO_FAR[1:])
        ),
        metrics=("psnr", "ssim", "fusion_ms"),
        findings=(
            Finding("all windows together beat each alone", "psnr", tuple((every, label) for label in alone)),
            Finding("the more windows, the better", "psnr", rising(*so_far)),
            Finding("alone, windows over 9 are the worse the larger", "psnr", rising("13", "11", "9")),
            Finding("the more windows, the slower", "fusion_ms", rising(*reversed(so_far))),
        ),
        plot="windows",
    )


def in_table_5(method: str) -> str:
    """PSNR and SSIM that WSKP's Table 5 prints for a method, scene by scene."""
    scores = WSKP_TABLE_5.values[method]
    scenes = zip(WSKP_TABLE_5.scenes, scores["psnr"], scores["ssim"], strict=True)
    return ", ".join(f"{scene} {psnr:.3f} / {ssim:.4f}" for scene, psnr, ssim in scenes)


def wskp_repvgg() -> Ablation:
    plain_wskp = partial(WSKP, sizes=ONE_CONVOLUTION)
    plain_kp = partial(KP, sizes=ONE_CONVOLUTION)
    pairs = (("wskp6", "wskp6-plain"), ("kp", "kp-plain"))
    return Ablation(
        source="Fan et al. 2021, §7.1, Table 5 (PSNR / SSIM)",
        variants=(
            AblationVariant("wskp6-plain", "wskp6", plain_wskp, paper=in_table_5("Ours w/o RepVGG")),
            AblationVariant("wskp6", "wskp6", WSKP, paper=in_table_5("Ours w/ RepVGG")),
            AblationVariant("kp-plain", "kp", plain_kp, paper=in_table_5("KP w/o RepVGG")),
            AblationVariant("kp", "kp", KP, paper=in_table_5("KP w/ RepVGG")),
        ),
        metrics=("psnr", "ssim"),
        findings=tuple(Finding("RepVGG blocks help both networks", metric, pairs) for metric in ("psnr", "ssim")),
    )


def ntd() -> Ablation:
    seen = {
        "ntd-a": "A: serious ghosting and overblur",
        "ntd-b": "B: minor ghosting",
        "ntd": "C: neither",
    }
    text = "dual vectors, then the occlusion loss, help where things come into view"
    return Ablation(
        source="Zeng et al., §6.3, Table 1 and Fig. 10 (in words)",
        variants=tuple(AblationVariant(name, name, partial(create, name), paper=paper) for name, paper in seen.items()),
        metrics=("disocclusion_l1", "psnr", "ssim", "temporal_error"),
        findings=(Finding(text, "disocclusion_l1", rising(*seen)),),
        moving=True,
    )


def one() -> Ablation:
    """Ours: what each part of the design is for."""
    variants = (
        AblationVariant("one", "one", One),
        AblationVariant("without-history", "one", WithoutHistory),
        AblationVariant("without-latent", "one", WithoutLatent),
        AblationVariant("four-levels", "one", partial(One, steps=STEPS[2:])),
        AblationVariant("fine-levels-first", "one", partial(One, steps=STEPS[::-1])),
        AblationVariant("pixels-alone", "one", One, DisplayedTerms(scales=(1,))),
        AblationVariant("frames-alone", "one", One, DisplayedTerms(temporal=0.0)),
    )
    pairs = tuple(("one", variant.label) for variant in variants[1:-1])
    return Ablation(
        source="ours: a part of the network left out, or of its loss",
        variants=variants,
        metrics=("psnr", "ssim", "flip", "temporal_error"),
        findings=(
            Finding("every part is worth having", "psnr", pairs),
            Finding("a loss of changes steadies it", "temporal_error", (("one", "frames-alone"),)),
        ),
    )


ABLATIONS: dict[str, Callable[[], Ablation]] = {
    "rae-inputs": rae_inputs,
    "rae-loss": rae_loss,
    "wskp-windows": wskp_windows,
    "wskp-repvgg": wskp_repvgg,
    "ntd": ntd,
    "one": one,
}


def ablation_for(what: str) -> Ablation:
    """Raises BadInput for an unknown one."""
    if what not in ABLATIONS:
        raise BadInput(f"unknown ablation '{what}'; those are {', '.join(ABLATIONS)}")
    return ABLATIONS[what]()
