"""The page that relights: pixels of one shared exponent, and in a browser the sum of the lights as they are set."""

import base64
import io

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image
from selenium.webdriver.common.by import By
from selenium.webdriver.support.ui import WebDriverWait

from command_line import main
from datasets.tonemap import clip_exposure, display, luminance
from denoise import relight
from denoise.relight import RGB9E5_MAX, shared_exponents
from tests.helpers.browser import chromium, needs_browser, no_errors, set_media
from tests.test_cli import fails

SIZE = (12, 16)
LIGHTS = ("key", "fill")


def decoded(words: np.ndarray) -> np.ndarray:
    """RGB9E5 by its definition, OpenGL 4.6, §8.5.2: mantissa times 2 to the power of exponent - 24."""
    mantissas = np.stack([words & 511, words >> 9 & 511, words >> 18 & 511], axis=-1)
    return mantissas * 2.0 ** ((words >> 27).astype(float) - 24)[..., None]


@given(arrays(np.float32, (2, 3, 3), elements=st.floats(-1, 6e4, width=32)))
def test_pixels_are_within_half_a_step_of_their_brightest_channel(radiance):
    expected = radiance.astype(float).clip(0, RGB9E5_MAX)
    step = np.maximum(expected.max(axis=-1, keepdims=True) / 512, 2.0**-25)
    assert (np.abs(decoded(shared_exponents(radiance)) - expected) <= step).all()


def test_extremes_of_pixels():
    radiance = np.array([[[np.inf, 0, 0], [np.nan, 1, -np.inf], [1e30, 1e30, 0], [0.9999, 0, 0], [0, 0, 1e-30]]])
    found = decoded(shared_exponents(radiance))[0]
    assert found.tolist() == [[RGB9E5_MAX, 0, 0], [0, 1, 0], [RGB9E5_MAX, RGB9E5_MAX, 0], [1, 0, 0], [0, 0, 0]]


@pytest.fixture(scope="module")
def lights() -> np.ndarray:
    """Of two frames, (frame, light, H, W, 3)."""
    return np.random.default_rng(0).uniform(0.1, 1, (2, 2, *SIZE, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def folder(lights, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lit")
    for index, frame in enumerate(lights):
        channels = {
            f"{name}.{c}": light[..., i].copy()
            for name, light in zip(LIGHTS, frame, strict=True)
            for i, c in enumerate("RGB")
        }
        channels |= {c: frame.sum(axis=0)[..., i].copy() for i, c in enumerate("RGB")}
        channels["A"] = np.ones(SIZE, np.float32)
        OpenEXR.File({}, channels).write(str(folder / f"lit.{index}.exr"))
    return folder


@pytest.fixture(scope="module")
def page(folder, tmp_path_factory):
    out = tmp_path_factory.mktemp("page") / "relight.html"
    main(["relight", str(folder / "*.exr"), "--lights", *LIGHTS, "--out", str(out)])
    return out


@pytest.fixture(scope="module")
def browser():
    with chromium() as driver:
        set_media(driver, 1366, 768)
        yield driver


def pixels(browser) -> np.ndarray:
    """What the canvas shows, (H, W, 3)."""
    url = browser.execute_script("return document.getElementById('canvas').toDataURL('image/png')")
    content = base64.b64decode(url.partition(",")[2])
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def set_value(browser, element, value) -> None:
    script = "arguments[0].value = arguments[1]; arguments[0].dispatchEvent(new Event('input', {bubbles: true}))"
    browser.execute_script(script, element, value)


@needs_browser
def test_the_page_adds_lights_as_they_are_set(browser, page, lights):
    browser.get(page.as_uri())
    find = browser.find_element
    WebDriverWait(browser, 20).until(lambda _: find(By.ID, "canvas").get_attribute("data-shown") == "0")
    exposure = clip_exposure(luminance(lights[0].sum(axis=0)))

    def shows(radiance):
        assert np.abs(pixels(browser) - 255 * display(radiance, exposure)).max() <= 2

    shows(lights[0].sum(axis=0))
    key, fill = browser.find_elements(By.CSS_SELECTOR, "#lights tr")
    assert [row.find_element(By.TAG_NAME, "th").text for row in (key, fill)] == [*LIGHTS]
    set_value(browser, key.find_element(By.CLASS_NAME, "stops"), "-2")
    shows(lights[0, 0] / 4 + lights[0, 1])
    fill.find_element(By.CLASS_NAME, "on").click()
    shows(lights[0, 0] / 4)
    set_value(browser, key.find_element(By.CLASS_NAME, "colour"), "#ff0080")
    shows(lights[0, 0] / 4 * [1, 0, (128 / 255) ** 2.2])
    set_value(browser, find(By.ID, "frame"), "1")
    find(By.ID, "reset").click()
    shows(lights[1].sum(axis=0))
    set_value(browser, find(By.ID, "exposure"), "-1")
    shows(lights[1].sum(axis=0) / 2)
    find(By.ID, "play").click()
    WebDriverWait(browser, 20).until(lambda _: find(By.ID, "canvas").get_attribute("data-shown") == "0")
    assert no_errors(browser)


def test_more_frames_than_a_browser_holds_are_refused(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(relight, "MOST_PAGE_PIXELS", 2 * 12 * 16 + 1)
    arguments = ["relight", str(folder / "*.exr"), "--lights", *LIGHTS, "--out", str(tmp_path / "page.html")]
    assert "2 frames are too many for a page: show 1 of them with --frames A-B" in fails(capsys, *arguments)
    main([*arguments, "--frames", "1"])


def written(folder, name: str, image: np.ndarray) -> str:
    """A file with `image` (H, W, 3) as both lights."""
    channels = {f"{light}.{c}": image[..., i].astype(np.float32) for light in LIGHTS for i, c in enumerate("RGB")}
    OpenEXR.File({}, channels).write(str(folder / name))
    return str(folder / name)


@pytest.mark.parametrize("image", [np.zeros((1, 1, 3)), np.full((1, 2, 3), 65504.0), np.full((2, 1, 3), np.nan)])
def test_images_of_one_value(tmp_path, image):
    content = relight.relit([written(tmp_path, "1.exr", image)], LIGHTS)
    assert (content["height"], content["width"]) == image.shape[:2] and 0 < content["exposure"] <= 1


def test_a_pixel_that_is_infinite_leaves_the_exposure_to_the_others(tmp_path):
    image = np.full((64, 64, 3), 0.5)
    plain = relight.relit([written(tmp_path, "1.exr", image)], LIGHTS)["exposure"]
    image[3, 4] = np.inf
    assert relight.relit([written(tmp_path, "2.exr", image)], LIGHTS)["exposure"] == pytest.approx(plain, rel=0.01)


def test_what_is_no_light_is_refused(folder, tmp_path, capsys):
    out = tmp_path / "page.html"
    for names, message in (
        (["key", "missing"], "has no layer or channel 'missing'"),
        (["key", "A"], "'A' has one channel, and so is no light"),
        (["key", "key"], "name the lights' layers, each once"),
    ):
        assert message in fails(capsys, "relight", str(folder / "*.exr"), "--lights", *names, "--out", str(out))
    small = written(tmp_path, "lit.9.exr", np.zeros((4, 4, 3)))
    arguments = [str(folder / "*.exr"), small, "--lights", *LIGHTS, "--out", str(out)]
    assert "lit.9.exr has 4 x 4 pixels, the frames before 16 x 12" in fails(capsys, "relight", *arguments)
    assert not out.exists()
