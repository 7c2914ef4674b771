"""Short animated pictures of clips, for slides."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from eval.results import ClipResults, folders_of, load_picture, signal_label
from files import replacing

BEST = 2  # denoisers that are shown
FRAMES, MILLISECONDS = 240, 83  # at most so many frames, so long each
SMALLEST_PANEL = 256  # px; smaller images are enlarged by a whole factor
CAPTION = 22  # px


def shown(clip: ClipResults) -> list[str]:
    """What stands side by side: the noisy frame, the best denoisers by FLIP, the reference."""
    flips = {track.denoiser: track.metrics["flip"] or 0.0 for track in clip.results if track.denoiser != "noisy"}
    noisy = [track.denoiser for track in clip.results if track.denoiser == "noisy"]
    return [*noisy, *sorted(flips, key=flips.__getitem__)[:BEST], clip.reference.denoiser]


def side_by_side(folders: Sequence[Path], names: Sequence[str], index: int) -> Image.Image:
    images = [load_picture(folder, index) for folder in folders]
    zoom = max(1, -(-SMALLEST_PANEL // max(images[0].shape[:2])))
    panels = Image.fromarray(np.concatenate([image.repeat(zoom, 0).repeat(zoom, 1) for image in images], axis=1))
    picture = Image.new("RGB", (panels.width, panels.height + CAPTION), "white")
    picture.paste(panels, (0, CAPTION))
    for position, name in enumerate(names):
        place = position * panels.width // len(names) + 4, 3
        ImageDraw.Draw(picture).text(place, name, "black", ImageFont.load_default(14))
    return picture


def save_animation(runs: Path, clip: ClipResults) -> Path:
    """Write RUNS/report/SCENE-CLIP.webp, an endless loop over the clip; of a long clip, its beginning."""
    names = shown(clip)
    folders = [folders_of(runs, clip)[name] for name in names]
    count = min(FRAMES, len(clip.reference.frames))
    frames: Iterator[Image.Image] = (side_by_side(folders, names, index) for index in range(count))
    path = runs / "report" / f"{signal_label(f'{clip.scene}-{clip.clip}', clip.signal)}.webp"
    first = next(frames)
    with replacing(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=frames, duration=MILLISECONDS, loop=0, quality=90, method=2
        )
    return path
