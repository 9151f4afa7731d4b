"""The lines of sync boards: bytes in, messages out, for each dialect one file and no device."""

from collections.abc import Callable

from lce_rig.devices.sync_board.lines.boards_of_others import Nmea, SimpleSensorSync, TLine
from lce_rig.devices.sync_board.lines.dialect import Dialect, LineReader, Reading
from lce_rig.devices.sync_board.lines.lce1 import Lce1

DIALECTS: dict[str, Callable[[], Dialect]] = {
    "lce1": Lce1,
    "nmea": Nmea,
    "simplesensorsync": SimpleSensorSync,
    "tline": TLine,
}

__all__ = ["DIALECTS", "Dialect", "LineReader", "Reading"]
