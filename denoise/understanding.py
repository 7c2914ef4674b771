"""What a sequence has, what is derived and what is done without: decided on its first frames, and said in words."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from datasets.tonemap import luminance
from denoise.frames import Reading, camera_kind, encoded
from denoise.layers import KNOWN
from denoise.motion_meaning import Evidence, Meaning
from denoise.pixels import Pixels, read_pixels
from denoise.sequence import FrameFiles
from denoise.sources import Sources
from errors import BadInput

PAIRS = 4  # of frames that move, by which motion vectors are judged
FRAMES = 12  # that are looked at to find them

Image = NDArray[np.float32]


@dataclass(frozen=True)
class Understanding:
    """How to read a sequence, and a line (quantity, what is done about it) for each quantity that a denoiser reads."""

    reading: Reading
    words: list[tuple[str, str]]


def understand(
    shots: Sequence[Sequence[FrameFiles]], sources: Sources, reads: Sequence[str], stated: Meaning | None
) -> Understanding:
    """Look at the first frames of the foreign sequence for a denoiser that `reads` channels.

    `stated` is the meaning of motion vectors, if the user says it. Raises BadInput for a channel that cannot be had.
    """
    if "gradient" in reads:
        raise BadInput(
            "asvgf reads how samples shaded anew have changed, which only onespp's own renders have: use svgf"
        )
    if "shadow_motion" in reads:
        raise BadInput("trmv reads where shadows and reflections were, which only onespp's own renders have: use svgf")
    if "hit_distance" in reads:
        raise BadInput(
            "aaf reads how far rays went and how large lights look, which only onespp's renders have: use sbf"
        )
    first, _ = read_pixels(shots[0][0], sources)
    reading = camera_kind(first)
    words = [(quantity, found_in_words(sources, quantity)) for quantity in KNOWN if sources.has(quantity)]
    if sources.has("normal"):
        reading = replace(reading, normals_are_encoded=encoded(first.arrays["normal"], first.surface))
    if sources.has("motion"):
        motion, said = meaning_of(shots, sources, stated)
        reading = replace(reading, meaning=motion)
        words.append(("motion means", said))
    return Understanding(reading, words + list(rest_in_words(first, sources, reading, reads)))


def found_in_words(sources: Sources, quantity: str) -> str:
    source = sources.quantities[quantity]
    also = f" (also there: {', '.join(source.others)})" if source.others else ""
    return f"{source.layer.name or 'R,G,B'}{also}"


def rest_in_words(first: Pixels, sources: Sources, reading: Reading, reads: Sequence[str]) -> list[tuple[str, str]]:
    """What is derived and what is done without, of the channels that are read."""
    said = []
    if reading.normals_are_encoded:
        said.append(("normal", "scaled from [0, 1] to [-1, 1]"))
    if reading.cameras:
        said.append(("cameras", f"from {'the positions' if reading.cameras == 'positions' else 'worldToNDC'}"))
    else:
        said.append(("cameras", "none; history is tested on normals and on depth along one axis"))
    if reading.in_camera_space:
        moved = "moved to the world by worldToCamera" if reading.cameras else "and no worldToCamera to move them"
        said.append(("positions", f"in the camera's own space, {moved}"))
    if not sources.has("albedo"):
        said.append(("albedo", "none: radiance is filtered"))
    if not sources.has("normal"):
        said.append(("normal", "derived from depth" if reading.cameras else "none: as if all faced the viewer"))
    if reading.cameras == "positions":
        said.append(("depth", "derived from the positions, along the viewing axis"))
    elif not sources.has("depth", "distance", "position"):
        said.append(("depth", "none: 1 for every surface"))
    elif not sources.has("depth") and not reading.cameras:
        said.append(("depth", "distances, taken as if along the viewing axis"))
    if reading.meaning is None:
        derived = "derived from positions or depth and cameras, as if nothing but the camera moved"
        said.append(("motion", derived if reading.has_history else "none: no history, every frame by itself"))
    if "dual_motion" in reads:
        said.append(("dual motion", "none: motion in its place"))
    if "roughness" in reads and not sources.has("roughness"):
        said.append(("roughness", "none: 1"))
    background = 100 * (1 - first.surface.mean())
    said.append(("background", f"{background:.1f} % of the first frame, left as it is"))
    return said


def meaning_of(shots: Sequence[Sequence[FrameFiles]], sources: Sources, stated: Meaning | None) -> tuple[Meaning, str]:
    """The meaning of motion vectors, as `stated` or as the first frames that move show, and that in words."""
    if stated:
        components = len(sources.quantities["motion"].layer.channels)
        if stated.pair == "ZW" and components < 4:
            raise BadInput(f"--motion {stated}: the motion layer has {components} components, there is no ZW")
        return stated, f"{stated}: {stated.in_words()} (as stated)"
    evidence = Evidence(len(sources.quantities["motion"].layer.channels))
    looked_at = 0
    for shot in shots:
        before: Image | None = None
        for files in shot:
            if looked_at == FRAMES or evidence.pairs == PAIRS:
                break
            pixels, _ = read_pixels(files, sources)
            now = guides(pixels)
            if before is not None:
                evidence.add(now, before, pixels.arrays["motion"])
            before = now
            looked_at += 1
    finding = evidence.finding()
    remedy = "" if finding.certain else "; state it by --motion if that is wrong"
    return finding.meaning, finding.words + remedy


def guides(pixels: Pixels) -> Image:
    """What motion should carry along unchanged, (H, W, C) of about 1: albedo and normals, or else light; blurred.

    Edges are one pixel wide, where a warp by less than that errs more than none at all; and light is noisy.
    """
    found = [pixels.arrays[name] for name in ("albedo", "normal") if name in pixels.arrays]
    if not found:
        y = luminance(pixels.arrays["colour"].clip(0, None))[..., None].astype(np.float32)
        found = [y / (y + max(float(y.mean()), 1e-30))]
    return blurred(np.concatenate(found, axis=-1))


def blurred(image: Image) -> Image:
    """An image (H, W, C) under a tent of 9 x 9 pixels: twice the mean of 5 x 5, fewer at the border."""
    smooth = torch.from_numpy(image).permute(2, 0, 1)[None]
    for _ in range(2):
        smooth = avg_pool2d(smooth, 5, stride=1, padding=2, count_include_pad=False)
    return smooth[0].permute(1, 2, 0).numpy()


def report(words: Sequence[tuple[str, str]]) -> str:
    """The table that is printed at the start."""
    return "\n".join(f"  {quantity:<13} {said}" for quantity, said in words)
