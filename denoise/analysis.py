"""What a sequence has, what is derived and what is missing: decided on its first frames, with a report for users."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
import torch
from torch.nn.functional import avg_pool2d

from datasets.frame import to_image
from datasets.tonemap import luminance
from denoise.foreign_frame import ForeignFrame, Image, read_foreign_frame
from denoise.frames import InputConventions, are_encoded, camera_conventions, check_reads
from denoise.layers import COLOUR, QUANTITIES, normalised
from denoise.motion_convention import ConventionDetector, MotionConvention
from denoise.sequence import FrameFiles
from denoise.sources import Sources
from errors import BadInput

MAX_PAIRS = 4  # of frames that move, by which the convention of motion vectors is detected
FRAMES = 12  # that are read at most to find them, or a camera

Report = list[tuple[str, str]]  # a quantity, and where it comes from


@dataclass(frozen=True)
class Analysis:
    conventions: InputConventions
    report: Report


def analyse(
    shots: Sequence[Sequence[FrameFiles]],
    sources: Sources,
    reads: Sequence[str],
    given: MotionConvention | None,
    albedo: str | None = None,
) -> Analysis:
    """Analyse the first frames of a foreign sequence for a denoiser that `reads` channels.

    `given` is the convention of motion vectors, and `albedo` "exact" or "sampled", if the user names them. Raises
    BadInput where they do not apply, for negative depth, and for a channel that only onespp renders.
    """
    check_reads("the denoiser", reads)
    frames = (read_foreign_frame(files, sources)[0] for files in islice(chain.from_iterable(shots), FRAMES))
    first = next(frames)
    first.check_depth()
    conventions = camera_conventions(first, frames)
    report = [(quantity, str(sources.quantities[quantity])) for quantity in QUANTITIES if sources.has(quantity)]
    if sources.has("normal"):
        conventions = replace(conventions, normals_are_encoded=are_encoded(first.arrays["normal"], first.surface))
    if sources.has("motion"):
        convention, reason = motion_convention(shots, sources, given)
        conventions = replace(conventions, motion=convention)
        report.append(("convention", reason))
    elif given:
        raise BadInput(f"--motion {given}: there is no motion layer; name it by --layers motion=LAYER or --mv")
    if albedo and not sources.has("albedo"):
        raise BadInput(f"--albedo {albedo}: there is no albedo layer; name it by --layers albedo=LAYER or --alb")
    sampled = sources.has("albedo") and (albedo or usual_albedo(sources)) == "sampled"
    if sampled and conventions.has_history and {"albedo", "depth", "motion"} <= set(reads):
        conventions = replace(conventions, albedo_is_sampled=True)
        report.append(("", "albedo has the frame's samples, and is averaged along the motion"))
    return Analysis(conventions, report + derived_and_missing(first, sources, conventions, reads))


def usual_albedo(sources: Sources) -> str:
    """How an albedo of that name is rendered: Cycles' has the samples of the light."""
    name = normalised(sources.quantities["albedo"].layer.name.rpartition(".")[2])
    return "sampled" if name == "denoisingalbedo" else "exact"


def derived_and_missing(
    first: ForeignFrame, sources: Sources, conventions: InputConventions, reads: Sequence[str]
) -> Report:
    has = sources.has
    cameras = conventions.cameras
    moved = "moved to the world by worldToCamera" if cameras else "and no worldToCamera to move them"
    faced = "derived from depth" if cameras else "none: as if all faced the viewer"
    distances_only = has("distance", "position") and not has("depth")
    derived = "derived from positions or depth and cameras, as if nothing but the camera moved"
    motion = derived if conventions.has_history else "none: no history, every frame by itself"
    background = 100 * (1 - first.surface.mean())
    lines = [
        ("normal", "scaled from [0, 1] to [-1, 1]", conventions.normals_are_encoded),
        ("cameras", "from the positions", cameras == "positions"),
        ("cameras", "from worldToNDC", cameras == "header"),
        ("cameras", "none; history is tested on normals and on depth along one axis", cameras is None),
        ("positions", f"in the camera's own space, {moved}", conventions.in_camera_space),
        ("albedo", "none: radiance is filtered", not has("albedo")),
        ("normal", faced, not has("normal")),
        ("depth", "derived from the positions, along the viewing axis", cameras == "positions"),
        ("depth", "none: 1 for every surface", not has("depth", "distance", "position")),
        ("depth", "distances, taken as if along the viewing axis", distances_only and cameras is None),
        ("motion", motion, conventions.motion is None),
        ("dual motion", "none: motion in its place", "dual_motion" in reads),
        ("roughness", "none: 1", "roughness" in reads and not has("roughness")),
        ("background", f"{background:.1f} % of the first frame, left as it is", True),
    ]
    return [(quantity, origin) for quantity, origin, applies in lines if applies]


def motion_convention(
    shots: Sequence[Sequence[FrameFiles]], sources: Sources, given: MotionConvention | None
) -> tuple[MotionConvention, str]:
    """The convention of motion vectors, as `given` or as detected on the first frames that move, and why.

    Raises BadInput where `given` names components that the layer does not have, and where frames differ in size.
    """
    components = len(sources.quantities["motion"].layer.channels)
    if given:
        if given.pair == "ZW" and components < 4:
            raise BadInput(f"--motion {given}: the motion layer has {components} components, there is no ZW")
        return given, f"{given.description()} (as given)"
    detector = ConventionDetector(components)
    before: Image | None = None
    for index, files in islice(((i, files) for shot in shots for i, files in enumerate(shot)), FRAMES):
        if detector.pairs == MAX_PAIRS:
            break
        frame, _ = read_foreign_frame(files, sources)
        now = guides(frame)
        if before is not None and now.shape[:2] != before.shape[:2]:
            size = f"{now.shape[1]}x{now.shape[0]}"
            raise BadInput(f"{files.passes[COLOUR]} is {size}, unlike the frame before it: name one sequence")
        if index and before is not None:
            detector.add(now, before, frame.arrays["motion"])
        before = now
    detection = detector.detection()
    remedy = "" if detection.certain else "; set it by --motion if that is wrong"
    return detection.convention, detection.reason + remedy


def guides(frame: ForeignFrame) -> Image:
    """What motion should carry along unchanged, (H, W, C) of about 1: albedo and normals, or else light; blurred.

    Edges are one pixel wide, where a warp by less than that errs more than none at all; and light is noisy.
    """
    images = [frame.arrays[name] for name in ("albedo", "normal") if name in frame.arrays]
    if not images:
        y = luminance(frame.arrays["colour"].clip(0, None))[..., None].astype(np.float32)
        images = [y / (y + max(float(y.mean()), 1e-30))]
    return blurred(np.concatenate(images, axis=-1))


def blurred(image: Image) -> Image:
    """An image (H, W, C) under a tent of 9 x 9 pixels: twice the mean of 5 x 5, fewer at the border."""
    smooth = torch.from_numpy(image).permute(2, 0, 1)[None]
    for _ in range(2):
        smooth = avg_pool2d(smooth, 5, stride=1, padding=2, count_include_pad=False)
    return to_image(smooth)
