"""`T,n,us`: what several public ESP32 rigs print for every trigger pulse, with NMEA sentences in between.

There is no checksum; a line is taken only if it is nothing but the three fields.
"""

import re

from lce_rig.devices.sync_board.lines.dialect import Dialect, Reading
from lce_rig.devices.sync_board.lines.messages import MAX_COUNT, MAX_US, Hello, LineFault, TriggerEdge
from lce_rig.devices.sync_board.lines.nmea import Nmea

_PULSE = re.compile(rb"T, ?(0|[1-9][0-9]{0,9}), ?(0|[1-9][0-9]{0,15})\Z")


class TLine(Dialect):
    """The dialect `tline`; all pulses are on channel 0."""

    def __init__(self) -> None:
        self._nmea = Nmea()

    def read(self, line: bytes) -> Reading:
        """Read one line, without its end."""
        if line.startswith(b"$"):
            return self._nmea.read(line)
        if line == b"READY":
            return (Hello(0, "", "tline", 0),)
        if not line.startswith(b"T,"):
            return LineFault.UNKNOWN
        pulse = _PULSE.match(line)
        if pulse is None or int(pulse[1]) > MAX_COUNT or int(pulse[2]) > MAX_US:
            return LineFault.MALFORMED
        return (TriggerEdge(0, int(pulse[1]), int(pulse[2]), True),)

    def greeting(self) -> bytes:
        """Ask for a sign of life."""
        return b"PING\n"

    def start(self) -> bytes:
        """Let the pulses begin."""
        return b"GO\n"
