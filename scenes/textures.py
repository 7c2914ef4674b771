"""Random bitmap textures and colours for interiors: linear reflectances, all repeating seamlessly."""

import colorsys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenes.animation import Array

Rng = np.random.Generator

SIZE = 256  # px
COLOURS = 4  # of a texture's palette
DARKEST, BRIGHTEST = 0.02, 0.9  # linear reflectance

X, Y = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE)


def hsv(hue: float, saturation: float, value: float) -> Array:
    """Linear reflectance (3,) of a displayed colour; the hue wraps around, the others are clipped to 0..1."""
    rgb = colorsys.hsv_to_rgb(hue % 1, float(np.clip(saturation, 0, 1)), float(np.clip(value, 0, 1)))
    return np.clip(np.array(rgb) ** 2.2, DARKEST, BRIGHTEST)


def hue_saturation_value(rng: Rng) -> tuple[float, float, float]:
    """A displayed colour as interiors have them: whites, greys, darks, woods, muted and saturated hues."""
    hue, earth = rng.uniform(), rng.normal(0.08, 0.025)
    kinds = (
        (0.22, earth, rng.uniform(0, 0.12), rng.uniform(0.8, 0.96)),
        (0.13, hue, rng.uniform(0, 0.08), rng.uniform(0.3, 0.8)),
        (0.10, hue, rng.uniform(0, 0.4), rng.uniform(0.05, 0.25)),
        (0.20, earth, rng.uniform(0.25, 0.7), rng.uniform(0.25, 0.8)),
        (0.25, hue, rng.uniform(0.1, 0.4), rng.uniform(0.35, 0.85)),
        (0.10, hue, rng.uniform(0.55, 0.95), rng.uniform(0.4, 0.95)),
    )
    _, *chosen = kinds[rng.choice(len(kinds), p=[kind[0] for kind in kinds])]
    return chosen[0], chosen[1], chosen[2]


def colour(rng: Rng) -> tuple[float, float, float]:
    """A plausible linear RGB reflectance."""
    r, g, b = hsv(*hue_saturation_value(rng))
    return float(r), float(g), float(b)


def palette(rng: Rng, count: int) -> Array:
    """Linear reflectances (count, 3) that go together: unrelated, tones of one hue, or these with an accent."""
    kind = rng.integers(4)
    if kind == 0:
        return np.array([colour(rng) for _ in range(count)])
    hue, saturation, value = hue_saturation_value(rng)
    values = value + rng.uniform(0.03, 0.4) * rng.permutation(np.linspace(-1, 1, count))
    shades = zip(
        hue + rng.normal(0, 0.04, count),
        saturation * rng.uniform(0.7, 1.3, count),
        np.clip(values, 0.08, 1),
        strict=True,
    )
    colours = np.array([hsv(*shade) for shade in shades])
    if kind == 1:
        colours[rng.integers(count)] = hsv(rng.uniform(), rng.uniform(0.5, 1), rng.uniform(0.4, 0.95))
    return colours


class Pattern(NamedTuple):
    """What a texture shows, before it has colours."""

    tone: Array  # (SIZE, SIZE), 0..COLOURS - 1: place in a palette, between whole numbers a mixture of neighbours
    shade: Array  # (SIZE, SIZE), factor on the colour, about 1


PLAIN = np.ones((SIZE, SIZE))


def noise(rng: Rng, smoothness: float, stretch: float = 1.0) -> Array:
    """Periodic noise (SIZE, SIZE) of mean 0 and deviation 1 whose spectrum falls with `smoothness`; longer along x."""
    frequency = np.hypot(np.fft.fftfreq(SIZE)[:, None], np.fft.rfftfreq(SIZE) * stretch)
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((SIZE, SIZE))) * frequency**-smoothness, (SIZE, SIZE))
    return field / field.std()


def two_tones(rng: Rng) -> tuple[int, int]:
    a, b = rng.choice(COLOURS, 2, replace=False)
    return int(a), int(b)


def checks(rng: Rng) -> Pattern:
    """A chequerboard, a gingham or a patchwork."""
    columns, rows = 2 * rng.integers(1, 9, 2)
    i, j = (X * columns).astype(int), (Y * rows).astype(int)
    a, b = two_tones(rng)
    kind = rng.integers(3)
    if kind == 0:
        return Pattern(np.where((i + j) % 2 == 0, a, b), PLAIN)
    if kind == 1:
        return Pattern((i % 2 + j % 2) / 2, PLAIN)
    return Pattern(rng.integers(0, COLOURS, (rows, columns))[j, i], rng.uniform(0.8, 1.2, (rows, columns))[j, i])


def stripes(rng: Rng) -> Pattern:
    """Bands of random widths: upright, level, diagonal, or crossing as in a tartan."""
    bands = int(rng.integers(2, 9))
    edges = np.sort(rng.uniform(0, 1, bands - 1))
    labels = (rng.integers(COLOURS) + np.cumsum(rng.integers(1, COLOURS, bands))) % COLOURS
    repeats = rng.integers(1, 9)

    def bars(t: Array) -> Array:
        return labels[np.searchsorted(edges, t * repeats % 1)].astype(np.float64)

    kind = rng.integers(4)
    return Pattern((bars(X) + bars(Y)) / 2 if kind == 0 else bars((X, Y, X + Y)[kind - 1]), PLAIN)


def bond(rng: Rng, columns: int, rows: int, shift: ArrayLike) -> tuple[NDArray[np.intp], Array]:
    """Bricks in rows shifted by `shift` (rows,) bricks: brick numbers and distances to the nearest joint."""
    row = (Y * rows).astype(int)
    along, across = X * columns + np.broadcast_to(shift, rows)[row], Y * rows
    distance = np.minimum((0.5 - np.abs(along % 1 - 0.5)) / columns, (0.5 - np.abs(across % 1 - 0.5)) / rows)
    return row * columns + along.astype(int) % columns, distance


def planks(rng: Rng) -> Pattern:
    """Boards of wood with their own tones and grain."""
    columns, rows = int(rng.integers(1, 3)), int(rng.integers(4, 13))
    brick, distance = bond(rng, columns, rows, rng.uniform(0, columns, rows))
    # Every board shows another piece of the same wood.
    offset = rng.integers(0, SIZE, columns * rows)[brick]
    x, y = np.indices((SIZE, SIZE))[::-1]
    grain = noise(rng, rng.uniform(0.8, 1.4), rng.uniform(8, 30))[y, (x + offset) % SIZE]
    tone = rng.uniform(0, rng.uniform(0.3, 1), columns * rows)[brick]
    gap = np.where(distance < 0.0025, rng.uniform(0.2, 0.7), 1.0)
    return Pattern(tone, gap * (1 + rng.uniform(0.05, 0.2) * grain))


def tiles(rng: Rng) -> Pattern:
    """Tiles or bricks with grout."""
    columns, rows = int(rng.integers(2, 9)), 2 * int(rng.integers(1, 9))
    brick, distance = bond(rng, columns, rows, rng.choice([0.0, 0.5]) * (np.arange(rows) % 2))
    tone = rng.uniform(0, rng.choice([0.2, 1, COLOURS - 2]), columns * rows)[brick]
    joint = distance < rng.uniform(0.003, 0.012)
    shade = rng.normal(1, rng.uniform(0, 0.12), columns * rows)[brick] * (1 + rng.uniform(0, 0.1) * noise(rng, 1))
    return Pattern(np.where(joint, COLOURS - 1, tone), np.where(joint, 1.0, shade))


def clouds(rng: Rng) -> Pattern:
    """Fractal noise, as on concrete, plaster or rust."""
    smoothness, contrast = rng.uniform(0.8, 1.8), rng.uniform(0.1, 0.8)
    return Pattern((COLOURS - 1) * (0.5 + 0.5 * np.tanh(contrast * noise(rng, smoothness))), PLAIN)


def marble(rng: Rng) -> Pattern:
    """Veins that follow distorted lines."""
    across, along = rng.integers(-3, 4, 2)
    phase = 2 * np.pi * (across * X + along * Y) + rng.uniform(1, 4) * noise(rng, rng.uniform(1.4, 2.0))
    vein = 1 - np.abs(np.sin(phase))
    return Pattern((COLOURS - 1) * vein ** rng.uniform(1, 5), 1 + 0.05 * noise(rng, 1))


def weave(rng: Rng) -> Pattern:
    """Cloth: threads that pass over and under each other, plain or twilled."""
    threads, twill = 12 * int(rng.integers(2, 6)), int(rng.integers(2, 5))
    i, j = (X * threads).astype(int), (Y * threads).astype(int)
    over = (i + j) % twill == 0
    place = np.where(over, X, Y) * threads % 1
    a, b = two_tones(rng)
    uneven = 1 + rng.uniform(0, 0.2) * np.where(over, noise(rng, 1, 0.1), noise(rng, 1, 10))
    return Pattern(np.where(over, a, b), (0.6 + 0.4 * np.sin(np.pi * place)) * uneven)


def figure(rng: Rng, x: Array, y: Array, size: float) -> NDArray[np.bool_]:
    """Where a random disc, ring, polygon or stroke of about `size` about the origin lies."""
    kind, radius = rng.integers(4), size * rng.uniform(0.4, 1)
    if kind < 2:
        distance = np.hypot(x, y)
        return distance < radius if kind == 0 else np.abs(distance - radius) < 0.15 * size
    angle = rng.uniform(0, 2 * np.pi)
    if kind == 2:
        sides = rng.integers(3, 7)
        directions = angle + 2 * np.pi / sides * np.arange(sides)
        return np.max([x * np.cos(a) + y * np.sin(a) for a in directions], axis=0) < radius / 2
    along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    return np.hypot(np.maximum(np.abs(along) - 2 * radius, 0), across) < 0.2 * size


def prints(rng: Rng) -> Pattern:
    """Figures on a ground: one large motif as on a poster, or a small one repeated as on wallpaper."""
    repeats = int(rng.choice([1, 2, 4, 8]))
    count, size = int(rng.integers(2, 16)), rng.uniform(0.08, 0.25)
    cell = SIZE // repeats
    x, y = (axis[:cell, :cell] * repeats for axis in (X, Y))
    tone = np.zeros((cell, cell))
    for cx, cy, label in zip(*rng.uniform(0, 1, (2, count)), rng.integers(1, COLOURS, count), strict=True):
        # Wrapped around, so that figures over the edge go on at the other side.
        tone[figure(rng, (x - cx + 0.5) % 1 - 0.5, (y - cy + 0.5) % 1 - 0.5, size)] = label
    return Pattern(np.tile(tone, (repeats, repeats)), PLAIN)


def scratches(rng: Rng) -> Pattern:
    """Thin straight strokes on a plain ground."""
    count, steps = int(rng.integers(20, 200)), np.linspace(0, 1, SIZE)
    start, angle = (
        rng.uniform(0, 1, (2, count, 1)),
        rng.uniform(0, np.pi) + rng.normal(0, rng.uniform(0.1, 2), (count, 1)),
    )
    length = rng.uniform(0.05, 0.9, (count, 1))
    x, y = start[0] + length * np.cos(angle) * steps, start[1] + length * np.sin(angle) * steps
    tone = np.zeros((SIZE, SIZE))
    tone[(y * SIZE).astype(int) % SIZE, (x * SIZE).astype(int) % SIZE] = rng.uniform(0.3, COLOURS - 1, (count, 1))
    return Pattern(tone, 1 + rng.uniform(0, 0.1) * noise(rng, 1))


PATTERNS: tuple[Callable[[Rng], Pattern], ...] = (
    checks,
    stripes,
    planks,
    tiles,
    clouds,
    marble,
    weave,
    prints,
    scratches,
)


def painted(rng: Rng, colours: Array) -> Array:
    """A random pattern (SIZE, SIZE, C) in `colours` (COLOURS, C), sometimes unevenly worn."""
    tone, shade = PATTERNS[rng.integers(len(PATTERNS))](rng)
    lower = np.clip(tone.astype(int), 0, COLOURS - 2)
    share = (tone - lower)[..., None]
    if rng.random() < 0.4:
        shade = shade * (1 + rng.uniform(0.02, 0.15) * noise(rng, 1.3))
    return (colours[lower] * (1 - share) + colours[lower + 1] * share) * np.maximum(shade, 0)[..., None]


def texture(rng: Rng) -> NDArray[np.float32]:
    """A random reflectance bitmap (SIZE, SIZE, 3), linear RGB."""
    return np.clip(painted(rng, palette(rng, COLOURS)), DARKEST, BRIGHTEST).astype(np.float32)


def gray_texture(rng: Rng, low: float, high: float) -> NDArray[np.float32]:
    """A random bitmap (SIZE, SIZE, 1) of values from `low` to `high`, for roughness."""
    values = painted(rng, rng.permutation(np.linspace(0.2, 1, COLOURS))[:, None])
    values -= values.min()
    return (low + (high - low) * values / max(values.max(), 1e-9)).astype(np.float32)
