"""The page's line to the rig, in a real browser."""

import pytest

from lce_rig.show.phone.preview import Preview

from .conftest import port_of
from .screen import OPEN, has_text, shown

pytestmark = pytest.mark.realtime


def test_page_reports_lost_connection_and_reconnects(browser):
    first = Preview(port=0, token="one-token")
    page = browser.open(first.start())
    port = port_of(first)
    shown(first, page, has_text("count", "7"))
    is_lost = "document.getElementById('banner').textContent.startsWith('Connection to the rig lost')"
    assert not page.evaluate(is_lost)
    first.close()
    page.wait_until(is_lost)
    assert not page.evaluate("document.getElementById('banner').hidden")
    assert (
        page.evaluate("getComputedStyle(document.getElementById('banner')).backgroundColor")
        == "rgb(211, 18, 31)"
    )
    with Preview(port=port, token="one-token") as second:
        page.wait_until(OPEN)
        shown(second, page, has_text("count", "8"), n_captures=8)
        assert not page.evaluate(is_lost)
    # Only failed connection attempts.
    assert all(each.startswith("network: WebSocket") for each in page.complaints)


@pytest.mark.long
def test_page_reconnects_silent_connection(preview, browser):
    counting = """
      const Plain = WebSocket;
      window.lines = [];
      window.WebSocket = class extends Plain { constructor(...a) { super(...a); window.lines.push(this); } };
      Object.assign(window.WebSocket, { OPEN: Plain.OPEN });
    """
    page = browser.open(preview.urls[0], first=counting)
    shown(preview, page, has_text("count", "7"))
    # Received data are dropped, as with a phone out of range.
    page.evaluate("window.lines[0].onmessage = null")
    page.wait_until("window.lines.length === 2")
    shown(preview, page, has_text("count", "9"), n_captures=9)


def test_page_shows_no_news_and_the_end(browser):
    preview = Preview(port=0)
    page = browser.open(preview.start())
    shown(preview, page, has_text("count", "7"))
    page.wait_until("document.getElementById('banner').innerText.startsWith('No news from the rig for ')")
    shown(preview, page, "document.getElementById('banner').hidden", phase="ended")
    page.wait_until("document.body.dataset.phase === 'ended'")
    preview.close()
    # The end is not a failure: the last state stays, without outlines to follow.
    page.wait_until("document.body.dataset.connection === 'over'")
    assert page.evaluate("document.getElementById('banner').hidden")
    assert page.text("count") == "7"
    assert page.evaluate("getComputedStyle(document.getElementById('outlines')).display") == "none"


@pytest.mark.long
def test_page_reports_outdated_link(browser):
    first = Preview(port=0, token="first-token")
    page = browser.open(first.start())
    shown(first, page, has_text("count", "7"))
    port = port_of(first)
    first.close()
    with Preview(port=port, token="second-token"):
        page.wait_until(
            "document.getElementById('banner').innerText.startsWith('This link is no longer valid')"
        )
