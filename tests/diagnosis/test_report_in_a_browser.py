"""The report in Chromium, as a reader has it: from the disk, without a network, on a wide and on a narrow screen.

Skipped without Chromium, which Debian has: apt-get install chromium.
"""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from playwright.sync_api import sync_playwright

from tests.diagnosis.test_report import SETTINGS, a_diagnosis, some_figures
from visadapt.diagnosis.report.html import write_report
from visadapt.diagnosis.result import Box, FilmFrames, Pixels

CHROMIUM = shutil.which("chromium")
OPTIONS = ["--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-component-update"]
WIDE, NARROW = (1280, 800), (390, 844)
"""px"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture
def opened(browser, tmp_path):
    """Opens a report on a screen of some size; afterwards nothing may have been fetched or complained of."""
    complaints, contexts = [], []

    def open_report(diagnosis, size):
        path = tmp_path / "report.html"
        write_report(path, diagnosis, SETTINGS)
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, offline=True)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda asked: None if asked.url.startswith(("file:", "data:")) else complaints.append(asked))
        page.goto(path.as_uri())
        return page

    yield open_report
    for context in contexts:
        context.close()
    assert not complaints


def filmed(count=9):
    """A diagnosis of a film whose frames are grey, each brighter than the one before, with a white mark that moves."""
    frames = np.repeat(np.arange(count, dtype=np.uint8)[:, None, None] * 20, 100, 1).repeat(120, 2)
    for k, frame in enumerate(frames):
        frame[40:60, 10 * k : 10 * k + 20] = 255
    film = FilmFrames(frames, 255 - frames, 0.05 * np.arange(count), np.full(count, 3), 0.5, np.ones((100, 120)))
    where = replace(a_diagnosis("unexplained").where, pixels=Pixels(4.2, 0.5, True, (Box(10, 20, 40, 30, 0.8),)))
    return frames, a_diagnosis("unexplained", where=where, figures=replace(some_figures(), film=film))


def picture(page, place):
    """(100, 120) what the screen shows at a selector, in grey."""
    content = np.frombuffer(page.locator(place).first.screenshot(), np.uint8)
    return cv2.resize(cv2.imdecode(content, cv2.IMREAD_GRAYSCALE), (120, 100), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
def test_the_slider_moves_all_frames_in_step(opened, size):
    frames, diagnosis = filmed()
    page = opened(diagnosis, size)
    slider = page.locator("#at")
    slider.focus()
    for k in (0, 1, 2):
        assert page.locator("#when").inner_text() == f"episode 3, {0.05 * k:.2f} s"
        shown = [picture(page, f".frame:not(.difference) .{kind}").astype(int) for kind in ("filmed", "predicted")]
        for seen, meant in zip(shown, (frames[k], 255 - frames[k]), strict=True):
            assert np.abs(seen - meant).mean() < 8
        slider.press("ArrowRight")
    assert page.locator("#film").bounding_box()["height"] < size[1]
    slider.press("End")
    assert page.locator("#when").inner_text() == "episode 3, 0.40 s"


@pytest.mark.parametrize("size", [WIDE, NARROW], ids=["wide", "narrow"])
@pytest.mark.parametrize("verdict", ["identified", "unexplained"])
def test_the_page_fits_the_screen(opened, verdict, size):
    page = opened(filmed()[1] if verdict == "unexplained" else a_diagnosis(verdict), size)
    assert page.evaluate("document.documentElement.scrollWidth") <= size[0]
    for kind in ("h1", "table", "svg"):
        boxes = [each.bounding_box() for each in page.locator(kind).all()]
        assert boxes
        assert all(box["width"] > 0 and box["height"] > 0 for box in boxes)
