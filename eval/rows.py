"""The report's table: denoisers, clip by clip and on average, with noise floors."""

from collections.abc import Sequence
from dataclasses import dataclass

from eval.floor import within_floor
from eval.results import FLOOR, ClipResults, Result, Values, mean_floor, means
from eval.table import cell, floor_cell

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


def rows_of(clip: str, tracks: Sequence[tuple[str, str, Values, int]], floors: Values) -> list[Row]:
    rows = [Row(clip, name, signal, values, floors, nonfinite) for name, signal, values, nonfinite in tracks]
    return [*rows, Row(clip, FLOOR, tracks[0][1], floors, floors)]


def table_rows(clips: Sequence[ClipResults]) -> list[Row]:
    """Means over the clips of one sample a pixel, if there are several, and then clip by clip."""
    rows = []
    for clip in clips:
        tracks = [(track.denoiser, track.signal, track.metrics, track.nonfinite) for track in clip.tracks]
        rows += rows_of(f"{clip.scene}/{clip.clip}", tracks, clip.reference.metrics)
    together = []
    for signal, ours in by_signal(one_spp(clips)).items():
        if len(ours) > 1:
            names = [track.denoiser for track in ours[0].tracks]
            tracks = [(name, signal, mean_of(ours, name), nonfinite_of(ours, name)) for name in names]
            together += rows_of(ALL, tracks, mean_floor([clip.reference.metrics for clip in ours]))
    return together + rows


def one_spp(clips: Sequence[ClipResults]) -> list[ClipResults]:
    """Without clips such as 000-4spp, which show the same frames again with other input: means do not mix them."""
    return [clip for clip in clips if clip.noisy_spp == 1]


def by_signal(clips: Sequence[ClipResults]) -> dict[str, list[ClipResults]]:
    signals = dict.fromkeys(clip.signal for clip in clips)
    return {signal: [clip for clip in clips if clip.signal == signal] for signal in signals}


def of(clips: Sequence[ClipResults], name: str) -> list[Result]:
    return [track for clip in clips for track in clip.tracks if track.denoiser == name]


def mean_of(clips: Sequence[ClipResults], name: str) -> Values:
    return means([track.metrics for track in of(clips, name)])


def nonfinite_of(clips: Sequence[ClipResults], name: str) -> int:
    return sum(track.nonfinite for track in of(clips, name))
