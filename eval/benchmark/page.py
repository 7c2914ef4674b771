"""A page on which a person compares two unnamed denoisers, clip by clip."""

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import torch

from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.clip_run import as_displayed, play
from eval.selection import evaluated
from files import write_file
from models.spec import DenoiserSpec
from plotting import webp_uri
from web_page import filled

QUALITY = 92  # of the lossy WebP of a frame


@torch.no_grad()
def video(clip: Clip, spec: DenoiserSpec) -> list[str]:
    """Every frame of a clip as denoised and displayed: data URIs."""
    played = play(clip, [spec.build()])
    return [webp_uri(as_displayed(output, clip.exposure), quality=QUALITY) for _, _, (output,) in played]


def write_page(names: tuple[str, str], data: Sequence[Path], runs: Path, budget: str) -> Path:
    """Write RUNS/compare.html, one file that works offline. Returns its path.

    Raises BadInput as `onespp eval`, and for one denoiser named twice or two of different light.
    """
    played = [clip for folder in data for clip in Dataset(folder).clips("test")]
    specs = evaluated(names, runs, budget, clips=played)
    if len(specs) < 2:
        raise BadInput(f"{names[0]} is named twice: name two denoisers to compare")
    if specs[0].returns != specs[1].returns:
        lights = " and ".join(f"{spec.name} {spec.returns}" for spec in specs)
        raise BadInput(f"{lights} light are different images: name two denoisers of one light")
    clips = [
        {
            "name": f"{clip.scene}/{clip.name}",
            "width": clip.width,
            "height": clip.height,
            "videos": [video(clip, spec) for spec in specs],
        }
        for clip in played
    ]
    content = {"denoisers": [spec.name for spec in specs], "clips": clips}
    template = resources.files("eval.benchmark").joinpath("page.html").read_text()
    path = runs / "compare.html"
    runs.mkdir(parents=True, exist_ok=True)
    write_file(path, filled(template, content).encode())
    return path
