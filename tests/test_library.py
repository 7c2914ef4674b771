"""`import onespp`: the examples of docs/library.md as they are written, and what own arrays become."""

import re

import numpy as np
import pytest
import torch

import onespp
from errors import BadInput
from models.registry import create
from models.weights import save_weights
from provenance import ROOT
from scenes.camera import intrinsics, look_at

PAGE = (ROOT / "docs" / "library.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.mark.parametrize("example", EXAMPLES, ids=range(len(EXAMPLES)))
def test_examples_run_as_written(example, tiny, tmp_path, monkeypatch, capsys):
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "tiny").symlink_to(tiny)
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "docs/library.md", "exec"), {"__name__": "example"})
    assert capsys.readouterr().out


def test_networks_have_their_shipped_weights(shipped, tmp_path):
    with pytest.raises(BadInput, match="'wskp3' needs trained weights"):
        onespp.load("wskp3")
    others = tmp_path / "others"
    for path in (shipped / "wskp3.safetensors", others):
        save_weights(create("wskp3"), "wskp3", {}, path)
    given = onespp.load("wskp3", shipped / "wskp3.safetensors", torch.float32).state_dict()
    for name, weights, same in (("wskp3", None, True), ("wskp3+taa", None, True), ("wskp3", others, False)):
        found = list(onespp.load(name, weights, torch.float32).state_dict().values())
        assert all(map(torch.equal, found, given.values())) == same
    with pytest.raises(BadInput, match="'wskp3@quick' are weights in a folder of runs"):
        onespp.load("wskp3@quick")
    with pytest.raises(BadInput, match="no denoiser computes in float64: use one of float32, bfloat16"):
        onespp.load("wskp3", precision=torch.float64)
    with pytest.raises(BadInput, match="there is no device 'gpu'"):
        onespp.load("svgf", device="gpu")
    if not torch.cuda.is_available():
        with pytest.raises(BadInput, match="no CUDA device"):
            onespp.load("svgf", device="cuda:0")


def arrays(index: int, size: tuple[int, int] = (24, 32)) -> dict:
    rng = np.random.default_rng(index)
    return {"colour": rng.exponential(1.0, (*size, 3)), "motion": np.zeros((*size, 2))}


def test_own_arrays_are_averaged_where_they_have_motion():
    denoiser = onespp.load("accumulated")
    still = [*onespp.denoise(denoiser, onespp.frames((arrays(i) for i in range(4)), denoiser))]
    expected = np.mean([arrays(i)["colour"] for i in range(4)], axis=0)
    np.testing.assert_allclose(still[-1], expected, rtol=1e-5)


def test_without_motion_and_cameras_there_is_no_history():
    denoiser = onespp.load("accumulated")
    sequence = ({"colour": arrays(i)["colour"]} for i in range(3))
    *_, last = onespp.denoise(denoiser, onespp.frames(sequence, denoiser))
    np.testing.assert_allclose(last, arrays(2)["colour"], rtol=1e-6)


def test_motion_from_cameras_and_depth():
    """A wall at depth 5, its camera moved by 0.1 to the right: it moves by focal length · 0.1 / 5 pixels."""
    size = (24, 32)
    K = intrinsics(60.0, *size)

    def wall(index: int) -> dict:
        eye = np.array([0.1 * index, 0.0, 0.0])
        camera = onespp.camera(K, look_at(eye, eye - [0.0, 0.0, 1.0]))
        return {"colour": arrays(index, size)["colour"], "depth": np.full((*size, 1), 5.0), "camera": camera}

    first, second = onespp.frames(map(wall, range(2)), onespp.load("accumulated"))
    assert (first.motion == 0).all()
    np.testing.assert_allclose(second.motion[0, 0], -K[0, 0] * 0.1 / 5, rtol=1e-5)
    np.testing.assert_allclose(second.motion[0, 1], 0, atol=1e-5)
    np.testing.assert_allclose(second.normal[0, 2], 1, rtol=1e-5)


def test_bad_pixels_and_background_of_own_arrays():
    broken = arrays(0) | {"depth": np.ones((24, 32, 1)), "albedo": np.full((24, 32, 3), 7.0)}
    broken["colour"][3, 4, 1] = np.nan
    broken["depth"][:, :8] = 0
    given = broken["colour"].copy()
    denoiser = onespp.load("svgf")
    (frame,) = onespp.frames([broken], denoiser)
    assert torch.isfinite(frame.radiance("total")).all() and (frame.albedo == 1).all()
    (image,) = onespp.denoise(denoiser, [frame])
    assert np.isfinite(image).all()
    np.testing.assert_allclose(
        image[:, :8], np.nan_to_num(given[:, :8] * ~np.isnan(given[:, :8]).any(-1, keepdims=True))
    )
    np.testing.assert_array_equal(broken["colour"], given)  # one's own arrays stay


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": np.zeros((4, 4))}, "'colour' has the shape"),
        ({"depth": np.zeros((24, 32, 3))}, r"'depth' has the shape \(24, 32, 3\), not \(24, 32, 1\)"),
        ({"colours": np.zeros((24, 32, 3))}, "unknown quantity 'colours'"),
        ({"camera": (np.eye(3), np.eye(4))}, "'camera' is of type tuple: make it by onespp.camera"),
    ],
)
def test_unusable_arrays_are_named(changes, message):
    with pytest.raises(BadInput, match=message):
        next(onespp.frames([arrays(0) | changes], onespp.load("noisy")))
    with pytest.raises(BadInput, match="frame 1 of the arrays: 'motion'"):
        [*onespp.frames([arrays(0), {"colour": np.zeros((24, 32, 3))}], onespp.load("noisy"))]


def test_denoisers_of_what_arrays_lack_are_refused():
    with pytest.raises(BadInput, match=r'SVGF denoises indirect light.*onespp.load\(..., signal="total"\)'):
        next(onespp.frames([arrays(0)], onespp.load("svgf+taa", signal="indirect")))
    with pytest.raises(BadInput, match="ASVGF reads gradient, which only onespp renders: use another, such as svgf"):
        next(onespp.frames([arrays(0)], onespp.load("asvgf")))
    assert next(onespp.frames([arrays(0)], create("ntd", "total"))).radiance("total").mean() > 0.5


@pytest.mark.parametrize("spp", [0.0, -1.0, float("nan"), float("inf")])
def test_sample_counts_out_of_range_are_refused(spp):
    with pytest.raises(BadInput, match="is not a number of samples"):
        next(onespp.frames([arrays(0)], onespp.load("noisy"), spp))


def test_public_names_are_documented():
    for name in onespp.__all__:
        assert getattr(onespp, name).__doc__ and f"onespp.{name}" in PAGE, name
