"""Short animated pictures of clips, for slides."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from eval.results import ClipResults, folders_of, load_picture, signal_label
from files import replacing
from plotting import Image, ImageDraw, ImageFont, enlargement

BEST_SHOWN = 2  # denoisers
MAX_FRAMES = 240
MILLISECONDS = 83  # that each frame is shown
BANNER = 22  # px above the panels, for their names


def panel_names(clip: ClipResults) -> list[str]:
    """The panels from left to right: the noisy frame, the best denoisers by FLIP, the reference."""
    flips = {result.denoiser: result.metrics["flip"] or 0.0 for result in clip.results if result.denoiser != "noisy"}
    noisy = [result.denoiser for result in clip.results if result.denoiser == "noisy"]
    return [*noisy, *sorted(flips, key=flips.__getitem__)[:BEST_SHOWN], clip.reference.denoiser]


def side_by_side(folders: Sequence[Path], names: Sequence[str], index: int) -> Image.Image:
    """Frame `index` of each of the folders, side by side, with names above."""
    images = [load_picture(folder, index) for folder in folders]
    zoom = enlargement(*images[0].shape[:2])
    panels = Image.fromarray(np.concatenate([image.repeat(zoom, 0).repeat(zoom, 1) for image in images], axis=1))
    picture = Image.new("RGB", (panels.width, panels.height + BANNER), "white")
    picture.paste(panels, (0, BANNER))
    for position, name in enumerate(names):
        left = position * panels.width // len(names)
        ImageDraw.Draw(picture).text((left + 4, 3), name, "black", ImageFont.load_default(14))
    return picture


def save_animation(runs: Path, clip: ClipResults) -> Path:
    """Write RUNS/report/SCENE-CLIP.webp, a loop over at most MAX_FRAMES frames of the clip.

    Returns its path. Raises BadInput for missing and damaged pictures.
    """
    names = panel_names(clip)
    folders = [folders_of(runs, clip)[name] for name in names]
    shown = clip.reference.judged[:MAX_FRAMES]
    frames: Iterator[Image.Image] = (side_by_side(folders, names, index) for index in shown)
    path = runs / "report" / f"{signal_label(f'{clip.scene}-{clip.clip}', clip.signal)}.webp"
    first = next(frames)
    with replacing(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=frames, duration=MILLISECONDS, loop=0, quality=90, method=2
        )
    return path
