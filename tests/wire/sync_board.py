"""A sync board behind a pseudo terminal: its pulse per second, and answers to what time it is."""

import os
import pty
import select
import threading
import time
import tty
from types import TracebackType

from lce_rig.devices.lce1 import read_sentence, write_sentence

_S = 10**9
_DRIFT = 30e-6
_UPTIME_US = 5_000_000
_WAIT_S = 0.02


class WireSyncBoard:
    """A board of the LCE1 protocol that knows UTC, whose clock drifts by 30 ppm; open while its block lasts.

    Attributes:
        path: the port that the host opens.
    """

    def __enter__(self) -> "WireSyncBoard":
        """Open the terminal and begin to talk."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._began_ns = time.time_ns()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="sync board", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Fall silent."""
        self._stop.set()
        self._thread.join()
        os.close(self._slave)
        os.close(self._master)

    def _board_us(self, time_ns: int) -> int:
        return _UPTIME_US + int((time_ns - self._began_ns) * (1 + _DRIFT) / 1000)

    def _run(self) -> None:
        number, rest = 0, b""
        due_ns = (time.time_ns() // _S + 1) * _S
        while not self._stop.is_set():
            if select.select([self._master], [], [], _WAIT_S)[0]:
                *lines, rest = (rest + os.read(self._master, 4096)).split(b"\n")
                for line in lines:
                    self._answer(line.strip(), time.time_ns())
            if time.time_ns() >= due_ns:
                number += 1
                t_us, utc_s = self._board_us(due_ns), due_ns // _S
                os.write(self._master, write_sentence(f"LCEPP,{number},{t_us},{utc_s},G"))
                due_ns += _S

    def _answer(self, line: bytes, came_ns: int) -> None:
        words = read_sentence(line).split(b",")
        if words[0] == b"LCEHI?":
            os.write(self._master, write_sentence("LCEHI,1,1.0,wire,1000000"))
        elif words[0] == b"LCETM?":
            token, sent_us = words[1].decode(), self._board_us(time.time_ns())
            os.write(self._master, write_sentence(f"LCETM,{token},{self._board_us(came_ns)},{sent_us}"))
