"""One frame in three slanted strips: noisy, denoised, reference. `python -m eval.figures.triptych --help`."""

from collections import deque
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from datasets.channels import CHANNELS
from datasets.clip import Clip
from datasets.frame import to_image
from datasets.tonemap import clip_exposure, display, luminance, to_8_bits
from eval.clip_run import play
from eval.selection import USUAL_BUDGET, evaluated
from files import replacing
from models.denoiser import Denoiser
from plotting import Image
from render.clip import Sampling, write_clip
from render.path import PosedFrame
from render.stage import Stage
from scenes.registry import build_scene

SLANT = 0.15  # px to the left for each row down
CUTS = (0.36, 0.70)  # of the width, in the middle row
CUT_WIDTH = 3  # px
NOISY_ONLY = Sampling(realisations=1, noisy_spp=1, reference_spp=2)

Picture = NDArray[np.float64]


@torch.inference_mode()
def last_frame(clip: Clip, network: Denoiser) -> tuple[Picture, Picture]:
    """Radiance (H, W, 3) of the last frame, noisy and denoised with the history of all frames."""
    _, frame, (output,) = deque(play(clip, [network], ("direct", "indirect", "emission")), maxlen=1).pop()
    noisy, denoised = (to_image(image.double()) for image in (frame.radiance("total"), output))
    return noisy, denoised


def in_strips(pictures: Sequence[Picture]) -> Picture:
    """The left, the middle and the right of three pictures (H, W, 3), separated by white lines."""
    height, width = pictures[0].shape[:2]
    x = np.arange(width) + SLANT * (np.arange(height)[:, None] - height / 2)
    picture = pictures[0]
    for cut, right in zip(CUTS, pictures[1:], strict=True):
        picture = np.where((x > cut * width)[..., None], right, picture)
    lines = np.min([np.abs(x - cut * width) for cut in CUTS], axis=0) < CUT_WIDTH / 2
    return np.where(lines[..., None], 1.0, picture)


def triptych(
    out: Path = Path("triptych.png"),
    scene_name: str = "room-2014",
    denoiser: str = "one",
    runs: Path = Path("runs"),
    frame: int = 12,
    spp: int = 512,
    size: tuple[int, int] = (720, 1280),
    seed: int = 0,
) -> None:
    """Write a PNG of a built-in scene's frame, whose reference has `spp` samples a pixel, in `size` (height, width).

    History begins at frame 0. Raises BadInput for an unknown scene or denoiser.
    """
    (spec,) = evaluated([denoiser], runs, USUAL_BUDGET)
    scene = build_scene(scene_name, seed, 2 * frame)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "test" / scene_name / "000"
        path.parent.mkdir(parents=True)
        write_clip(path, scene, (frame + 1, *size), NOISY_ONLY, seed, tuple(CHANNELS))
        noisy, denoised = last_frame(Clip(path), spec.build())
    posed = PosedFrame(Stage(scene, *size), frame)
    reflected = posed.reflected(seed, spp)
    exposure = clip_exposure(luminance(reflected))
    picture = in_strips([display(image, exposure) for image in (noisy, denoised, reflected + posed.emission)])
    with replacing(out) as temporary:
        Image.fromarray(to_8_bits(picture)).save(temporary, format="png", optimize=True)


if __name__ == "__main__":
    tyro.cli(triptych)
