"""Pictures of scenes and references of one frame, without a data set."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from errors import BadInput
from eval.figures.contact_sheet import TITLE_INCHES, contact_sheet, displayed_frame
from plotting import DPI


def test_contact_sheet_shows_every_scene(tmp_path):
    """Two rows of two: each place shows its scene, and the last one, without a scene, is white."""
    names = ["cornell_box", "extremes-sky", "room-7"]
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
