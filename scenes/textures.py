"""Random bitmap textures for interiors, linear reflectances that repeat seamlessly, and skies. S is TEXTURE_SIZE."""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scenes.camera import Array
from scenes.colours import MAX_REFLECTANCE, MIN_REFLECTANCE, light_colour, palette
from scenes.draws import Rng, log_uniform, one_of, uniforms

TEXTURE_SIZE = 256  # px
PALETTE_SIZE = 4  # colours of a texture
SKY_SIZE = (64, 128)  # rows and columns; kernels of scenes with skies of the same size are shared

# Texture coordinates of all texels' centres.
X, Y = np.meshgrid((np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE, (np.arange(TEXTURE_SIZE) + 0.5) / TEXTURE_SIZE)


class Pattern(NamedTuple):
    """A texture before it has colours."""

    tone: Array  # (S, S), 0..PALETTE_SIZE - 1: position in a palette, interpolated between integers
    shade: Array = np.ones((TEXTURE_SIZE, TEXTURE_SIZE))  # (S, S), factor on the colour, about 1


def periodic_noise(rng: Rng, smoothness: float, stretch: float = 1.0) -> Array:
    """Periodic noise (S, S), mean 0, standard deviation 1, amplitude frequency^-smoothness, stretched along x."""
    frequency = np.hypot(np.fft.fftfreq(TEXTURE_SIZE)[:, None], np.fft.rfftfreq(TEXTURE_SIZE) * stretch)
    frequency[0, 0] = np.inf
    white = np.fft.rfft2(rng.standard_normal((TEXTURE_SIZE, TEXTURE_SIZE)))
    field = np.fft.irfft2(white * frequency**-smoothness, (TEXTURE_SIZE, TEXTURE_SIZE))
    return field / field.std()


def checks(rng: Rng) -> Pattern:
    """A chequerboard, a gingham or a patchwork."""
    columns, rows = 2 * rng.integers(1, 9, 2)
    i = (X * columns).astype(int)
    j = (Y * rows).astype(int)
    a, b = rng.choice(PALETTE_SIZE, 2, replace=False)
    kind = rng.integers(3)
    if kind == 0:
        return Pattern(np.where((i + j) % 2 == 0, a, b))
    if kind == 1:
        return Pattern((i % 2 + j % 2) / 2)
    tones = rng.integers(0, PALETTE_SIZE, (rows, columns))
    shades = rng.uniform(0.8, 1.2, (rows, columns))
    return Pattern(tones[j, i], shades[j, i])


def stripes(rng: Rng) -> Pattern:
    """Bands of random widths: upright, level, diagonal, or crossing as in a tartan."""
    bands = int(rng.integers(2, 9))
    edges = np.sort(rng.uniform(0, 1, bands - 1))
    labels = (rng.integers(PALETTE_SIZE) + np.cumsum(rng.integers(1, PALETTE_SIZE, bands))) % PALETTE_SIZE
    repeats = rng.integers(1, 9)

    def bars(t: Array) -> Array:
        return labels[np.searchsorted(edges, t * repeats % 1)].astype(np.float64)

    kind = rng.integers(4)
    if kind == 0:
        return Pattern((bars(X) + bars(Y)) / 2)
    return Pattern(bars((X, Y, X + Y)[kind - 1]))


def bond(columns: int, rows: int, shift: ArrayLike) -> tuple[NDArray[np.intp], Array]:
    """A bond of bricks whose rows are shifted by `shift` (rows,) bricks.

    Returns brick numbers (S, S), 0 to columns * rows - 1, and distances (S, S) to the nearest joint, in texture widths.
    """
    row = (Y * rows).astype(int)
    along = X * columns + np.broadcast_to(shift, rows)[row]
    distance = np.minimum((0.5 - np.abs(along % 1 - 0.5)) / columns, (0.5 - np.abs(Y * rows % 1 - 0.5)) / rows)
    return row * columns + along.astype(int) % columns, distance


def planks(rng: Rng) -> Pattern:
    """Boards of wood with their own tones and grain."""
    columns = int(rng.integers(1, 3))
    rows = int(rng.integers(4, 13))
    brick, distance = bond(columns, rows, rng.uniform(0, columns, rows))
    # Every board shows another piece of the same wood.
    offset = rng.integers(0, TEXTURE_SIZE, columns * rows)[brick]
    x, y = np.indices((TEXTURE_SIZE, TEXTURE_SIZE))[::-1]
    grain = periodic_noise(rng, rng.uniform(0.8, 1.4), rng.uniform(8, 30))[y, (x + offset) % TEXTURE_SIZE]
    tone = rng.uniform(0, rng.uniform(0.3, 1), columns * rows)[brick]
    gap = np.where(distance < 0.0025, rng.uniform(0.2, 0.7), 1.0)
    return Pattern(tone, gap * (1 + rng.uniform(0.05, 0.2) * grain))


def tiles(rng: Rng) -> Pattern:
    """Tiles or bricks with grout."""
    columns = int(rng.integers(2, 9))
    rows = 2 * int(rng.integers(1, 9))
    brick, distance = bond(columns, rows, rng.choice([0.0, 0.5]) * (np.arange(rows) % 2))
    tone = rng.uniform(0, rng.choice([0.2, 1, PALETTE_SIZE - 2]), columns * rows)[brick]
    joint = distance < rng.uniform(0.003, 0.012)
    shade = rng.normal(1, rng.uniform(0, 0.12), columns * rows)[brick]
    shade *= 1 + rng.uniform(0, 0.1) * periodic_noise(rng, 1)
    return Pattern(np.where(joint, PALETTE_SIZE - 1, tone), np.where(joint, 1.0, shade))


def clouds(rng: Rng) -> Pattern:
    """Fractal noise, as on concrete, plaster or rust."""
    smoothness, contrast = uniforms(rng, (0.8, 1.8), (0.1, 0.8))
    return Pattern((PALETTE_SIZE - 1) * (0.5 + 0.5 * np.tanh(contrast * periodic_noise(rng, smoothness))))


def marble(rng: Rng) -> Pattern:
    """Veins that follow distorted lines."""
    across, along = rng.integers(-3, 4, 2)
    phase = 2 * np.pi * (across * X + along * Y) + rng.uniform(1, 4) * periodic_noise(rng, rng.uniform(1.4, 2.0))
    vein = 1 - np.abs(np.sin(phase))
    return Pattern((PALETTE_SIZE - 1) * vein ** rng.uniform(1, 5), 1 + 0.05 * periodic_noise(rng, 1))


def weave(rng: Rng) -> Pattern:
    """Cloth, in a plain weave or a twill."""
    threads = 12 * int(rng.integers(2, 6))
    twill = int(rng.integers(2, 5))
    i = (X * threads).astype(int)
    j = (Y * threads).astype(int)
    over = (i + j) % twill == 0
    place = np.where(over, X, Y) * threads % 1
    a, b = rng.choice(PALETTE_SIZE, 2, replace=False)
    uneven = 1 + rng.uniform(0, 0.2) * np.where(over, periodic_noise(rng, 1, 0.1), periodic_noise(rng, 1, 10))
    return Pattern(np.where(over, a, b), (0.6 + 0.4 * np.sin(np.pi * place)) * uneven)


def motif(rng: Rng, x: Array, y: Array, size: float) -> NDArray[np.bool_]:
    """The mask of points `x`, `y` (...,) in a random disc, ring, polygon or stroke of about `size` at the origin."""
    kind = rng.integers(4)
    radius = size * rng.uniform(0.4, 1)
    if kind < 2:
        distance = np.hypot(x, y)
        return distance < radius if kind == 0 else np.abs(distance - radius) < 0.15 * size
    angle = rng.uniform(0, 2 * np.pi)
    if kind == 2:
        sides = rng.integers(3, 7)
        directions = angle + 2 * np.pi / sides * np.arange(sides)
        return np.max([x * np.cos(a) + y * np.sin(a) for a in directions], axis=0) < radius / 2
    along = x * np.cos(angle) + y * np.sin(angle)
    across = y * np.cos(angle) - x * np.sin(angle)
    return np.hypot(np.maximum(np.abs(along) - 2 * radius, 0), across) < 0.2 * size


def prints(rng: Rng) -> Pattern:
    """Motifs on a ground: large as on a poster, or small and repeated as on wallpaper."""
    repeats = int(rng.choice([1, 2, 4, 8]))
    count = int(rng.integers(2, 16))
    size = rng.uniform(0.08, 0.25)
    cell = TEXTURE_SIZE // repeats
    x = X[:cell, :cell] * repeats
    y = Y[:cell, :cell] * repeats
    tone = np.zeros((cell, cell))
    centres = rng.uniform(0, 1, (2, count))
    for cx, cy, label in zip(*centres, rng.integers(1, PALETTE_SIZE, count), strict=True):
        # Motifs wrap around at the edges.
        tone[motif(rng, (x - cx + 0.5) % 1 - 0.5, (y - cy + 0.5) % 1 - 0.5, size)] = label
    return Pattern(np.tile(tone, (repeats, repeats)))


def scratches(rng: Rng) -> Pattern:
    """Thin straight strokes on a plain ground."""
    count = int(rng.integers(20, 200))
    steps = np.linspace(0, 1, TEXTURE_SIZE)
    start = rng.uniform(0, 1, (2, count, 1))
    angle = rng.uniform(0, np.pi) + rng.normal(0, rng.uniform(0.1, 2), (count, 1))
    length = rng.uniform(0.05, 0.9, (count, 1))
    x = start[0] + length * np.cos(angle) * steps
    y = start[1] + length * np.sin(angle) * steps
    row, column = ((t * TEXTURE_SIZE).astype(int) % TEXTURE_SIZE for t in (y, x))
    tone = np.zeros((TEXTURE_SIZE, TEXTURE_SIZE))
    tone[row, column] = rng.uniform(0.3, PALETTE_SIZE - 1, (count, 1))
    return Pattern(tone, 1 + rng.uniform(0, 0.1) * periodic_noise(rng, 1))


PATTERNS = (checks, stripes, planks, tiles, clouds, marble, weave, prints, scratches)


def painted(rng: Rng, colours: Array) -> Array:
    """A random pattern (S, S, C) in `colours` (PALETTE_SIZE, C), sometimes unevenly worn."""
    tone, shade = one_of(rng, PATTERNS)(rng)
    lower = np.clip(tone.astype(int), 0, PALETTE_SIZE - 2)
    share = (tone - lower)[..., None]
    if rng.random() < 0.4:
        shade = shade * (1 + rng.uniform(0.02, 0.15) * periodic_noise(rng, 1.3))
    return (colours[lower] * (1 - share) + colours[lower + 1] * share) * np.maximum(shade, 0)[..., None]


def texture(rng: Rng) -> NDArray[np.float32]:
    """A random bitmap (S, S, 3) of reflectances, linear RGB, MIN_REFLECTANCE to MAX_REFLECTANCE."""
    return np.clip(painted(rng, palette(rng, PALETTE_SIZE)), MIN_REFLECTANCE, MAX_REFLECTANCE).astype(np.float32)


def gray_texture(rng: Rng, low: float, high: float) -> NDArray[np.float32]:
    """A random bitmap (S, S, 1) of values from `low` to `high`, such as roughness; constant `low` in a few cases."""
    values = painted(rng, rng.permutation(np.linspace(0.2, 1, PALETTE_SIZE))[:, None])
    values -= values.min()
    return (low + (high - low) * values / max(values.max(), 1e-9)).astype(np.float32)


def sky(rng: Rng, sun: Array | None) -> Array:
    """Radiance (*SKY_SIZE, 3) of a sky over dark ground: latitude-longitude, y up.

    `sun` is the direction (3,) to the sun, or None under clouds. The sun gives 0.3 to 30 times the light of its sky.
    """
    height, width = SKY_SIZE
    up = np.cos(np.pi * ((np.arange(height) + 0.5) / height))[:, None, None]
    zenith = rng.uniform(0.6, 1.0, 3) * [0.4, 0.6, 1.0]
    horizon = rng.uniform(0.6, 1.0, 3) * [0.9, 0.95, 1.0]
    ground = rng.uniform(0.5, 1.0, 3) * 0.2
    blend = np.clip(up, 0, 1) ** 0.5
    image = np.where(up > 0, zenith * blend + horizon * (1 - blend), ground)
    image = np.repeat(image, width, axis=1)
    if sun is not None:
        x, y, z = sun / np.linalg.norm(sun)
        row = np.arccos(y) / np.pi * height
        column = np.arctan2(x, -z) / np.pi / 2 % 1 * width
        image[int(row), int(column)] += light_colour(rng) * log_uniform(rng, 300, 20000)
    return np.asarray(image)
