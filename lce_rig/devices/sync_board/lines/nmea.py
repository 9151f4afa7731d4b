"""Plain NMEA: a receiver, or a board that plays one, that says once a second what time it was."""

import re
from datetime import datetime, timezone

from lce_rig.devices.sync_board.lines.dialect import Dialect, Reading, split_sentence
from lce_rig.devices.sync_board.lines.messages import LineFault, UtcTime

_TIME = re.compile(rb"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9])(?:\.([0-9]{1,9}))?\Z")
_DATE = re.compile(rb"([0-9]{2})([0-9]{2})([0-9]{2})\Z")
# The sentence has two digits for the year; receivers older than this are in museums.
_FIRST_YEAR = 1980
_N_FIELDS = 9


class Nmea(Dialect):
    """The dialect `nmea`: RMC sentences of any talker (GP, GN, GA, ...)."""

    has_triggers = False

    def read(self, line: bytes) -> Reading:
        """Read one line, without its end."""
        parts = split_sentence(line)
        if isinstance(parts, LineFault):
            return parts
        name, *fields = parts
        return read_rmc(fields) if len(name) == 5 and name.endswith(b"RMC") else LineFault.UNKNOWN


def read_rmc(fields: list[bytes]) -> Reading:
    """Read the time out of the fields of an RMC sentence, as hhmmss[.s] and ddmmyy."""
    if len(fields) < _N_FIELDS or fields[1] not in (b"A", b"V"):
        return LineFault.MALFORMED
    is_valid = fields[1] == b"A"
    if not fields[0] or not fields[8]:
        return (UtcTime(None, False),)
    time, date = _TIME.match(fields[0]), _DATE.match(fields[8])
    if time is None or date is None:
        return LineFault.MALFORMED
    day, month, two_digits = (int(part) for part in date.groups())
    year = _FIRST_YEAR + (two_digits - _FIRST_YEAR) % 100
    hour, minute, second = (int(part) for part in time.groups()[:3])
    try:
        moment = datetime(year, month, day, hour, minute, second, tzinfo=timezone.utc)
    except ValueError:
        return LineFault.MALFORMED
    fraction_ns = int((time[4] or b"0").ljust(9, b"0"))
    return (UtcTime(round(moment.timestamp()) * 1_000_000_000 + fraction_ns, is_valid),)
