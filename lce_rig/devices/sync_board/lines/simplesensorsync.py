"""SimpleSensorSync's JSON lines: `{"f":"t","s":mask,"t":us,"c":count}` for triggers, an exchange for time.

A request `{"f":"a","a":n}` is answered by two lines: `{"f":"a","a":n,"b":received}` and `{"f":"b","a":sent}`.
The board would set its own clock by a further line from the host. None is sent: a clock that is never set
is easier to model. There is no checksum; a line is taken only if its values are whole numbers in range.

References:
    InfiniteSenseLab/SimpleSensorSync, b27a33f.
"""

import json
from typing import Any

from lce_rig.devices.sync_board.lines.dialect import Dialect, Reading
from lce_rig.devices.sync_board.lines.messages import (
    MAX_COUNT,
    MAX_US,
    N_CHANNELS,
    LineFault,
    TimeReply,
    TriggerEdge,
)


class SimpleSensorSync(Dialect):
    """The dialect `simplesensorsync`; all channels share one running count."""

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
