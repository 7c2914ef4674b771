"""The report in a browser: it opens without errors, and does what a mouse and a keyboard ask for."""

import time

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.ui import Select, WebDriverWait

from eval.benchmark.page import write_page
from tests.helpers.browser import chromium, needs_browser, no_errors, set_media

pytestmark = [pytest.mark.slow, needs_browser]
WIDTH = 1366
HEIGHT = 768


@pytest.fixture(scope="module")
def browser():
    with chromium() as driver:
        yield driver


@pytest.fixture(params=["light", "dark"])
def page(request, browser, evaluated):
    """The report, freshly opened; no error may have come up at the end."""
    set_media(browser, WIDTH, HEIGHT, request.param)
    browser.get((evaluated / "report" / "index.html").as_uri())
    shows(browser, "slider")
    yield browser
    assert no_errors(browser)


def shows(page, *words) -> list[str]:
    """Wait until the canvas shows something described with all `words`: view, left, right, frame, flipped."""
    canvas = page.find_element(By.ID, "canvas")
    described = lambda: (canvas.get_attribute("data-shown") or "").split(" ")  # noqa: E731
    WebDriverWait(page, 10).until(lambda _: all(str(word) in described() for word in words))
    return described()


def bytes_shown(page) -> str:
    return page.execute_script("return document.getElementById('canvas').toDataURL()")


def press(page, key) -> None:
    page.find_element(By.TAG_NAME, "body").send_keys(key)


def column(page, index) -> list[str]:
    rows = page.find_elements(By.CSS_SELECTOR, "#table tbody tr:not([hidden])")
    return [row.find_elements(By.CSS_SELECTOR, "td, th")[index].text for row in rows]


def test_it_fits_the_screen_and_loads_nothing(page, request):
    assert page.execute_script("return document.documentElement.scrollWidth") <= WIDTH
    requests = [entry["message"] for entry in page.get_log("performance") if "requestWillBeSent" in entry["message"]]
    assert not [message for message in requests if '"url":"http' in message]
    paper = page.execute_script("return getComputedStyle(document.documentElement).backgroundColor")
    assert (paper == "rgb(255, 255, 255)") == ("light" in request.node.name)


def test_it_begins_with_the_noisy_frame_and_the_best_denoiser(page):
    _, left, right, *_ = shows(page, "slider")
    assert left == "noisy"
    Select(page.find_element(By.ID, "table-clip")).select_by_visible_text("cornell_box/000")
    headings = [heading.text for heading in page.find_elements(By.CSS_SELECTOR, "#table th")]
    rows = zip(*(column(page, headings.index(name)) for name in ("denoiser", "signal", "FLIP")), strict=True)
    names = {option.text for option in Select(page.find_element(By.ID, "left")).options} - {"reference"}
    flips = {name: float(flip) for name, signal, flip in rows if name in names and signal == "total"}
    assert len(flips) == len(names) >= 3 and right == min(flips, key=flips.get)


def test_the_table_sorts_and_filters(page):
    Select(page.find_element(By.ID, "table-clip")).select_by_visible_text("cornell_box/000")
    assert set(column(page, 0)) == {"cornell_box/000"}
    heading = page.find_element(By.XPATH, "//table[@id='table']//button[text()='RMSE']")
    rmse = page.execute_script("return arguments[0].closest('th').cellIndex", heading)
    before = column(page, rmse)
    heading.click()
    rising = [float(text.strip("≈")) for text in column(page, rmse)]
    assert rising == sorted(rising) and sorted(before) == sorted(column(page, rmse))
    heading.send_keys(Keys.ENTER)
    assert [float(text.strip("≈")) for text in column(page, rmse)] == rising[::-1]
    assert heading.find_element(By.XPATH, "..").get_attribute("aria-sort") == "descending"
    page.find_element(By.XPATH, "//table[@id='table']//button[text()='denoiser']").click()
    assert column(page, 1) == sorted(column(page, 1), key=str.lower)


def test_the_viewer_switches_images_by_mouse(page):
    Select(page.find_element(By.ID, "left")).select_by_value("noisy")
    Select(page.find_element(By.ID, "right")).select_by_value("eaw")
    shows(page, "slider", "noisy", "eaw")
    pictures = {bytes_shown(page)}
    for view in ("flip", "difference", "map"):
        page.find_element(By.CSS_SELECTOR, f"[data-view={view}]").click()
        shows(page, view)
        pictures.add(bytes_shown(page))
    assert len(pictures) == 4
    Select(page.find_element(By.ID, "right")).select_by_value("reference")
    page.find_element(By.CSS_SELECTOR, "[data-view=difference]").click()
    shows(page, "difference", "noisy", "reference")
    Select(page.find_element(By.ID, "left")).select_by_value("reference")
    shows(page, "difference", "reference", "reference")
    black = "const d = document.getElementById('canvas').getContext('2d').getImageData(0, 0, 64, 64).data;"
    assert page.execute_script(f"{black} return Math.max(...d.filter((_, i) => i % 4 < 3))") <= 4  # magma's 0


def test_another_clip(page):
    Select(page.find_element(By.ID, "clip")).select_by_visible_text("cornell_box_moving/000 (indirect light)")
    Select(page.find_element(By.ID, "left")).select_by_value("ntd")
    shows(page, "ntd")
    assert page.find_elements(By.CSS_SELECTOR, "#crops canvas")
    assert len(page.find_elements(By.CSS_SELECTOR, "#errors polyline")) == 4


def test_keyboard(page):
    *_, frame, _ = shows(page, "slider")
    first = bytes_shown(page)
    press(page, Keys.ARROW_RIGHT)
    shows(page, int(frame) + 1)
    assert bytes_shown(page) != first
    press(page, Keys.ARROW_LEFT)
    shows(page, frame)
    assert bytes_shown(page) == first
    press(page, " ")
    shows(page, "flip", "true")
    flipped = bytes_shown(page)
    press(page, " ")
    shows(page, "flip", "false")
    assert bytes_shown(page) != flipped
    left = page.find_element(By.ID, "left").get_attribute("value")
    press(page, "]")
    WebDriverWait(page, 10).until(lambda _: page.find_element(By.ID, "left").get_attribute("value") != left)
    for key, view in zip("1234", ("slider", "flip", "difference", "map"), strict=True):
        press(page, key)
        shows(page, view)
    wide = page.execute_script("return document.getElementById('canvas').clientWidth")
    press(page, "+")
    assert page.execute_script("return document.getElementById('canvas').clientWidth") == 2 * wide
    assert page.execute_script("return document.documentElement.scrollWidth") <= WIDTH


def test_playing_and_curves(page):
    *_, frame, _ = shows(page, "slider")
    page.find_element(By.ID, "play").click()
    WebDriverWait(page, 10).until(lambda _: shows(page)[3] != frame)
    page.find_element(By.ID, "play").click()
    time.sleep(0.3)
    stopped = shows(page)[3]
    time.sleep(0.4)
    assert shows(page)[3] == stopped
    curves = len(page.find_elements(By.CSS_SELECTOR, "#errors polyline"))
    page.find_element(By.CSS_SELECTOR, "#legend button").click()
    assert len(page.find_elements(By.CSS_SELECTOR, "#errors polyline")) == curves - 1
    for metric in Select(page.find_element(By.ID, "metric")).options:
        metric.click()
        assert page.find_elements(By.CSS_SELECTOR, "#errors svg"), metric.text
    for plot in Select(page.find_element(By.ID, "trade-select")).options:
        plot.click()
        assert page.find_elements(By.CSS_SELECTOR, "#trade-plot circle")
    assert "Pareto front" in page.find_element(By.ID, "trade-words").text


def test_every_control_has_a_name_and_can_be_reached(page):
    unnamed = """return [...document.querySelectorAll('button, select, input')].filter(e =>
        !(e.textContent.trim() || e.ariaLabel || e.labels?.[0]?.textContent.trim())).length"""
    assert page.execute_script(unnamed) == 0
    assert page.execute_script("return document.querySelectorAll('[tabindex=\"-1\"]').length") == 0


def test_the_blind_comparison_counts_votes(browser, tiny, tmp_path):
    browser.get(write_page(("noisy", "accumulated"), [tiny], tmp_path, "tiny").as_uri())
    body = browser.find_element(By.TAG_NAME, "body")

    def ready(count):
        WebDriverWait(browser, 10).until(lambda _: body.get_attribute("data-ready") == str(count))
        return "noisy" not in body.text

    assert ready(0)
    browser.find_element(By.ID, "prefer-left").click()
    assert ready(1)
    ActionChains(browser).send_keys(" ").perform()  # to what has the focus: it pauses, and the button votes no more
    speed = browser.find_element(By.ID, "speed")
    before = int(speed.get_attribute("value"))
    speed.send_keys(Keys.ARROW_RIGHT)
    assert ready(1) and int(speed.get_attribute("value")) == before + 1
    browser.find_element(By.ID, "prefer-none").click()
    rows = {row.text for row in browser.find_elements(By.CSS_SELECTOR, "#result tr")}
    assert "no difference 1" in rows
    assert rows > {"noisy 1", "accumulated 0"} or rows > {"noisy 0", "accumulated 1"}
    assert no_errors(browser)
