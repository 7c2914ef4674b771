"""Clips with references of some frames only: the rest is denoised, not measured."""

import numpy as np
import pytest

from datasets.clip import Clip
from datasets.exr import export_clip
from errors import BadInput
from eval.harness import evaluate
from eval.report.page import report
from eval.results import read_results
from render.job.generate import generate
from render.scene_file.description import read_description
from tests.helpers.scene_files import write, xml

JUDGED = [1, 2, 4]
TOML = "[splits.train]\nclips = 0\n[splits.val]\nclips = 0\n[splits.test]\nreference_spp = 8\nmost_spp = 8\n"
NAMES = ("noisy", "svgf")


def results_of(folder, toml):
    """The dataset of a scene with that TOML, evaluated: its only clip, and results by denoiser."""
    folder.mkdir()
    path = write(folder, xml())
    path.write_text(f'file = "scene.xml"\nresolution = [24, 24]\nframes = 5\n{TOML}{toml}')
    generate(folder / "data", str(path), seed=0, reads=())
    evaluate([folder / "data"], folder, "quick", NAMES)
    _, (clip,) = read_results(folder)
    return Clip(folder / "data" / "test" / "my" / "000"), clip


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """With references of all frames, and with some."""
    root = tmp_path_factory.mktemp("judged")
    return root, results_of(root / "all", ""), results_of(root / "some", f"judged = {JUDGED}\n")


def test_judged_frames_have_the_references_and_metrics_that_they_always_have(both):
    _, (full, all_results), (sparse, results) = both
    assert sparse.judged == JUDGED and full.judged == [*range(5)]
    assert sparse.map("direct_reference").shape[0] == len(JUDGED) < full.map("direct_reference").shape[0]
    for frame in JUDGED:
        assert np.array_equal(sparse.reference(frame), full.reference(frame))
    for ours, theirs in zip(results.results, all_results.results, strict=True):
        for frame, (values, wanted) in enumerate(zip(ours.frames, theirs.frames, strict=True)):
            if frame not in JUDGED:
                assert values == {}
                continue
            ratio = values["mse"] / wanted["mse"]  # the exposure is that of the judged frames
            assert ratio == pytest.approx(1, rel=0.2)
            # What changes in time needs the frame before as well.
            assert (values["temporal_error"] is None) == (frame != 2)


def test_what_needs_references_takes_the_judged_frames(both):
    root, _, (sparse, results) = both
    page, *_, animation = report(root / "some")
    assert page.exists() and animation.exists()
    assert results.reference.judged == JUDGED
    assert export_clip(sparse.path, root / "exr") == 5
    with pytest.raises(BadInput, match=r"no reference of frame 0: `judged`"):
        sparse.reference(0)


@pytest.mark.parametrize(
    ("split", "frames", "reason"),
    [("train", [0], "unknown field `judged`"), ("test", [1, 0], "rising order"), ("test", [2], "from 0 to 1")],
)
def test_frames_that_cannot_be_judged_are_refused(tmp_path, split, frames, reason):
    path = write(tmp_path, xml(), f"[splits.{split}]\njudged = {frames}\n")
    with pytest.raises(BadInput, match=reason):
        read_description(path)
