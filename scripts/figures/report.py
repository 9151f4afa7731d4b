"""The report of a calibration as a browser shows it, on a screen and on a phone."""

import shutil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.show.phone.browser import Browser

_WIDE_PX, _PHONE_PX, _HEIGHT_PX, _GAP_PX = 1180, 390, 1250, 30


def draw_report(page: Path, work: Path) -> NDArray[np.uint8]:
    """Show the beginning of a report side by side: wide, and the residuals on a phone; BGR."""
    with Browser(shutil.which("chromium") or "chromium", work) as browser:
        wide = browser.open(page.as_uri(), _WIDE_PX, _HEIGHT_PX).screenshot()
        phone = browser.open(page.as_uri(), _PHONE_PX, _HEIGHT_PX)
        title = "[...document.querySelectorAll('h2')].find((each) => each.innerText.startsWith('Where'))"
        phone.evaluate(f"{title}.scrollIntoView()")
        narrow = phone.screenshot()
    gap = np.full((_HEIGHT_PX, _GAP_PX, 3), 150, np.uint8)
    return np.hstack([wide, gap, narrow])
