"""A page on which a person compares two unnamed denoisers, clip by clip."""

import base64
import io
import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import torch
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.frame import read_frame
from datasets.tonemap import display
from errors import BadInput
from eval.selection import evaluated
from files import write_file
from models.operators import finite
from models.spec import DenoiserSpec
from plotting import Image

QUALITY = 92  # of the lossy WebP of a frame


@torch.no_grad()
def video(clip: Clip, spec: DenoiserSpec) -> list[str]:
    """Every frame of a clip as denoised and displayed: data URIs."""
    denoiser = spec.build()
    state = None
    uris = []
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name} {spec.name}", unit="frame", leave=False):
        output, state = denoiser(read_frame(clip, index, denoiser.reads).to(denoiser.device), state)
        shown = 255 * display(finite(output.cpu()), clip.exposure)[0].permute(1, 2, 0) + 0.5
        buffer = io.BytesIO()
        Image.fromarray(shown.byte().numpy()).save(buffer, "WEBP", quality=QUALITY)
        uris.append(f"data:image/webp;base64,{base64.b64encode(buffer.getvalue()).decode()}")
    return uris


def write_page(names: Sequence[str], data: Sequence[Path], runs: Path, budget: str) -> Path:
    """Write RUNS/compare.html, one file that works offline. Returns its path.

    Raises BadInput unless two denoisers are named, and as `onespp eval`.
    """
    if len(names) != 2:
        raise BadInput("name two denoisers to compare, such as one and oidn+accumulated+adaptive")
    specs = evaluated(names, runs, budget)
    clips = [
        {
            "name": f"{clip.scene}/{clip.name}",
            "width": clip.width,
            "height": clip.height,
            "videos": [video(clip, spec) for spec in specs],
        }
        for folder in data
        for clip in Dataset(folder).clips("test")
    ]
    content = json.dumps({"denoisers": [spec.name for spec in specs], "clips": clips})
    template = resources.files("eval.benchmark").joinpath("page.html").read_text()
    path = runs / "compare.html"
    runs.mkdir(parents=True, exist_ok=True)
    write_file(path, template.replace("/* DATA */ null", content).encode())
    return path
