"""The report in a real browser: no sideways scrolling, no requests, overlays that open."""

import cv2
import numpy as np
import pytest

pytestmark = pytest.mark.realtime


@pytest.mark.parametrize("width_px", [390, 1440])
@pytest.mark.parametrize("which", ["one_page", pytest.param("two_page", marks=pytest.mark.long)])
def test_it_fits_the_screen_and_loads_nothing(browser, tmp_path, request, which, width_px):
    file = tmp_path / "report.html"
    file.write_text(request.getfixturevalue(which), encoding="utf-8")
    page = browser.open(file.as_uri(), width_px, 844)
    assert page.evaluate("document.documentElement.scrollWidth") == width_px
    # A colour bar is an image within the page.
    requested = [address for address in page.requested if not address.startswith("data:")]
    assert requested == [file.as_uri()]
    assert page.complaints == []


@pytest.mark.parametrize("width_px", [390, 1440])
def test_pictures_of_captures_are_part_of_the_page(browser, one, one_page, tmp_path, width_px):
    (tmp_path / "report.html").write_text(one_page, encoding="utf-8")
    page = browser.open((tmp_path / "report.html").as_uri(), width_px, 844)
    images = "[...document.querySelectorAll('.gallery img')]"
    assert page.evaluate(f"{images}.length") == len(one.residuals)
    assert page.evaluate(f"{images}.every((e) => e.naturalWidth > 100)")
    assert page.evaluate("document.documentElement.scrollWidth") == width_px
    assert page.complaints == []


def test_a_mark_opens_the_capture_s_overlay(browser, one_page, tmp_path):
    (tmp_path / "report.html").write_text(one_page, encoding="utf-8")
    (tmp_path / "overlays").mkdir()
    cv2.imwrite(str(tmp_path / "overlays" / "000001.png"), np.full((1200, 1000, 3), 90, np.uint8))
    page = browser.open((tmp_path / "report.html").as_uri(), 390, 844)
    overlays = "[...document.querySelectorAll('.overlay')]"
    shown = f"{overlays}.filter((each) => each.offsetHeight).map((each) => each.id)"
    assert page.evaluate(shown) == []
    page.evaluate(
        """document.querySelector('svg[aria-label="Residuals by range"] a[*|href="#pair-0-capture-1"]')
        .dispatchEvent(new MouseEvent('click', {bubbles: true}))"""
    )
    page.wait_until(f"{shown}.length === 1")
    assert page.evaluate(shown) == ["pair-0-capture-1"]
    page.wait_until("document.querySelector('#pair-0-capture-1 img').naturalWidth === 1000")
    assert page.evaluate("document.documentElement.scrollWidth") == 390
