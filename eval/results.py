"""Results on disk: a folder for each denoiser and clip, and two files that summarise all of them.

RUNS/eval/clips/SCENE-CLIP/DENOISER/ contains `result.json`, written last, and the displayed output of each frame,
`0000.webp` and so on, lossless. For NAME+js, where frames have two sample buffers, it also contains maps of the
estimated error, `error-0000.webp` and so on. The folder `reference` contains the noise floors. Folders of indirect
light end in `-indirect`.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datasets.clip import Clip, ClipKind
from datasets.frame import Signal
from datasets.tonemap import to_8_bits
from errors import BadInput, can_draw
from eval.metrics import METRICS, Values
from files import read_json, write_csv, write_json
from provenance import DENOISING, code_digest, versions

SIGNALS: tuple[Signal, ...] = ("total", "indirect")
NOISE_FLOOR = "reference"  # the folder of the noise floors
FLOOR = "(noise floor)"  # their name in tables
MAX_SHOWN_ERROR = 0.25  # of exposed radiance, white in error maps
RESULT_FILE = "result.json"
RESULTS_FILE = "results.json"
KEYS = ("denoiser", "signal", "scene", "clip")


def result_key(clip: Clip, modules: Sequence[str], facts: Mapping[str, Any]) -> str:
    """A digest of everything that determines a result: the clip, the code of `modules`, packages, and `facts`."""
    everything = [clip.fingerprint, code_digest(*modules), versions(DENOISING), facts]
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def signal_label(name: str, signal: str) -> str:
    return name if signal == "total" else f"{name}-{signal}"


def folder_of(runs: Path, scene: str, clip: str, name: str, signal: str) -> Path:
    return runs / "eval" / "clips" / f"{scene}-{clip}" / signal_label(name, signal)


def picture_path(folder: Path, index: int, kind: Literal["", "error-"] = "") -> Path:
    """The file of a frame as displayed, or of its estimated error."""
    return folder / f"{kind}{index:04d}.webp"


def save_picture(path: Path, image: NDArray[np.floating]) -> None:
    """Store an image (H, W, 3) or (H, W) in [0, 1], rounded to 8 bits; does nothing without the extra `report`."""
    if can_draw():
        from plotting import Image

        Image.fromarray(to_8_bits(image)).save(path, lossless=True, method=2)


def load_picture(folder: Path, index: int) -> NDArray[np.uint8]:
    """Raises BadInput where it is missing or damaged."""
    from plotting import Image

    path = picture_path(folder, index)
    try:
        with Image.open(path) as image:
            return np.array(image.convert("RGB"))
    except OSError:
        raise BadInput(f"{path} is missing or damaged: delete {folder} and run `onespp eval` again") from None


@dataclass
class Result:
    """The result of one denoiser, or the noise floors of the reference, on one clip and signal."""

    key: str
    denoiser: str
    signal: Signal
    scene: str
    clip: str
    metrics: Values  # means over the frames
    frames: list[Values]  # empty for a frame without a reference
    nonfinite: int = 0  # pixels, in all frames
    precision: str = "float32"
    crops: list[dict[str, int]] | None = None  # of the reference: the windows with most disocclusions

    @property
    def judged(self) -> list[int]:
        """The frames with a reference."""
        return [index for index, values in enumerate(self.frames) if values]

    @property
    def floor(self) -> bool:
        return self.denoiser == NOISE_FLOOR

    def save(self, runs: Path) -> None:
        write_json(folder_of(runs, self.scene, self.clip, self.denoiser, self.signal) / RESULT_FILE, asdict(self))


def load_result(folder: Path) -> Result:
    """Raises BadInput where it is missing or damaged."""
    try:
        return Result(**read_json(folder / RESULT_FILE))
    except (TypeError, BadInput) as error:
        raise BadInput(f"{folder / RESULT_FILE} is missing or damaged ({error}): run `onespp eval` again") from None


def is_finished(folder: Path, wanted: str) -> bool:
    """Whether the folder's result has the `wanted` key and is complete, with pictures if these can be stored."""
    try:
        result = load_result(folder)
    except BadInput:
        return False
    has_pictures = all(picture_path(folder, index).exists() for index in result.judged)
    return result.key == wanted and (has_pictures or not can_draw())


def write_results(
    runs: Path,
    data: Sequence[Path],
    device: str,
    results: list[Result],
    weights: Mapping[str, str | None],
    first_hits: bool = False,
) -> dict[str, Any]:
    """Write results.json and, frame by frame, frames.csv. Returns the content of results.json."""
    rows = [
        {
            "denoiser": result.denoiser,
            "signal": result.signal,
            "weights": weights[result.denoiser],
            "scene": result.scene,
            "clip": result.clip,
            "frames": len(result.frames),
            "metrics": result.metrics,
            "nonfinite": result.nonfinite,
        }
        for result in results
        if not result.floor
    ]
    content = {
        "schema": 1,
        "dataset": ", ".join(map(str, data)),
        "device": device,
        "first_hits": first_hits,
        "versions": versions(DENOISING),
        "rows": rows,
    }
    write_frames(runs / "eval" / "frames.csv", results)
    write_json(runs / "eval" / RESULTS_FILE, content)
    return content


def heading(content: Mapping[str, Any]) -> str:
    """What results.json is of."""
    return f"{content['dataset']}{', with first hits as guides' if content.get('first_hits') else ''}"


def write_frames(path: Path, results: list[Result]) -> None:
    """One line per frame of each result; noise floors are the values of a denoiser named "(noise floor)"."""
    rows: list[list[object]] = []
    for result in results:
        facts = {name: getattr(result, name) for name in KEYS} | ({"denoiser": FLOOR} if result.floor else {})
        for index, values in enumerate(result.frames):
            if values:
                rows.append([*facts.values(), index, *map(values.get, METRICS)])
    write_csv(path, [*KEYS, "frame", *METRICS], rows)


@dataclass
class ClipResults:
    """The results of all denoisers of one signal on one clip."""

    scene: str
    clip: str
    signal: Signal
    results: list[Result]  # of the denoisers
    reference: Result

    @property
    def file_name(self) -> str:
        return signal_label(f"{self.scene}-{self.clip}", self.signal)

    @property
    def name(self) -> str:
        return f"{self.scene}/{self.clip}" + ("" if self.signal == "total" else f" ({self.signal} light)")


def folders_of(runs: Path, clip: ClipResults) -> dict[str, Path]:
    """The folders of all denoisers and of the reference, by name."""
    results = [*clip.results, clip.reference]
    return {r.denoiser: folder_of(runs, r.scene, r.clip, r.denoiser, r.signal) for r in results}


def by_clip(results: list[Result]) -> Iterator[ClipResults]:
    """The results of each clip and signal, in their order."""
    for (scene, clip), signal in product(dict.fromkeys((result.scene, result.clip) for result in results), SIGNALS):
        ours = [result for result in results if (result.scene, result.clip, result.signal) == (scene, clip, signal)]
        if references := [result for result in ours if result.floor]:
            denoisers = [result for result in ours if not result.floor]
            yield ClipResults(scene, clip, signal, denoisers, references[0])


def by_signal(clips: Sequence[ClipResults]) -> dict[Signal, list[ClipResults]]:
    signals = dict.fromkeys(clip.signal for clip in clips)
    return {signal: [clip for clip in clips if clip.signal == signal] for signal in signals}


def of_one_spp(clips: Sequence[ClipResults]) -> list[ClipResults]:
    """The clips without those such as 000-4spp, which show the same frames with other input."""
    return [clip for clip in clips if ClipKind.of(clip.clip).noisy_spp == 1]


def results_of(clips: Sequence[ClipResults], denoiser: str) -> list[Result]:
    return [result for clip in clips for result in clip.results if result.denoiser == denoiser]


def read_results(runs: Path) -> tuple[dict[str, Any], list[ClipResults]]:
    """results.json and the results of its rows. Raises BadInput where files are missing or have changed since."""
    path = runs / "eval" / RESULTS_FILE
    if not path.exists():
        raise BadInput(f"there are no results at {path}: make them with `onespp eval --runs {runs}`")
    content = read_json(path, ("schema", "dataset", "device", "versions", "rows"))
    results = []
    for row in content["rows"]:
        names = row["denoiser"], NOISE_FLOOR
        folders = [folder_of(runs, row["scene"], row["clip"], name, row["signal"]) for name in names]
        ours, reference = map(load_result, folders)
        if ours.metrics != row["metrics"]:
            facts = {name: row[name] for name in KEYS}
            raise BadInput(f"{folders[0]} differs from {path} for {facts}: run `onespp eval` again")
        if reference not in results:
            results.append(reference)
        results.append(ours)
    return content, list(by_clip(results))
