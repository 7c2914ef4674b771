"""Results as tables: means over clips and each clip, with noise floors; values within their noise floor are marked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tabulate import tabulate

from errors import BadInput
from eval.means import AGES, mean_floor, means_by_age, scores_of
from eval.metrics import METRICS, Values, within_floor
from eval.results import FLOOR, ClipResults, by_signal, of_one_spp, results_of
from models.registry import prototype

PRINTED = ("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1")
NEAR_FLOOR = "≈"
LEGEND = f"{NEAR_FLOOR} within the noise floor: as close to the truth as the reference; differences are not significant"
MEAN = "mean of clips of 1 spp"  # instead of a clip's name


def value_cell(metric: str, value: float | None, floor: float | None = None) -> str:
    """A number, marked if it is within its noise floor."""
    if value is None:
        return "-"
    mark = NEAR_FLOOR if within_floor(metric, value, floor) else ""
    return mark + METRICS[metric].form.format(value)


def with_legend(table: str) -> str:
    """The table, with an explanation of the marks below it if there are any."""
    return f"{table}\n{LEGEND}" if NEAR_FLOOR in table else table


@dataclass(frozen=True)
class TableRow:
    """A denoiser on a clip, or the noise floor."""

    clip: str
    denoiser: str
    signal: str
    values: Values
    floors: Values
    nonfinite: int = 0
    best: frozenset[str] = frozenset()  # the metrics in which it is the best of its clip and signal

    @property
    def is_floor(self) -> bool:
        return self.denoiser == FLOOR

    @property
    def is_mean(self) -> bool:
        return self.clip == MEAN

    @property
    def made_from(self) -> str:
        """What the implementation of its denoiser follows; "-" for one that is here no more."""
        try:
            return "-" if self.is_floor else prototype(self.denoiser).made_from
        except BadInput:
            return "-"

    def text(self, metric: str) -> str:
        """The value, marked if it is within its noise floor, or a noise floor that is a standard error."""
        value = self.values.get(metric)
        if not self.is_floor:
            return value_cell(metric, value, self.floors.get(metric))
        mark = "±" if METRICS[metric].floor_is_error and value is not None else ""
        return mark + value_cell(metric, value)

    def near(self, metric: str) -> bool:
        """Whether the value is within its noise floor."""
        return not self.is_floor and within_floor(metric, self.values.get(metric), self.floors.get(metric))


def table_rows(clips: Sequence[ClipResults]) -> list[TableRow]:
    """Means over the clips of 1 spp, if there are several, then the rows of each clip."""
    groups = [mean_rows(ours) for ours in by_signal(of_one_spp(clips)).values() if len(ours) > 1]
    groups += [clip_rows(clip) for clip in clips]
    return [row for rows in groups for row in with_best(rows)]


def clip_rows(clip: ClipResults) -> list[TableRow]:
    """The denoisers on one clip, and the noise floor."""
    name = f"{clip.scene}/{clip.clip}"
    floors = clip.reference.metrics
    rows = [TableRow(name, r.denoiser, clip.signal, r.metrics, floors, r.nonfinite) for r in clip.results]
    return [*rows, TableRow(name, FLOOR, clip.signal, floors, floors)]


def mean_rows(clips: Sequence[ClipResults]) -> list[TableRow]:
    """Means of the denoisers over clips of one signal, and that of the noise floors."""
    signal = clips[0].signal
    rows = []
    for name in (result.denoiser for result in clips[0].results):
        scores = scores_of(clips, name)
        nonfinite = sum(result.nonfinite for result in results_of(clips, name))
        rows.append(TableRow(MEAN, name, signal, scores.means, scores.joint_floor, nonfinite))
    floor = mean_floor([clip.reference.metrics for clip in clips])
    return [*rows, TableRow(MEAN, FLOOR, signal, floor, floor)]


def with_best(rows: Sequence[TableRow]) -> list[TableRow]:
    """The rows of one clip and signal, with `best` set."""
    best = {metric: best_denoisers(rows, metric) for metric in METRICS}
    return [replace(row, best=frozenset(key for key in METRICS if row.denoiser in best[key])) for row in rows]


def best_denoisers(rows: Sequence[TableRow], metric: str) -> set[str]:
    """The denoisers with the best value, and if that is within its noise floor, all others within theirs."""
    values = {row.denoiser: row.values.get(metric) for row in rows if not row.is_floor}
    more = METRICS[metric].more_is_better
    ranks = {name: -value if more else abs(value) for name, value in values.items() if value is not None}
    best = {name for name, rank in ranks.items() if rank == min(ranks.values())}
    near = {row.denoiser for row in rows if row.near(metric)}
    return best | near if best & near else best


def results_table(clips: Sequence[ClipResults]) -> str:
    """One row per clip, signal and denoiser, with the noise floor below each signal."""
    lines = [
        [row.clip, row.denoiser, row.signal, *map(row.text, PRINTED), "" if row.is_floor else row.nonfinite]
        for clip in clips
        for row in clip_rows(clip)
    ]
    head = ["clip", "denoiser", "signal", *(METRICS[metric].title for metric in PRINTED), "non-finite"]
    return with_legend(tabulate(lines, head, disable_numparse=True))


def table_by_age(clips: Sequence[ClipResults]) -> str:
    """PSNR by the age of the history, the mean over clips, of each signal."""
    tables = []
    for signal, ours in by_signal(clips).items():
        rows = means_by_age(ours)
        lines = [[name, signal, *(value_cell("psnr", value) for value in row.values())] for name, row in rows.items()]
        tables.append(tabulate(lines, ["PSNR dB", "signal", *AGES], disable_numparse=True))
    return "\n\n".join(tables)
