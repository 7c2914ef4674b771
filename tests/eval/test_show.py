"""`onespp show`: pictures of a clip for people."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib import image as png

from command_line import main
from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.figures.show import Panel, draw_grid, grids_of, in_rows, show, view_clip
from models.denoiser import Denoiser, State
from models.registry import create
from plotting import save_figure


def clip_of(tiny: Path) -> Path:
    return Dataset(tiny).planned(["test"])[0]


def test_pictures_of_a_clip(tiny, tmp_path, capsys):
    main(["show", str(clip_of(tiny)), "accumulated", "--out", str(tmp_path / "s"), "--runs", str(tmp_path)])
    paths = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [path.name for path in paths] == ["sheet.png", "differences.png", "state-accumulated.png"]
    assert sorted((tmp_path / "s").iterdir()) == sorted(paths)
    denoisers = {"noisy": create("noisy"), "accumulated": create("accumulated")}
    grids = grids_of(*view_clip(Clip(clip_of(tiny)), denoisers, [0, 2, 5, 7]))
    assert {name: len(columns) for name, columns in grids.items()} == {
        "sheet": 3,  # noisy, accumulated, reference
        "differences": 2,
        "state-accumulated": 1,
    }
    save_figure(tmp_path / "sheet.png", draw_grid(grids["sheet"], ["frame 0", "frame 2", "frame 5", "frame 7"]))
    assert np.array_equal(png.imread(paths[0]), png.imread(tmp_path / "sheet.png"))


def test_panels_stand_where_they_belong(tmp_path):
    """Columns from left to right, frames from top to bottom, each as large as it must be, numbers as colours."""
    colours = {(0, 0): (1, 0, 0), (0, 1): (0, 1, 0), (1, 0): (0, 0, 1), (1, 1): (1, 0, 1)}
    panels = {place: Panel(np.full((48, 64, 3), colour, float), str(place)) for place, colour in colours.items()}
    numbers = [Panel(np.full((48, 64), value), "numbers", low=0, high=4) for value in (0.0, 4.0)]
    columns = [[panels[0, 0], panels[0, 1]], [panels[1, 0], panels[1, 1]], numbers]
    figure = draw_grid(columns, ["frame 0", "frame 7"])
    assert [axis.get_ylabel() for axis in figure.axes if axis.get_ylabel()] == ["frame 0", "frame 7"]
    save_figure(tmp_path / "grid.png", figure)
    drawn = png.imread(tmp_path / "grid.png")[..., :3]
    colours |= {(2, 0): colormaps["viridis"](0.0)[:3], (2, 1): colormaps["viridis"](1.0)[:3]}
    left = {}
    top = {}
    for place, colour in colours.items():
        y, x = np.nonzero(np.abs(drawn - colour).max(axis=2) < 1 / 255)
        panel = x < np.median(x) + 110  # without the colour bar to the right of it, which ends in the same colour
        width = np.ptp(x[panel]) + 1
        assert width >= 192 and np.ptp(y[panel]) + 1 == pytest.approx(0.75 * width, abs=2), place
        left[place] = x.min()
        top[place] = y.min()
    assert all(left[column, frame] + 192 < left[column + 1, frame] for column in (0, 1) for frame in (0, 1))
    assert all(top[column, 0] + 0.75 * 192 < top[column, 1] for column in (0, 1, 2))


@pytest.mark.parametrize(("count", "rows", "in_a_row"), [(1, 1, 1), (6, 1, 6), (7, 2, 4), (25, 5, 5), (26, 5, 6)])
def test_panels_in_rows_keep_their_order(count, rows, in_a_row):
    columns = in_rows([Panel(np.full((4, 6, 3), 0.5), str(place)) for place in range(count)])
    assert len(columns) == in_a_row and {len(column) for column in columns} == {rows}
    row_by_row = [columns[place % in_a_row][place // in_a_row] for place in range(rows * in_a_row)]
    assert [panel.caption for panel in row_by_row[:count]] == [str(place) for place in range(count)]
    assert all(panel.caption == "" and (panel.image == 1).all() for panel in row_by_row[count:])
    assert [axis.get_title() for axis in draw_grid(columns, ["frame 0"] * rows).axes][:count] == [
        str(place) for place in range(count)
    ]


def test_panels(tiny):
    """Captions are measured against the reference; states are pictured in the same colours in all frames."""
    clip = Clip(clip_of(tiny))
    (noisy, accumulated), references = view_clip(
        clip, {"noisy": create("noisy"), "accumulated": create("accumulated")}, [0, 7]
    )
    truth = np.clip(clip.exposure * clip.reference(7).mean(axis=0), 0, 1) ** (1 / 2.2)
    np.testing.assert_allclose(references[1].image, truth, atol=2e-3)
    rmse = np.sqrt(((noisy.images[1].image - truth) ** 2).mean())
    name, words = noisy.images[1].caption.split("\n")
    assert name == "noisy" and float(words.split()[1]) == pytest.approx(rmse, abs=2e-4)
    assert float(words.split()[2]) == pytest.approx(-20 * np.log10(rmse), abs=0.02)
    np.testing.assert_allclose(noisy.differences[1].image, np.abs(noisy.images[1].image - truth).mean(2), atol=2e-3)
    assert not noisy.pictures
    ((first, last),) = [c for c in accumulated.state_columns() if c[0].caption == "history length"]
    assert first.image.shape == (64, 64) and (first.image == 1).all() and last.image.max() == pytest.approx(8)
    assert (first.low, first.high) == (last.low, last.high) == pytest.approx((1, 8))


class Painter(Denoiser):
    """Its state has a picture in colour and one with unusable numbers."""

    reads = ("direct", "indirect", "emission")

    def forward(self, frame, state):
        radiance = frame.radiance("total")

        class Pictures(State):
            def pictures(self):
                return {"colour": radiance, "number": radiance[:, :1] * np.nan}

        return radiance, Pictures(frame.moment)


def test_states_in_colour(tiny):
    clip = Clip(clip_of(tiny))
    (track,), _ = view_clip(clip, {"painter": Painter()}, [3])
    colour, number = track.state_columns()
    assert np.array_equal(colour[0].image, track.images[0].image) and colour[0].image.shape == (64, 64, 3)
    assert np.array_equal(number[0].image, np.zeros((64, 64)))


def test_clip_without_reference_or_some_channel(tiny, tmp_path, capsys, shipped):
    """Denoisers that cannot run are skipped with a message, or refused where they are named."""
    copy = shutil.copytree(clip_of(tiny), tmp_path / "clip")
    facts = json.loads((copy / "clip.json").read_text())
    for channel in ("direct_reference", "motion"):
        del facts["channels"][channel]
    (copy / "clip.json").write_text(json.dumps(facts))
    paths = show(copy, tmp_path / "out", tmp_path, "tiny", ["noisy"])
    assert [path.name for path in paths] == ["sheet.png"]
    with pytest.raises(BadInput, match="has no motion"):
        show(copy, tmp_path / "out", tmp_path, "tiny", ["accumulated"])
    show(copy, tmp_path / "out", tmp_path, "tiny")
    out = capsys.readouterr().out
    assert re.search(r"(?m)^accumulated\b.*: skipped, .*clip has no motion", out)
    assert re.search(r"(?m)^rae\b.*: skipped, it has no weights", out)


def test_no_clip_is_an_error(tiny, tmp_path):
    for path in (tmp_path / "nowhere", tiny):
        with pytest.raises(BadInput, match="there is no clip at"):
            show(path, tmp_path / "out", tmp_path, "tiny")
    assert not (tmp_path / "out").exists()
