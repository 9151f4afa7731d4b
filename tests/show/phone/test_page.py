"""The page in a real browser."""

import time

import cv2
import numpy as np
import pytest

from lce_rig.collect.live.state import Drawing, StreamState

from .conftest import HEIGHT_PX, PRESENT_PX, WANTED_PX, WIDTH_PX, picture, state
from .screen import has_text, shown

pytestmark = pytest.mark.realtime
SIZES = [(360, 640), (640, 360), (1280, 720)]
# Positions of an outline's points on the screen.
_ON_SCREEN = """(() => {
  const path = document.querySelector('#%s .ink');
  const matrix = path.getScreenCTM();
  return [...path.getAttribute('d').matchAll(/[ML]([-\\d.]+) ([-\\d.]+)/g)].map((m) => {
    const p = new DOMPoint(Number(m[1]), Number(m[2])).matrixTransform(matrix);
    return [p.x, p.y];
  });
})()"""


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_page_shows_complete_state(preview, browser, width, height):
    page = browser.open(preview.urls[0], width, height)
    shown(preview, page, has_text("headline", "one step left, 0.5 m closer"))
    assert page.text("phase") == "move"
    assert page.text("detail") == "Rotation 0.21° -> 0.15°"
    assert (page.text("count"), page.text("of").strip()) == ("7", "of 15")
    assert page.text("elapsed") == "01:23"
    assert page.text("rotation").split() == ["rotation", "0.20°", "/", "0.10"]
    assert page.text("translation").split() == ["position", "4.0", "mm", "/", "5.0"]
    assert page.each(".bar.full") == ["translation", "roll"]
    page.wait_until(
        "Math.abs(document.querySelector('#left_right em').getBoundingClientRect().width"
        " / document.querySelector('#left_right i').getBoundingClientRect().width - 0.8) < 0.01"
    )
    assert page.text("streams").split("\n")[-1] == state().streams[1].reason
    assert page.each("#streams li", "className") == ["good", "bad"]
    assert page.text("log").split("\n") == ["captured 000006", "captured 000005"]
    assert page.text("notes") == state().notes[0]
    assert page.evaluate("document.getElementById('countdown').hidden")
    for element in ("say", "stage", "captures", "streams", "sigmas"):
        box = page.evaluate(f"document.getElementById('{element}').getBoundingClientRect().toJSON()")
        assert box["left"] >= 0 and box["top"] >= 0
        assert box["right"] <= width and box["bottom"] <= height, element
    is_too_wide = page.evaluate("document.documentElement.scrollWidth > innerWidth")
    headline = "document.querySelector('#headline span')"
    headline_px = page.evaluate(f"parseFloat(getComputedStyle({headline}).fontSize)")
    assert is_too_wide is False and headline_px >= 24
    assert not page.complaints
    host = preview.urls[0].partition("?")[0]
    assert page.requested and all(
        each.startswith((host, host.replace("http", "ws"))) for each in page.requested
    )


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_outlines_agree_with_boards_in_the_image(preview, browser, width, height):
    page = browser.open(preview.urls[0], width, height)
    shown(preview, page, "document.querySelector('#wanted .ink') !== null")
    for is_mirrored in (True, False):
        _compare_with_picture(page, is_mirrored)
        page.tap("mirror")
    assert not page.complaints


def _compare_with_picture(page, is_mirrored):
    found = np.array(page.evaluate(_ON_SCREEN % "present"))
    wanted = np.array(page.evaluate(_ON_SCREEN % "wanted"))
    page.evaluate("document.querySelectorAll('#outlines, #legend').forEach((each) => each.style.opacity = 0)")
    screen = cv2.cvtColor(page.screenshot(), cv2.COLOR_BGR2GRAY)
    # The bright square of the image, as rendered by the browser.
    left, top = np.floor(found.min(axis=0)).astype(int) - 15
    right, bottom = np.ceil(found.max(axis=0)).astype(int) + 15
    rows, columns = np.nonzero(screen[top:bottom, left:right] > 130)
    painted = np.array(
        [columns.min() + left, rows.min() + top, columns.max() + left + 1, rows.max() + top + 1]
    )
    assert np.abs(painted - np.concatenate([found.min(axis=0), found.max(axis=0)])).max() <= 1.5
    # The whole image is visible, and both outlines have its scale.
    scale = np.ptp(found, axis=0) / np.ptp(PRESENT_PX, axis=0)
    assert np.allclose(scale, scale[0])
    assert np.allclose(np.ptp(wanted, axis=0), scale * np.ptp(WANTED_PX, axis=0))
    stage = page.evaluate("document.getElementById('stage').getBoundingClientRect().toJSON()")
    assert np.isclose(scale[0], min(stage["width"] / WIDTH_PX, stage["height"] / HEIGHT_PX), rtol=1e-3)
    assert (wanted[:, 0].mean() < found[:, 0].mean()) == is_mirrored


def test_arrow_ends_when_the_board_is_there(preview, browser):
    page = browser.open(preview.urls[0])
    tip = "document.querySelector('#arrow .head')?.getAttribute('d').split('L')[0]"
    # From (150, 130) towards (480, 180), whose outline starts at x = 400.
    shown(preview, page, f"{tip}?.startsWith('M400 167.8')")
    near = Drawing("cam", picture(), PRESENT_PX, PRESENT_PX + [40.0, 0.0])
    shown(preview, page, f"{tip} === 'M190 130'", drawing=near)
    there = Drawing("cam", picture(), PRESENT_PX, PRESENT_PX + 2, is_there=True)
    shown(preview, page, "document.querySelector('#outlines.there') !== null", drawing=there)
    assert page.each("#arrow path") == []


def test_the_last_capture_is_taken_back_by_a_tap(preview, browser):
    page = browser.open(preview.urls[0], 390, 844)
    shown(preview, page, has_text("take_back", "take back\n000006"), last_capture="000006")
    page.tap("take_back")
    deadline_s = time.monotonic() + 60
    while (asked := preview.asked()) is None:
        assert time.monotonic() < deadline_s
    assert asked.name == "000006"
    shown(preview, page, "document.getElementById('take_back').hidden", n_captures=1, n_wanted=None)
    assert page.text("captures").split() == ["1", "capture"]
    assert not page.complaints


def test_the_countdown_runs_while_the_board_is_held(preview, browser):
    page = browser.open(preview.urls[0])
    offset = "Number(document.getElementById('ring').style.strokeDashoffset)"
    shown(preview, page, "!document.getElementById('countdown').hidden", phase="holding", hold_s=2.0)
    assert page.text("hold") == "2"
    assert page.evaluate(offset) == pytest.approx(0)
    shown(preview, page, has_text("hold", "1"), phase="holding", hold_s=0.5)
    assert page.evaluate(offset) == pytest.approx(0.75)
    shown(preview, page, "document.getElementById('countdown').hidden", phase="saving")
    assert page.evaluate("document.body.dataset.phase") == "saving"


def test_sensor_messages_are_escaped(preview, browser):
    page = browser.open(preview.urls[0])
    evil = "<img src=x onerror=alert(1)><b>bold</b>"
    stream = StreamState(evil, reason=evil, figures=evil)
    said = {"headline": evil, "detail": evil, "log": (evil,), "notes": (evil,), "streams": (stream,)}
    shown(preview, page, has_text("headline", evil), **said)
    markup = page.each("img, #say b, #log b, #streams b, #notes b")
    assert markup == []
    assert not page.complaints
