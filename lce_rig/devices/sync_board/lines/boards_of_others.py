"""The dialects of boards of others; without a checksum a line is taken only if every field is in range."""

import json
import re
from datetime import datetime, timezone
from typing import Any

from lce_rig.devices.sync_board.lines.dialect import Dialect, Reading, split_sentence
from lce_rig.devices.sync_board.lines.messages import (
    MAX_COUNT,
    MAX_US,
    N_CHANNELS,
    Hello,
    LineFault,
    TimeReply,
    TriggerEdge,
    UtcTime,
)

_TIME = re.compile(rb"([01][0-9]|2[0-3])([0-5][0-9])([0-5][0-9])(?:\.([0-9]{1,9}))?\Z")
_DATE = re.compile(rb"([0-9]{2})([0-9]{2})([0-9]{2})\Z")
# The sentence has two digits for the year; receivers older than this are in museums.
_FIRST_YEAR = 1980
_N_FIELDS = 9


class Nmea(Dialect):
    """The dialect `nmea`: a receiver that says once a second what time it was, in RMC of any talker."""

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


_PULSE = re.compile(rb"T, ?(0|[1-9][0-9]{0,9}), ?(0|[1-9][0-9]{0,15})\Z")


class TLine(Dialect):
    """The dialect `tline`: `T,n,us` for every pulse, as several public ESP32 rigs print it; on channel 0.

    NMEA sentences may stand in between.
    """

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


class SimpleSensorSync(Dialect):
    """The dialect `simplesensorsync`; all channels share one running count.

    Triggers are lines of JSON, `{"f":"t","s":mask,"t":us,"c":count}`. A request `{"f":"a","a":n}` is answered
    by two, `{"f":"a","a":n,"b":received}` and `{"f":"b","a":sent}`. The board would set its own clock by a
    further line from the host; none is sent: a clock that is never set is easier to model.

    References:
        InfiniteSenseLab/SimpleSensorSync, b27a33f.
    """

    has_own_counts = False

    def __init__(self) -> None:
        self._asked: tuple[int, int] | None = None

    def read(self, line: bytes) -> Reading:
        """Read one line, without its end; a trigger of several channels gives an edge for each."""
        if not line.startswith(b"{"):
            return LineFault.UNKNOWN
        try:
            fields = json.loads(line, object_pairs_hook=_unique)
            kind = fields["f"]
            if kind == "t":
                return _triggers(fields)
            if kind == "a":
                self._asked = (_number(fields, "a", MAX_COUNT), _number(fields, "b", MAX_US))
                return ()
            if kind == "b":
                return self._reply(_number(fields, "a", MAX_US))
        except (ValueError, KeyError, TypeError, RecursionError):
            return LineFault.MALFORMED
        return LineFault.UNKNOWN

    def time_request(self, cookie: int) -> bytes:
        """Ask the board for its time."""
        return b'{"f":"a","a":%d}\n' % cookie

    def _reply(self, tx_us: int) -> Reading:
        asked, self._asked = self._asked, None
        if asked is None or asked[1] > tx_us:
            return LineFault.MALFORMED
        return (TimeReply(asked[0], asked[1], tx_us),)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) < len(pairs):
        raise ValueError("a key stands twice")
    return fields


def _number(fields: dict[str, Any], key: str, largest: int) -> int:
    value = fields[key]
    # Neither 1.0 nor true is a number here, though both equal 1.
    if type(value) is not int or not 0 <= value <= largest:
        raise ValueError(key)
    return value


def _triggers(fields: dict[str, Any]) -> Reading:
    mask = _number(fields, "s", (1 << N_CHANNELS) - 1)
    t_us, count = _number(fields, "t", MAX_US), _number(fields, "c", MAX_COUNT)
    channels = [channel for channel in range(N_CHANNELS) if mask >> channel & 1]
    return tuple(TriggerEdge(channel, count, t_us, True) for channel in channels)
