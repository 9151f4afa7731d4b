"""The newest state, handed from the thread that collects to those who watch."""

import asyncio
import contextlib
import time

from lce_rig.collect.live.state import LiveState


class Feed:
    """Holds one state, the newest; whoever is slow misses those between.

    Args:
        loop: in which the watchers run.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._newest: tuple[int, float, LiveState] | None = None
        self._changed = asyncio.Event()
        self._is_waking = False

    def publish(self, state: LiveState) -> None:
        """Put a state in; from one thread at a time, never blocks."""
        number = 1 if self._newest is None else self._newest[0] + 1
        self._newest = (number, time.monotonic(), state)
        if not self._is_waking:
            self._is_waking = True
            # The loop has ended where the page was closed meanwhile.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._wake)

    def newest(self) -> tuple[int, LiveState] | None:
        """Give the newest state and its running number, from 1; None before one has come."""
        return None if self._newest is None else (self._newest[0], self._newest[2])

    def age_s(self) -> float | None:
        """Tell how long ago the newest state came."""
        return None if self._newest is None else time.monotonic() - self._newest[1]

    async def wait_beyond(self, number: int, timeout_s: float) -> bool:
        """Wait for a state newer than `number`; False where none came in time."""
        if self._newest is not None and self._newest[0] > number:
            return True
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except asyncio.TimeoutError:  # TimeoutError itself only since Python 3.11
            return False
        return True

    def _wake(self) -> None:
        self._is_waking = False
        self._changed.set()
        self._changed = asyncio.Event()
