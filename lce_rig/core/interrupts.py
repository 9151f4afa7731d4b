"""Ctrl-C: the program ends soon, in any state, with one line and one exit code."""

import atexit
import os
import select
import signal
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

EXIT_INTERRUPTED = 130
INTERRUPTED = "interrupted; everything written so far is complete"
#: Grace period for a clean shutdown. Compiled code and threads may not see the interrupt.
GRACE_S = 1.2
# One key press can arrive twice, from the terminal and from a program that passes it on.
_SAME_PRESS_S = 0.1
# Sequence that leaves the alternate screen and shows the cursor, in case a view has changed them.
_SCREEN_AS_BEFORE = b"\x1b[?1049l\x1b[?25h"


class _InterruptWatch:
    """Ends the process after a grace period, or at the second Ctrl-C, if it is still running."""

    def __init__(self) -> None:
        self.grace_s = GRACE_S
        self.is_raising = True
        self._pressed_s: float | None = None
        self._settings: list[Any] | None = None
        with suppress(termios.error, OSError, ValueError, AttributeError):
            self._settings = termios.tcgetattr(sys.stdin)
        # Python runs its handlers only between two steps of the main thread; this pipe is written at once.
        self._pressed, told = os.pipe()
        os.set_blocking(told, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        signal.signal(signal.SIGINT, self._interrupt)
        threading.Thread(target=self._run, name="watch for Ctrl-C", daemon=True).start()

    def _interrupt(self, _number: int, _frame: FrameType | None) -> None:
        if self.is_raising:
            self.is_raising = False  # A second one would interrupt the clean-up after the first.
            raise KeyboardInterrupt

    def _run(self) -> None:
        while True:
            left_s = None
            if self._pressed_s is not None:
                left_s = max(0.0, self._pressed_s + self.grace_s - time.monotonic())
            if not select.select([self._pressed], [], [], left_s)[0]:
                self.end()
            elif signal.SIGINT in os.read(self._pressed, 64):
                now_s = time.monotonic()
                if self._pressed_s is None:
                    self._pressed_s = now_s
                elif now_s - self._pressed_s > _SAME_PRESS_S:
                    self.end()

    def end(self) -> None:
        """Restore the terminal, print the message and exit at once, without joining threads."""
        with suppress(termios.error, OSError):
            if self._settings is not None:
                termios.tcsetattr(sys.stdin, termios.TCSANOW, self._settings)
            if os.isatty(2):
                os.write(2, _SCREEN_AS_BEFORE)
            os.write(2, f"{INTERRUPTED}\n".encode())
        os._exit(EXIT_INTERRUPTED)


_watch: _InterruptWatch | None = None


def watch_for_interrupts() -> None:
    """Let Ctrl-C raise KeyboardInterrupt, and end the process if that takes too long.

    Call it once, from the main thread, before anything heavy is imported. If Ctrl-C is ignored, as for a
    shell's background jobs, it stays ignored.
    """
    global _watch
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN and _watch is None:
        hook = sys.unraisablehook

        def leave_out_interrupts(unraisable: Any) -> None:
            # Interrupts in code that cannot raise them; the watch then ends the program.
            if not issubclass(unraisable.exc_type, KeyboardInterrupt):
                hook(unraisable)

        sys.unraisablehook = leave_out_interrupts
        # Python's last steps run without handlers, and Ctrl-C would hide the exit status.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        _watch = _InterruptWatch()


def interrupt_no_more() -> None:
    """Let the program's own exit proceed; the watch continues."""
    if _watch is not None:
        _watch.is_raising = False


@contextmanager
def patience(grace_s: float) -> Iterator[None]:
    """Extend the grace period of a clean shutdown while the block lasts."""
    if _watch is None:
        yield
        return
    before_s, _watch.grace_s = _watch.grace_s, grace_s
    try:
        yield
    finally:
        _watch.grace_s = before_s


@contextmanager
def without_interrupt() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block, for imports of compiled libraries.

    Interrupted during initialisation, they end the process themselves: Open3D with an exit code, onnxruntime
    with an abort.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    pressed = []
    signal.signal(signal.SIGINT, lambda *arguments: pressed.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        before(*pressed[0])
