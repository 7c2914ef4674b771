"""Means of results over clips, and tables of results, in which values within their noise floor are marked."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from tabulate import tabulate

from errors import BadInput
from eval.metrics import METRICS, Values, mean_floor, means, within_floor
from eval.results import FLOOR, ClipResults, by_signal, of_one_spp, results_of
from models.registry import prototype

PRINTED = (
    *("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1"),
    *("energy", "detail", "tpsnr", "block_flicker"),
)
NEAR_FLOOR = "≈"
LEGEND = f"{NEAR_FLOOR} within the noise floor: as close to the truth as the reference; differences are not significant"
MEAN = "mean of clips of 1 spp"  # instead of a clip's name
# A recurrent denoiser has no history in the first frame, some in the fifth, and is steady from the 16th on.
AGES = {"first frame": slice(0, 1), "fifth": slice(4, 5), "from the 16th on": slice(15, None)}


def means_by_age(clips: Sequence[ClipResults], metric: str = "psnr") -> dict[str, dict[str, float | None]]:
    """A metric of each denoiser by AGES, the mean over clips of one signal, of 1 spp; None unless all clips have it."""
    clips = of_one_spp(clips)
    rows: dict[str, dict[str, float | None]] = {}
    for denoiser in dict.fromkeys(result.denoiser for clip in clips for result in clip.results):
        results = results_of(clips, denoiser)
        for age, frames in AGES.items():
            chosen = [means(result.frames[frames]).get(metric) for result in results]
            values = [value for value in chosen if value is not None]
            rows.setdefault(denoiser, {})[age] = fmean(values) if len(values) == len(chosen) else None
    return rows


@dataclass(frozen=True)
class ClipScores:
    """A denoiser's metrics on several clips, and the noise floors of these."""

    values: list[Values]
    floors: list[Values]

    @property
    def means(self) -> Values:
        return means(self.values)

    @property
    def joint_floor(self) -> Values:
        """Noise floors of the means; None unless every clip is within its own floor."""

        def near(metric: str) -> bool:
            pairs = ((v.get(metric), f.get(metric)) for v, f in zip(self.values, self.floors, strict=True))
            return all(within_floor(metric, value, floor) for value, floor in pairs if value is not None)

        return {metric: floor if near(metric) else None for metric, floor in mean_floor(self.floors).items()}

    def compared(self, metric: str) -> float | None:
        """The mean, in the digits shown, by which denoisers are ranked.

        The value of a clip within its noise floor is replaced by the floor's edge. None where it is never defined.
        """
        values = []
        for value, floor in ((c[metric], f.get(metric)) for c, f in zip(self.values, self.floors, strict=True)):
            if value is not None:
                near = floor is not None and within_floor(metric, value, floor)
                values.append(METRICS[metric].edge(floor) if near else value)  # type: ignore[arg-type]
        return float(METRICS[metric].form.format(fmean(values))) if values else None


def scores_of(clips: Sequence[ClipResults], denoiser: str) -> ClipScores:
    """The denoiser's scores on those of the clips, all of one signal, that have results of it."""
    pairs = [(result, clip.reference) for clip in clips for result in clip.results if result.denoiser == denoiser]
    return ClipScores([result.metrics for result, _ in pairs], [reference.metrics for _, reference in pairs])


def source_of_denoiser(name: str) -> str:
    """What the implementation of a denoiser follows, for tables that rank; "-" for one that is here no more."""
    try:
        return prototype(name).made_from
    except BadInput:
        return "-"


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
    def made_from(self) -> str:
        """See source_of_denoiser; "-" for the noise floor."""
        return "-" if self.is_floor else source_of_denoiser(self.denoiser)

    def text(self, metric: str) -> str:
        """The value, marked if it is within its noise floor, or a noise floor that is a standard error."""
        value = self.values.get(metric)
        if not self.is_floor:
            return value_cell(metric, value, self.floors.get(metric))
        if value is None or not METRICS[metric].floor_is_error:
            return value_cell(metric, value)
        return f"±{100 * value:.2g}%" if METRICS[metric].form.endswith("%}") else f"±{value_cell(metric, value)}"

    def near(self, metric: str) -> bool:
        return not self.is_floor and within_floor(metric, self.values.get(metric), self.floors.get(metric))


def table_rows(clips: Sequence[ClipResults]) -> list[TableRow]:
    """Means over the clips of 1 spp, if there are several, then the rows of each clip."""
    groups = [mean_rows(ours) for ours in by_signal(of_one_spp(clips)).values() if len(ours) > 1]
    groups += [clip_rows(clip) for clip in clips]
    marked = []
    for rows in groups:
        best = {metric: best_denoisers(rows, metric) for metric in METRICS}
        marked += [replace(row, best=frozenset(key for key in METRICS if row.denoiser in best[key])) for row in rows]
    return marked


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
        [
            *(row.clip, row.denoiser, row.made_from, row.signal),
            *map(row.text, PRINTED),
            "" if row.is_floor else row.nonfinite,
        ]
        for clip in clips
        for row in clip_rows(clip)
    ]
    head = ["clip", "denoiser", "made from", "signal", *(METRICS[metric].title for metric in PRINTED), "non-finite"]
    return with_legend(tabulate(lines, head, disable_numparse=True))


def table_by_age(clips: Sequence[ClipResults]) -> str:
    """PSNR by the age of the history, see means_by_age, of each signal."""
    tables = []
    for signal, ours in by_signal(clips).items():
        rows = means_by_age(ours)
        lines = [
            [name, source_of_denoiser(name), signal, *(value_cell("psnr", value) for value in row.values())]
            for name, row in rows.items()
        ]
        tables.append(tabulate(lines, ["PSNR dB", "made from", "signal", *AGES], disable_numparse=True))
    return "\n\n".join(tables)
