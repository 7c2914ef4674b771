"""Conventions of motion vectors, and detection of a renderer's: it warps the previous frame onto this one best."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from denoise.foreign_frame import Image
from errors import BadInput
from scenes.camera import FAR_OUTSIDE

PAIR_COMPONENTS = {"XY": slice(0, 2), "ZW": slice(2, 4)}  # Blender's Vector has two: one to each neighbouring frame
SIGNS = {"+": 1.0, "-": -1.0}
UNITS = {  # with their descriptions
    "pixels": "pixels",
    "fractions": "fractions of the image",
    "half-fractions": "fractions of half of it",  # [-1, 1] across
}
COMPARED_PIXELS = 1 << 16  # pixels of a frame that are compared
MAX_DIFFERENCE = 0.25  # of one pixel's guides: surfaces come into view under any convention
CLEAR = 0.9  # a detection is certain if its error is below this part of that without motion, and of the runner-up's


@dataclass(frozen=True)
class MotionConvention:
    """How motion vectors become our own: pixels, x right and y down, from this frame to the previous one."""

    pair: str = "XY"
    x: str = "+"
    y: str = "+"
    unit: str = "pixels"

    def __str__(self) -> str:
        return f"{self.pair},{self.x}x,{self.y}y,{self.unit}"

    @staticmethod
    def parse(text: str) -> "MotionConvention":
        """The inverse of str. Raises BadInput for any other text."""
        for convention in conventions(components=4):
            if str(convention) == text:
                return convention
        parts = f"PAIR XY or ZW, SIGN + or -, UNIT {', '.join(UNITS)}"
        form = f"PAIR,SIGNx,SIGNy,UNIT such as {MotionConvention()}, with {parts}"
        raise BadInput(f"'{text}' is no convention of motion vectors: write {form}")

    def pixels(self, motion: Image) -> Image:
        """Motion (H, W, 2) in our convention of foreign `motion` (H, W, 2 or 4); what is not finite becomes 0."""
        height, width = motion.shape[:2]
        size = np.array([width, height], np.float32)
        units: dict[str, NDArray[np.floating]] = {"pixels": np.ones(2), "fractions": size, "half-fractions": size / 2}
        signs = np.array([SIGNS[self.x], SIGNS[self.y]], np.float32)
        vectors = motion[..., PAIR_COMPONENTS[self.pair]] * units[self.unit] * signs
        return np.nan_to_num(vectors, nan=0, posinf=0, neginf=0).clip(-FAR_OUTSIDE, FAR_OUTSIDE).astype(np.float32)

    def description(self) -> str:
        """One line for users: "XY: XY, to the previous frame, y down, in pixels"."""
        points = "to" if self.x == "+" else "from"
        y = "down" if self.x == self.y else "up"
        return f"{self}: {self.pair}, {points} the previous frame, y {y}, in {UNITS[self.unit]}"


def conventions(components: int) -> list[MotionConvention]:
    """All conventions that vectors of 2 or 4 components may follow, the usual ones first."""
    pairs = list(PAIR_COMPONENTS)[: components // 2]
    return [MotionConvention(pair, x, y, unit) for unit, pair, (x, y) in product(UNITS, pairs, product("+-", repeat=2))]


def warp_errors(
    now: Image, before: Image, motion: Image, candidates: Sequence[MotionConvention]
) -> NDArray[np.float64]:
    """Mean error of `before` (H, W, C) warped onto `now` under each convention, and last that without motion.

    Pixels that a vector takes out of the image count as if they had not moved.
    """
    height, width = now.shape[:2]
    stride = max(1, int(np.ceil(np.sqrt(height * width / COMPARED_PIXELS))))
    rows, columns = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    here = now[rows, columns]
    unmoved = difference(here, before[rows, columns])
    errors = []
    for candidate in candidates:
        vectors = candidate.pixels(motion)[rows, columns]
        x = columns + vectors[..., 0]
        y = rows + vectors[..., 1]
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        there = bilinear(before, np.where(inside, x, 0), np.where(inside, y, 0))
        errors.append(np.where(inside, difference(here, there), unmoved).mean())
    return np.array([*errors, unmoved.mean()])


def difference(a: Image, b: Image) -> NDArray[np.float64]:
    return np.abs(a - b).mean(axis=-1, dtype=np.float64).clip(max=MAX_DIFFERENCE)


def bilinear(image: Image, x: NDArray[np.floating], y: NDArray[np.floating]) -> Image:
    """Values (..., C) of an image (H, W, C) at columns x and rows y within it."""
    left = np.floor(x).astype(np.int64).clip(0, max(image.shape[1] - 2, 0))
    top = np.floor(y).astype(np.int64).clip(0, max(image.shape[0] - 2, 0))
    right = np.minimum(left + 1, image.shape[1] - 1)
    bottom = np.minimum(top + 1, image.shape[0] - 1)
    fx = (x - left)[..., None].astype(np.float32)
    fy = (y - top)[..., None].astype(np.float32)
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[bottom, left] * (1 - fx) + image[bottom, right] * fx
    result: Image = upper * (1 - fy) + lower * fy
    return result


@dataclass(frozen=True)
class Detection:
    convention: MotionConvention
    certain: bool
    reason: str


class ConventionDetector:
    """Warp errors of all conventions, summed over pairs of frames."""

    def __init__(self, components: int):
        self.candidates = conventions(components)
        self.errors = np.zeros(len(self.candidates) + 1)
        self.pairs = 0

    def add(self, now: Image, before: Image, motion: Image) -> None:
        """Count a frame's guides (H, W, C), the guides of the frame before and the motion between, unless all is 0."""
        if np.isfinite(motion).any() and np.nanmax(np.abs(np.where(np.isfinite(motion), motion, 0))) > 0:
            self.errors += warp_errors(now, before, motion, self.candidates)
            self.pairs += 1

    def detection(self) -> Detection:
        """The convention with the least error; the usual one where nothing moves."""
        *errors, unmoved = self.errors
        if not unmoved > 0:
            usual = MotionConvention()
            return Detection(usual, False, f"nothing moves, so the convention cannot be detected; taken as {usual}")
        order = [int(index) for index in np.argsort(errors, kind="stable")]
        # Under steady motion a step back equals one ahead reversed: Blender's two pairs do not rival each other.
        twins = [index for index in order if self.is_same_step(index, order[0])]
        rival = next(index for index in order if index not in twins)
        best = min(twins, key=lambda index: (self.candidates[index].pair != "XY", self.errors[index]))
        convention = self.candidates[best]
        scores = [errors[best] / unmoved, errors[rival] / unmoved]
        runner_up = f"{scores[1]:.2f} for the runner-up {self.candidates[rival]}"
        tried = f"warp error {scores[0]:.2f} of that without motion, {runner_up}"
        if scores[0] > CLEAR:
            return Detection(convention, False, f"no convention warps well, best {convention} ({tried})")
        certain = bool(scores[0] < CLEAR * scores[1])
        return Detection(convention, certain, f"{'' if certain else 'probably '}{convention.description()} ({tried})")

    def is_same_step(self, first: int, second: int) -> bool:
        """Whether two conventions describe one step from both neighbouring frames, with similar errors."""
        a = self.candidates[first]
        b = self.candidates[second]
        mirrored = a.pair != b.pair and a.x != b.x and a.y != b.y and a.unit == b.unit
        low, high = sorted([self.errors[first], self.errors[second]])
        return first == second or (mirrored and bool(high <= low / CLEAR))
