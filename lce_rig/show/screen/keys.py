"""Keys and signals of a live collection; all are optional."""

import select
import signal
import sys
import termios
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

from lce_rig.collect.live.state import Key, TakeBack
from lce_rig.core.interrupts import patience

_KEYS: dict[str, Key | TakeBack] = {
    "q": "stop",
    "\x03": "stop",
    " ": "capture",
    "n": "next",
    "u": TakeBack(),
}
HELP = "q stop   space capture now   u take back   n another place"
PAGE_HELP = "   p QR code"
"""The key that shows the page's QR code, where there is a page."""


@dataclass
class Controls:
    """Requests of the user, from keys and signals.

    Attributes:
        is_interactive: whether keys can be pressed at all.
        signal: number of the signal received, or None.
        wants_code: whether to show the page's QR code on the screen.
    """

    is_interactive: bool
    signal: int | None = None
    wants_code: bool = False

    def __call__(self) -> Key | TakeBack | None:
        """Return the next request, or None."""
        if self.signal is not None:
            return "stop"
        if self.is_interactive and select.select([sys.stdin], [], [], 0)[0]:
            key = sys.stdin.read(1).lower()
            self.wants_code = key == "p" and not self.wants_code
            return _KEYS.get(key)
        return None


@contextmanager
def controls() -> Iterator[Controls]:
    """Read single keys if stdin is a terminal, and take signals as requests to stop."""
    is_interactive = sys.stdin.isatty()
    asked = Controls(is_interactive)

    def take(number: int, _frame: Any) -> None:
        if asked.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt  # The second Ctrl-C stops at once.
        asked.signal = number

    before = {
        number: signal.signal(number, take) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    settings = termios.tcgetattr(sys.stdin) if is_interactive else None
    try:
        if is_interactive:
            tty.setcbreak(sys.stdin)
        # The first request ends the collection; accepted captures are written first.
        with patience(grace_s=10.0):
            yield asked
    finally:
        if settings is not None:
            with suppress(termios.error):  # The terminal may be gone.
                termios.tcsetattr(sys.stdin, termios.TCSADRAIN, settings)
        for number, handler in before.items():
            signal.signal(number, handler)
