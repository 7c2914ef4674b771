"""`onespp eval --jod`: JOD by ColorVideoVDP (Mantiuk et al. 2024), from the pictures that an evaluation has stored.

JOD, just-objectionable differences, are 10 for what looks like the reference; one less means that 75 % of the viewers
prefer the reference. The metric models the display and contrast vision in space, time and colour.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor
from tqdm import tqdm

from errors import BadInput, requires_extra
from eval.results import NOISE_FLOOR, ClipResults, folders_of, load_picture, read_results
from files import write_json

DISPLAY = "standard_fhd"  # a 24-inch display of 200 cd/m², seen from 60 cm
FRAMES_PER_SECOND = 24
MIN_SIDE = 3  # px; the metric fails on a single pixel


def video(folder: Path, frames: Sequence[int]) -> Tensor:
    """Frames as displayed, (1, 3, F, H, W) in 8 bits, which the metric takes."""
    pictures = np.stack([load_picture(folder, index) for index in frames])
    return torch.from_numpy(pictures).permute(3, 0, 1, 2)[None]


def frame_rate(clip: ClipResults) -> int | None:
    """Frames per second at which a clip is compared; None where only some frames have a reference: as stills."""
    whole = len(clip.reference.judged) == len(clip.reference.frames)
    return FRAMES_PER_SECOND if whole else None


def jod_of_clip(metric: Any, runs: Path, clip: ClipResults) -> dict[str, float]:
    """JOD of each denoiser: of the video, or the mean of the judged frames as stills, see `frame_rate`.

    Raises BadInput where the images are too small.
    """
    folders = folders_of(runs, clip)
    frames = clip.reference.judged
    reference = video(folders.pop(NOISE_FLOOR), frames)
    if min(reference.shape[-2:]) < MIN_SIDE:
        raise BadInput(f"{clip.name} is too small for JOD: evaluate clips of {MIN_SIDE} x {MIN_SIDE} pixels or more")
    rate = frame_rate(clip)
    values = {}
    for name, folder in folders.items():
        output = video(folder, frames)
        pairs = [(output, reference)]
        if rate is None:
            pairs = list(zip(output.split(1, dim=2), reference.split(1, dim=2), strict=True))
        jods = [metric.predict(*pair, dim_order="BCFHW", frames_per_second=rate or 0)[0].item() for pair in pairs]
        values[name] = float(np.mean(jods))
    return values


@torch.no_grad()
def jod_table(runs: Path) -> str:
    """A table of all clips in RUNS/eval, which is also written to RUNS/eval/jod.json. Raises BadInput without results.

    Needs the extra `cvvdp`, and the pictures that the extra `report` stores.
    """
    with requires_extra("cvvdp"):
        from pycvvdp import cvvdp
    metric = cvvdp(display_name=DISPLAY, quiet=True)
    clips = read_results(runs)[1]
    values = {clip.name: jod_of_clip(metric, runs, clip) for clip in tqdm(clips, "JOD", unit="clip", leave=False)}
    rates = {clip.name: frame_rate(clip) for clip in clips}  # None: as stills
    facts = {"metric": metric.get_info_string(), "frames_per_second": rates}
    write_json(runs / "eval" / "jod.json", facts | {"clips": values})
    lines = [
        {"clip": name, "shown": f"at {rates[name]} Hz" if rates[name] else "as stills"}
        | {key: f"{jod:.2f}" for key, jod in row.items()}
        for name, row in values.items()
    ]
    return f"JOD ({facts['metric']})\n{tabulate(lines, 'keys', disable_numparse=True)}"
