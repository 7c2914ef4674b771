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
from scenes.camera import intrinsics, look_at, pixel_centres, unproject

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


def wall(index: int, geometry: str | None, size: tuple[int, int] = (24, 32)) -> dict:
    """A wall at depth 5, its camera moved by 0.1 to the right."""
    eye = np.array([0.1 * index, 0.0, 7.0])
    camera = onespp.camera(intrinsics(60.0, *size), look_at(eye, eye - [0.0, 0.0, 1.0]))
    points = unproject(pixel_centres(*size), np.full(size, 5.0), camera)
    distance = np.linalg.norm(points - eye, axis=-1, keepdims=True)
    geometries = {"depth": np.full((*size, 1), 5.0), "distance": distance, "position": points}
    given = {geometry: geometries[geometry]} if geometry else {}
    return {"colour": arrays(index, size)["colour"], "camera": camera} | given


@pytest.mark.parametrize("geometry", ["depth", "distance", "position"])
def test_motion_from_cameras_and_depth(geometry):
    """The wall moves by focal length · 0.1 / 5 pixels."""
    first, second = onespp.frames((wall(index, geometry) for index in range(2)), onespp.load("accumulated"))
    K = intrinsics(60.0, 24, 32)
    assert (first.motion == 0).all()
    np.testing.assert_allclose(second.depth, 5, rtol=1e-5)
    np.testing.assert_allclose(second.motion[0, 0], -K[0, 0] * 0.1 / 5, rtol=1e-5)
    np.testing.assert_allclose(second.motion[0, 1], 0, atol=1e-5)
    np.testing.assert_allclose(second.normal[0, 2], 1, rtol=1e-5)


def test_a_camera_without_depth_gives_no_history():
    denoiser = onespp.load("accumulated")
    *_, last = onespp.denoise(denoiser, onespp.frames((wall(index, None) for index in range(3)), denoiser))
    np.testing.assert_allclose(last, arrays(2)["colour"], rtol=1e-6)


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
        ({"camera": None}, "'camera' is of type NoneType"),
        ({"colour": "x"}, "'colour' has no real numbers, but <U1"),
        ({"colour": np.ones((24, 32, 3), complex)}, "'colour' has no real numbers, but complex"),
        ({"colour": torch.ones((24, 32, 3), requires_grad=True)}, "'colour' is no array .*detach"),
        ({"colour": torch.ones((24, 32, 3), dtype=torch.bfloat16)}, "'colour' is no array .* BFloat16"),
        ({"colour": np.ones((0, 32, 3)), "motion": np.ones((0, 32, 2))}, "'colour' has no pixels"),
        ({"depth": np.full((24, 32, 1), -1.0)}, "the depth is negative: change its sign"),
    ],
)
def test_unusable_arrays_are_named(changes, message):
    with pytest.raises(BadInput, match=message):
        next(onespp.frames([arrays(0) | changes], onespp.load("noisy")))
    with pytest.raises(BadInput, match="frame 0 of the arrays is of type str"):
        next(onespp.frames(arrays(0), onespp.load("noisy")))
    with pytest.raises(BadInput, match="frame 1 of the arrays: 'motion'"):
        [*onespp.frames([arrays(0), {"colour": np.zeros((24, 32, 3))}], onespp.load("noisy"))]


K = intrinsics(60.0, 24, 32)


@pytest.mark.parametrize(
    ("K", "pose", "message"),
    [
        (np.eye(4), np.eye(4), "K of a camera has to be 3 x 3"),
        (K, np.eye(4)[:3], "camera_to_world of a camera has to be 4 x 4"),
        (np.nan * K, np.eye(4), "K .* finite"),
        (np.zeros((3, 3)), np.eye(4), "negative focal lengths"),
        (-K, np.eye(4), "negative focal lengths"),
        (K + np.eye(3, k=1), np.eye(4), "no shear"),
        (K, 2 * np.eye(4), "rotation and translation"),
        (K, np.full((4, 4), "x"), "camera_to_world of a camera has no real numbers"),
    ],
)
def test_unusable_cameras_are_named(K, pose, message):
    with pytest.raises(BadInput, match=message):
        onespp.camera(K, pose)


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
