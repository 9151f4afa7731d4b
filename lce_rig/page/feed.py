"""The newest state, handed from the thread that collects to those who watch."""

import asyncio
import time

from lce_rig.collect.live.state import LiveState

# Waking the other thread would cost the collection a system call, and the interpreter's lock with it.
_LOOK_S = 0.03


class Feed:
    """Holds one state, the newest; whoever is slow misses those between."""

    def __init__(self) -> None:
        self._newest: tuple[int, float, LiveState] | None = None

    def publish(self, state: LiveState) -> None:
        """Put a state in; from one thread at a time. It is a single assignment, so it never blocks."""
        number = 1 if self._newest is None else self._newest[0] + 1
        self._newest = (number, time.monotonic(), state)

    def newest(self) -> tuple[int, LiveState] | None:
        """Give the newest state and its running number, from 1; None before one has come."""
        newest = self._newest
        return None if newest is None else (newest[0], newest[2])

    def age_s(self) -> float | None:
        """Compute how long ago the newest state came."""
        newest = self._newest
        return None if newest is None else time.monotonic() - newest[1]

    async def wait_beyond(self, number: int, timeout_s: float) -> bool:
        """Wait for a state newer than `number`; False where none came in time."""
        end_s = time.monotonic() + timeout_s
        while self._newest is None or self._newest[0] <= number:
            if time.monotonic() > end_s:
                return False
            await asyncio.sleep(_LOOK_S)
        return True
