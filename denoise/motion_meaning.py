"""What a renderer means by its motion vectors: found by how well they warp the previous frame onto this one."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from errors import BadInput
from scenes.camera import FAR_OUTSIDE

Image = NDArray[np.float32]

PAIRS = {"XY": slice(0, 2), "ZW": slice(2, 4)}  # Blender's Vector has two: one to each neighbouring frame
SIGNS = {"+": 1.0, "-": -1.0}
UNITS = ("pixels", "fractions", "half-fractions")  # of the image's size, or of half of it: [-1, 1] across
SAMPLES = 1 << 16  # pixels of a frame that are looked at
LARGEST_DIFFERENCE = 0.25  # what a guide's difference counts at most: surfaces come into view in any convention
CLEAR = 0.9  # the error of what is believed is at most this part of that without motion, and of the runner-up's


@dataclass(frozen=True)
class Meaning:
    """How to read motion vectors as our own: pixels, x right and y down, from this frame to the previous one."""

    pair: str = "XY"
    x: str = "+"
    y: str = "+"
    unit: str = "pixels"

    def __str__(self) -> str:
        return f"{self.pair},{self.x}x,{self.y}y,{self.unit}"

    @staticmethod
    def parse(text: str) -> "Meaning":
        """The inverse of str. Raises BadInput for what is no such text."""
        for meaning in meanings(components=4):
            if str(meaning) == text:
                return meaning
        raise BadInput(
            f"'{text}' is no meaning of motion vectors: write PAIR,SIGNx,SIGNy,UNIT such as {Meaning()}, with "
            f"PAIR XY or ZW, SIGN + or -, UNIT {', '.join(UNITS)}"
        )

    def pixels(self, motion: Image) -> Image:
        """Motion (H, W, 2) in our convention of foreign `motion` (H, W, 2 or 4); what is not finite becomes 0."""
        height, width = motion.shape[:2]
        size = np.array([width, height], np.float32)
        units: dict[str, NDArray[np.floating]] = {"pixels": np.ones(2), "fractions": size, "half-fractions": size / 2}
        vectors = (
            motion[..., PAIRS[self.pair]] * units[self.unit] * np.array([SIGNS[self.x], SIGNS[self.y]], np.float32)
        )
        return np.nan_to_num(vectors, nan=0, posinf=0, neginf=0).clip(-FAR_OUTSIDE, FAR_OUTSIDE).astype(np.float32)

    def in_words(self) -> str:
        """One line for people."""
        where = {("+", "+"): "to", ("-", "-"): "from"}.get((self.x, self.y))
        direction = f"{where} the previous frame, y down" if where else ""
        if where is None:
            direction = f"{'to' if self.x == '+' else 'from'} the previous frame, y up"
        units = {"pixels": "pixels", "fractions": "fractions of the image", "half-fractions": "fractions of half of it"}
        return f"{self.pair}, {direction}, in {units[self.unit]}"


def meanings(components: int) -> list[Meaning]:
    """All meanings that vectors of 2 or 4 components may have, the usual ones first."""
    pairs = list(PAIRS)[: components // 2]
    return [Meaning(pair, x, y, unit) for unit, pair, (x, y) in product(UNITS, pairs, product("+-", repeat=2))]


def warp_errors(now: Image, before: Image, motion: Image, candidates: Sequence[Meaning]) -> NDArray[np.float64]:
    """Mean error of `before` (H, W, C) warped onto `now` under each meaning, and last that without motion.

    What comes from outside the image counts as if it had not moved: it tells nothing.
    """
    height, width = now.shape[:2]
    stride = max(1, int(np.ceil(np.sqrt(height * width / SAMPLES))))
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
    return np.abs(a - b).mean(axis=-1, dtype=np.float64).clip(max=LARGEST_DIFFERENCE)


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
class Finding:
    """What the warps of some frames tell: the best meaning, whether it is beyond doubt, and why, in words."""

    meaning: Meaning
    certain: bool
    words: str


class Evidence:
    """Warp errors of all meanings, summed over pairs of frames."""

    def __init__(self, components: int):
        self.candidates = meanings(components)
        self.errors = np.zeros(len(self.candidates) + 1)
        self.pairs = 0

    def add(self, now: Image, before: Image, motion: Image) -> None:
        """Count a frame's guides (H, W, C) and motion, and the guides of the frame before; one that moves."""
        if np.isfinite(motion).any() and np.nanmax(np.abs(np.where(np.isfinite(motion), motion, 0))) > 0:
            self.errors += warp_errors(now, before, motion, self.candidates)
            self.pairs += 1

    def finding(self) -> Finding:
        """The meaning with the least error; the usual one where nothing moves, or where nothing can be told."""
        *errors, unmoved = self.errors
        if not unmoved > 0:
            return Finding(Meaning(), False, f"nothing moves that would tell their meaning; taken as {Meaning()}")
        order = np.argsort(errors, kind="stable")
        best = int(order[0])
        # Under steady motion, a step back and one ahead are all but alike: Blender's pairs are no rivals.
        rivals = [i for i in order[1:] if not self.is_same_step(int(i), best)]
        best = min([i for i in order if self.is_same_step(int(i), best)], key=lambda i: self.preference(int(i), best))
        scores = [errors[best] / unmoved, errors[rivals[0]] / unmoved]
        meaning = self.candidates[best]
        tried = f"warp error {scores[0]:.2f} of that without motion, {scores[1]:.2f} for the runner-up "
        tried += f"{self.candidates[rivals[0]]}"
        if scores[0] > CLEAR:
            return Finding(meaning, False, f"no meaning warps well, best {meaning} ({tried})")
        certain = scores[0] < CLEAR * scores[1]
        words = f"{meaning}: {meaning.in_words()} ({tried})"
        return Finding(meaning, certain, words if certain else f"probably {words}")

    def is_same_step(self, one: int, other: int) -> bool:
        """Whether two meanings are one step seen from both neighbouring frames, and about as good."""
        a = self.candidates[one]
        b = self.candidates[other]
        mirrored = a.pair != b.pair and a.x != b.x and a.y != b.y and a.unit == b.unit
        alike = self.errors[one] <= self.errors[other] / CLEAR and self.errors[other] <= self.errors[one] / CLEAR
        return one == other or (mirrored and alike)

    def preference(self, one: int, best: int) -> tuple[bool, float]:
        """Of such twins the first pair is preferred."""
        return self.candidates[one].pair != "XY", float(self.errors[one])
