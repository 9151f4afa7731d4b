"""The screens of `lce-rig collect --simulated`: terminal, and page on a phone and on a large screen."""

import codecs
import fcntl
import html
import os
import pty
import re
import shutil
import signal
import struct
import tempfile
import termios
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import pyte

from tests.show.phone.browser import Browser

_COLUMNS, _LINES = 100, 24
_PHONE_PX, _WIDE_PX = (390, 844), (1280, 720)
_WAIT_S = 420.0
_STYLE = """<meta charset="utf-8"><style>body{margin:14px;background:#16191d;color:#d8dde3;
font:15px/19px 'DejaVu Sans Mono','DejaVu Sans',monospace}p{margin:0;height:19px;white-space:nowrap}
i{display:inline-block;width:9.03px;height:19px;font-style:normal;white-space:pre;overflow:hidden;
vertical-align:top}</style>"""
_COLOURS = {
    "black": "#16191d", "red": "#e5484d", "green": "#3fb950", "brown": "#e3b341", "blue": "#58a6ff",
    "magenta": "#d2a8ff", "cyan": "#56d4dd", "white": "#e6edf3",
}  # fmt: skip


def draw_screens(folder: Path, n_captures: int = 4) -> None:
    """Collect with the simulated rig, and photograph the screens while the board has to move.

    Args:
        folder: where live_screen.png, phone.png and page.jpg go.
        n_captures: taken before.

    Raises:
        RuntimeError: the screens did not come in time.
    """
    with tempfile.TemporaryDirectory() as work:
        command = [
            "lce-rig",
            "collect",
            "session",
            "--rig",
            "rlfs",
            "--simulated",
            "--preview",
            "127.0.0.1:0",
        ]
        child, line = pty.fork()
        if child == 0:
            os.chdir(work)
            os.execvpe(command[0], command, {**os.environ, "TERM": "xterm-256color", "COLORTERM": ""})
        fcntl.ioctl(line, termios.TIOCSWINSZ, struct.pack("HHHH", _LINES, _COLUMNS, 0, 0))
        terminal = _Terminal(line)
        try:
            url, shown = _wait_for_board(terminal, n_captures)
            with Browser(shutil.which("chromium") or "chromium", Path(work, "browser")) as browser:
                phone = browser.open(url, *_PHONE_PX)
                time.sleep(3.0)
                cv2.imwrite(str(folder / "phone.png"), phone.screenshot())
                wide = browser.open(url, *_WIDE_PX)
                time.sleep(3.0)
                cv2.imwrite(str(folder / "page.jpg"), wide.screenshot(), [cv2.IMWRITE_JPEG_QUALITY, 85])
                drawn = Path(work, "terminal.html")
                drawn.write_text(_STYLE + shown, encoding="utf-8")
                size_px = (round(_COLUMNS * 9.03) + 28, _LINES * 19 + 28)
                cv2.imwrite(
                    str(folder / "live_screen.png"), browser.open(drawn.as_uri(), *size_px).screenshot()
                )
        finally:
            os.kill(child, signal.SIGINT)
            os.waitpid(child, 0)


class _Terminal(threading.Thread):
    """Reads a program's output into a screen, so that the program never waits."""

    def __init__(self, line: int) -> None:
        super().__init__(daemon=True)
        self._line, self._lock = line, threading.Lock()
        self._screen = pyte.Screen(_COLUMNS, _LINES)
        self._stream = pyte.Stream(self._screen)
        # A character may be cut between two reads.
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self.start()

    def run(self) -> None:
        """Read until the program ends."""
        with suppress(OSError):
            while data := os.read(self._line, 65536):
                with self._lock:
                    self._stream.feed(self._decoder.decode(data))

    def text_and_html(self) -> tuple[str, str]:
        """Take the screen as it is."""
        with self._lock:
            return "\n".join(self._screen.display), _as_html(self._screen)


def _wait_for_board(terminal: _Terminal, n_captures: int) -> tuple[str, str]:
    """Wait until enough was captured and the board has to move; return the page's address, and the screen."""
    deadline, text = time.monotonic() + _WAIT_S, ""
    while time.monotonic() < deadline:
        time.sleep(0.2)
        text, shown = terminal.text_and_html()
        counted = re.search(r"(\d+)(?: of \d+)? captures?\b", text)
        address = re.search(r"http://\S+", text)
        is_moving = re.search(r"STEP|CLOSER|BACK|RAISE|LOWER|TURN|TILT", text) is not None
        if counted and address and is_moving and int(counted[1]) >= n_captures:
            return address[0], shown
    raise RuntimeError(f"the screens did not come in time:\n{text}")


def _as_html(screen: pyte.Screen) -> str:
    rows = []
    for y in range(screen.lines):
        cells = [screen.buffer[y][x] for x in range(screen.columns)]
        rows.append(f"<p>{''.join(_cell(cell) for cell in cells)}</p>")
    return "".join(rows)


def _cell(cell: Any) -> str:
    front, back = (_colour(name) for name in (cell.fg, cell.bg))
    if cell.reverse:
        front, back = back or "#16191d", front or "#d8dde3"
    parts = {
        "color": front,
        "background": back,
        "font-weight": "bold" if cell.bold else "",
    }
    style = ";".join(f"{key}:{value}" for key, value in parts.items() if value)
    # Each in a separate box: characters of other fonts may be wider.
    return f'<i style="{style}">{html.escape(cell.data) or " "}</i>'


def _colour(name: str) -> str:
    if name == "default":
        return ""
    return _COLOURS.get(name.removeprefix("bright"), f"#{name}")
