"""The report's table: denoisers, clip by clip and on average, with noise floors."""

from collections.abc import Sequence
from dataclasses import dataclass

from eval.means import joint_floor, mean_floor, means
from eval.metrics import Values, within_floor
from eval.results import FLOOR, ClipResults, Result
from eval.text_table import cell, floor_cell

ALL = "mean of clips of 1 spp"


@dataclass
class Row:
    """Of the table: a denoiser on a clip, or the noise floor."""

    clip: str
    denoiser: str
    signal: str
    values: Values
    floors: Values
    nonfinite: int = 0

    @property
    def is_floor(self) -> bool:
        return self.denoiser == FLOOR

    def text(self, metric: str) -> str:
        value = self.values.get(metric)
        return floor_cell(metric, value) if self.is_floor else cell(metric, value, self.floors.get(metric))

    def near(self, metric: str) -> bool:
        return not self.is_floor and within_floor(metric, self.values.get(metric), self.floors.get(metric))


def rows_of(clip: str, signal: str, tracks: Sequence[Result], floors: Values) -> list[Row]:
    rows = [Row(clip, track.denoiser, signal, track.metrics, floors, track.nonfinite) for track in tracks]
    return [*rows, Row(clip, FLOOR, signal, floors, floors)]


def mean_rows(signal: str, clips: Sequence[ClipResults]) -> list[Row]:
    floors, rows = [clip.reference.metrics for clip in clips], []
    for name in (track.denoiser for track in clips[0].results):
        metrics = [result.metrics for result in of(clips, name)]
        rows.append(Row(ALL, name, signal, means(metrics), joint_floor(metrics, floors), nonfinite_of(clips, name)))
    floor = mean_floor(floors)
    return [*rows, Row(ALL, FLOOR, signal, floor, floor)]


def table_rows(clips: Sequence[ClipResults]) -> list[Row]:
    """Means over the clips of one sample a pixel, if there are several, and then clip by clip."""
    rows = []
    for clip in clips:
        rows += rows_of(f"{clip.scene}/{clip.clip}", clip.signal, clip.results, clip.reference.metrics)
    together = []
    for signal, ours in by_signal(one_spp(clips)).items():
        if len(ours) > 1:
            together += mean_rows(signal, ours)
    return together + rows


def one_spp(clips: Sequence[ClipResults]) -> list[ClipResults]:
    """Without clips such as 000-4spp, which show the same frames again with other input: means do not mix them."""
    return [clip for clip in clips if clip.noisy_spp == 1]


def by_signal(clips: Sequence[ClipResults]) -> dict[str, list[ClipResults]]:
    signals = dict.fromkeys(clip.signal for clip in clips)
    return {signal: [clip for clip in clips if clip.signal == signal] for signal in signals}


def of(clips: Sequence[ClipResults], name: str) -> list[Result]:
    return [track for clip in clips for track in clip.results if track.denoiser == name]


def mean_of(clips: Sequence[ClipResults], name: str) -> Values:
    return means([track.metrics for track in of(clips, name)])


def nonfinite_of(clips: Sequence[ClipResults], name: str) -> int:
    return sum(track.nonfinite for track in of(clips, name))
