"""The page with the runtime as WebAssembly: it denoises as the C library does, and answers its controls."""

import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from datasets.clip import Clip
from datasets.frame import read_frame
from datasets.tonemap import display, psnr
from models.registry import prototype
from provenance import ROOT
from runtime.web.__main__ import main
from tests.helpers.browser import chromium, needs_browser, no_errors, set_media
from tests.helpers.c_runtime import CRuntime

TOLERANCE = 1e-4  # of the brightest pixel
WIDTH, HEIGHT = 1366, 768


def write_page(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """`python -m runtime.web`."""
    command = [sys.executable, "-m", "runtime.web", *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True)


@pytest.fixture(scope="module")
def clip(tiny) -> Clip:
    return Clip(tiny / "test" / "cornell_box_moving" / "000")


@pytest.fixture(scope="module")
def page(clip, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("web") / "page.html"
    run = write_page(clip.path, path)
    if "cannot be compiled" in run.stderr:
        pytest.skip(run.stderr.strip())
    assert run.returncode == 0, run.stderr
    return path


@pytest.fixture(scope="module")
def browser():
    with chromium() as driver:
        set_media(driver, WIDTH, HEIGHT)
        yield driver


@pytest.fixture
def live(browser, page):
    """The page, freshly opened, with its first frame, paused; no error may have come up at the end."""
    browser.get(page.as_uri())
    shows(browser, 0, 1)
    yield browser
    assert no_errors(browser)


@pytest.fixture(scope="module")
def native(clip, library) -> CRuntime:
    return CRuntime(library, clip.width, clip.height)


def find(page, name):
    return page.find_element(By.ID, name)


def shows(page, index: int, age: int) -> None:
    """Wait for frame `index`, with a history of `age` frames."""
    canvas = find(page, "canvas")
    WebDriverWait(page, 20).until(lambda _: canvas.get_attribute("data-shown") == f"{index} {age}")


def radiance(page) -> np.ndarray:
    """Of the frame shown, (3, H, W)."""
    numbers = page.execute_script(
        "return [shown.radiance, CLIP.width, CLIP.height].map(x => x.length ? Array.from(x) : x)"
    )
    return np.array(numbers[0]).reshape(3, numbers[2], numbers[1])


def picture(page) -> np.ndarray:
    """What the canvas shows, (H, W, 3), 0 to 255."""
    pixels = page.execute_script("return Array.from(context.getImageData(0, 0, CLIP.width, CLIP.height).data)")
    return np.array(pixels).reshape(*radiance(page).shape[1:], 4)[..., :3]


def as_shown(image: np.ndarray, clip: Clip) -> np.ndarray:
    return 255 * display(image, clip.exposure)


def agrees(page, expected: np.ndarray) -> bool:
    return np.abs(radiance(page) - expected).max() <= TOLERANCE * expected.max()


@pytest.mark.slow
@needs_browser
def test_it_denoises_as_the_c_library_does(live, native, clip):
    """All frames of the clip, one in the middle once more without history, and the first one when it comes again."""
    frames = [read_frame(clip, index, prototype("one").reads) for index in range(clip.frames)]
    outputs = []
    for index, frame in enumerate(frames):
        shows(live, index, index + 1)
        outputs.append(native(frame, index == 0)[0].numpy())
        assert agrees(live, outputs[-1])
        if index == 4:
            break
        find(live, "step").click()
    assert not agrees(live, outputs[-2])
    find(live, "cut").click()
    shows(live, 4, 1)
    cut = native(frames[4], True)[0].numpy()
    assert agrees(live, cut) and not agrees(live, outputs[-1])
    for index in range(5, clip.frames):
        find(live, "step").click()
        shows(live, index, index - 3)
        assert agrees(live, native(frames[index], False)[0].numpy())
    find(live, "step").click()
    shows(live, 0, 1)
    assert agrees(live, outputs[0])


@pytest.mark.slow
@needs_browser
def test_the_slider_shows_the_noisy_frame_and_the_denoised_one(live, clip):
    find(live, "step").click()
    shows(live, 1, 2)
    noisy, denoised = as_shown(clip.noisy(1), clip), as_shown(np.moveaxis(radiance(live), 0, -1), clip)
    half = clip.width // 2
    assert np.abs(picture(live)[:, :half] - noisy[:, :half]).max() <= 0.51
    assert np.abs(picture(live)[:, half:] - denoised[:, half:]).max() <= 0.51
    find(live, "split").send_keys(Keys.HOME)
    assert np.abs(picture(live) - denoised).max() <= 0.51
    find(live, "split").send_keys(Keys.END)
    assert np.abs(picture(live) - noisy).max() <= 0.51
    Select(find(live, "left")).select_by_value("reference")
    assert find(live, "before").text == "reference"
    assert np.abs(picture(live) - as_shown(clip.reference(1).mean(axis=0), clip)).max() <= 0.51
    canvas = find(live, "canvas")
    quarter = -canvas.size["width"] // 4
    ActionChains(live).move_to_element(canvas).click_and_hold().move_by_offset(quarter, 0).release().perform()
    assert float(find(live, "split").get_attribute("value")) == pytest.approx(0.25, abs=0.01)
    assert np.abs(picture(live)[:, half:] - denoised[:, half:]).max() <= 0.51


@pytest.mark.slow
@needs_browser
def test_milliseconds_and_psnr_are_shown(live, clip):
    find(live, "step").click()
    shows(live, 1, 2)
    assert 0 < float(find(live, "milliseconds").text) < 10_000 and 0 < float(find(live, "median").text) < 10_000
    reference = display(clip.reference(1).mean(axis=0), clip.exposure)
    images = clip.noisy(1), np.moveaxis(radiance(live), 0, -1)
    expected = [psnr(float(((display(image, clip.exposure) - reference) ** 2).mean())) for image in images]
    shown = [float(number) for number in find(live, "psnr").text.split(" → ")]
    assert shown == pytest.approx(expected, abs=0.06) and shown[1] > shown[0] + 5


@pytest.mark.slow
@needs_browser
def test_it_plays_and_pauses(live, clip):
    find(live, "play").click()
    shows(live, clip.frames - 1, clip.frames)
    shows(live, 0, 1)  # a cut
    find(live, "play").click()
    described = partial(find(live, "canvas").get_attribute, "data-shown")
    live.execute_async_script("setTimeout(arguments[0], 300)")  # for a frame at work
    paused = described()
    live.execute_async_script("setTimeout(arguments[0], 500)")
    assert described() == paused


@pytest.mark.slow
@needs_browser
def test_it_fits_the_screen_and_loads_nothing(live):
    size = live.execute_script("const page = document.documentElement; return [page.scrollWidth, page.scrollHeight]")
    assert size[0] <= WIDTH and size[1] <= HEIGHT
    requests = [entry["message"] for entry in live.get_log("performance") if "requestWillBeSent" in entry["message"]]
    assert requests and not [message for message in requests if '"url":"http' in message]
    unnamed = """return [...document.querySelectorAll('button, select, input')].filter(e =>
        !(e.textContent.trim() || e.ariaLabel || e.labels?.[0]?.textContent.trim())).length"""
    assert live.execute_script(unnamed) == 0


@pytest.mark.slow
def test_a_page_of_fewer_frames(page, clip, tmp_path):
    assert write_page(clip.path, tmp_path / "page.html", 2).returncode == 0
    assert [path.read_text().count('"raw"') for path in (page, tmp_path / "page.html")] == [clip.frames, 2]


def test_bad_input(clip, tmp_path, monkeypatch):
    def complaint(source: Path, *frames: str, page: str = "page.html") -> str:
        with pytest.raises(SystemExit) as stopped:
            main([str(source), str(tmp_path / page), *frames])
        return str(stopped.value.code)  # Python prints a text, and exits with 1

    assert complaint(clip.path, str(clip.frames + 1)) == f"error: {clip.path} has 8 frames, not 9"
    assert "clip.json is missing" in complaint(tmp_path)
    assert "CLIP PAGE [FRAMES]" in complaint(clip.path, "many")
    with monkeypatch.context() as patch:
        patch.setattr("runtime.web.__main__.module", bytes)
        unwritable = complaint(clip.path, "1", page="missing/page.html")
    assert re.search(r"missing/.*page\.html.*: No such file .* choose another file", unwritable)
    assert not list(tmp_path.iterdir())
    shutil.copytree(ROOT / "runtime", tmp_path / "runtime", ignore=shutil.ignore_patterns("*.wasm"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("CLANG", "no-such-compiler")
    run = write_page(clip.path, tmp_path / "page.html", cwd=tmp_path)
    assert run.returncode == 1 and "no-such-compiler" in run.stderr and "apt-get install" in run.stderr
    assert "Traceback" not in run.stderr and not (tmp_path / "page.html").exists()
