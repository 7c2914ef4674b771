"""Figures that need no data set: pictures of scenes and the frame in three strips."""

import numpy as np
import pytest
from matplotlib import pyplot as plt
from PIL import Image

from errors import BadInput
from eval.figures.contact_sheet import TITLE_INCHES, contact_sheet, displayed_frame
from eval.figures.triptych import in_strips, triptych
from plotting import DPI


def test_contact_sheet_shows_every_scene(tmp_path):
    """Two rows of two: each place shows its scene, and the last one, without a scene, is white."""
    names = ["cornell_box", "extremes-sky", "cornell_box_moving"]
    height = 24
    width = 32
    contact_sheet(tmp_path / "sheet.png", names, size=(height, width), spp=2)
    image = plt.imread(tmp_path / "sheet.png")[..., :3]
    title = round(TITLE_INCHES * DPI)
    assert image.shape == (2 * (title + height), 2 * width, 3)
    places = [image[title:][:height, :width], image[title:][:height, width:]]
    places += [image[-height:, :width], image[-height:, width:]]
    for name, place in zip(names, places, strict=False):
        shown = displayed_frame(name, 0, 12, 24, height, width, spp=2)
        inner = (slice(6, -6), slice(6, -6))  # pictures lie within two pixels of their places
        np.testing.assert_allclose(place[inner].mean(axis=(0, 1)), shown[inner].mean(axis=(0, 1)), atol=0.01)
    assert (places[3] == 1).all()
    with pytest.raises(BadInput, match="unknown scene 'castle'"):
        contact_sheet(tmp_path / "sheet.png", ["castle"])
    for options in ({"seed": -1}, {"spp": 0}):
        with pytest.raises(BadInput, match="use a seed of 0 or more, and at least one sample"):
            contact_sheet(tmp_path / "sheet.png", names, **options)


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
