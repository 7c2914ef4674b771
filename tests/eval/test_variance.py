"""SVGF's synthetic test (§5.2)."""

import numpy as np
import torch
from matplotlib import image as png

from datasets.tonemap import display
from eval.figures.variance import alphas, draw_rows, filtered_pattern, pattern, sample
from plotting import save_figure


def test_the_input_s_expectation_is_the_pattern_and_its_variance_grows():
    reference = torch.full((4000, 9), 0.5)
    noisy = sample(reference, torch.Generator().manual_seed(0))
    relative = (noisy.var(dim=0) / 0.25)[3:]  # to the left the lit out-number the dark by too much to measure
    alpha = alphas(9)
    torch.testing.assert_close(relative, (alpha / (1 - alpha))[3:], rtol=0.3, atol=0)
    error = (noisy.mean(dim=0) / 0.5 - 1).abs()
    assert (error <= 5 * (alpha / (1 - alpha) / 4000).sqrt() + 1e-6).all()


def test_temporal_variance_keeps_what_spatial_variance_blurs():
    """The paper's claim: sharper in regions of less noise, and broken only by more of it."""
    images = filtered_pattern((64, 256), frames=16)
    reference = pattern(64, 256)
    error = {name: (image - reference).square().mean(dim=0).sqrt() for name, image in images.items()}
    spatial = error["spatial variance estimate"]
    temporal = error["temporal variance estimate"]
    assert temporal[:128].mean() < 0.4 * spatial[:128].mean()
    assert temporal[128:].mean() < spatial[128:].mean()
    assert temporal[:64].mean() < temporal[64:128].mean() < temporal[128:].mean()


def test_the_figure_shows_all_rows(tmp_path):
    images = filtered_pattern(frames=2)
    figure = draw_rows(images)
    save_figure(tmp_path / "variance.png", figure)
    names = ["input", "spatial variance estimate", "temporal variance estimate", "reference"]
    assert [axis.get_title(loc="left") for axis in figure.axes] == list(images) == names
    written = png.imread(tmp_path / "variance.png")[..., 0]
    height, width = images["input"].shape
    assert written.shape[1] == width
    for axis, image in zip(figure.axes, images.values(), strict=True):
        top = round(len(written) - axis.get_window_extent().y1)
        difference = written[top : top + height] - display(image, 1.0).numpy()
        assert np.abs(difference).mean() < 0.01, axis.get_title(loc="left")
