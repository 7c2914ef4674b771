"""The frame in three strips: which picture is where, and a small one from end to end."""

import numpy as np
from PIL import Image

from eval.figures.triptych import in_strips, triptych


def test_strips_are_in_their_order_and_slant_to_the_left():
    pictures = tuple(np.full((40, 200, 3), value) for value in (0.1, 0.2, 0.3))
    picture = in_strips(pictures)
    for row in picture[..., 0]:
        assert row[0] == 0.1 and row[106] == 0.2 and row[-1] == 0.3
        assert (np.diff(row[row < 1]) >= 0).all() and 4 <= (row == 1).sum() <= 8
    first_cuts = (picture[..., 0] == 1).argmax(axis=1)
    assert first_cuts[0] > first_cuts[-1]


def test_a_small_one(tmp_path):
    out = tmp_path / "triptych.png"
    triptych(out, "cornell_box", "svgf", tmp_path, frame=2, spp=4, size=(24, 40))
    with Image.open(out) as image:
        assert image.size == (40, 24)
        pixels = np.asarray(image).astype(float)
    assert pixels.std() > 10
