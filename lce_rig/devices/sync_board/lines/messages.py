"""What a sync board may say, in any dialect."""

from dataclasses import dataclass
from enum import Enum
from typing import Literal, TypeAlias

# Microseconds that still fit into 64 bits as nanoseconds: 292 years.
MAX_US = (2**63 - 1) // 1000
MAX_COUNT = 2**32 - 1
N_CHANNELS = 16


@dataclass(frozen=True)
class Hello:
    """The board has started, or was asked who it is.

    Attributes:
        version: of the protocol; 0 where the dialect has none.
        firmware, board: names, as the board gives them.
        tick_hz: steps of its clock a second; 0 where it does not say.
    """

    version: int
    firmware: str
    board: str
    tick_hz: int


@dataclass(frozen=True)
class PpsEdge:
    """A pulse per second, sent or received by the board.

    Attributes:
        seq: running number.
        t_us: board time of the rising edge.
        utc_s: the UTC second that begins with it; None where the board does not know.
        origin: where the pulse comes from: GPS, the board's own clock, or none at all.
    """

    seq: int
    t_us: int
    utc_s: int | None
    origin: Literal["G", "I", "N"]


@dataclass(frozen=True)
class TriggerEdge:
    """An edge of a pulse that the board sent to a sensor.

    Attributes:
        channel: number of the line.
        count: running number of the pulses on it.
        t_us: board time.
        is_rising: whether the line went high.
    """

    channel: int
    count: int
    t_us: int
    is_rising: bool


@dataclass(frozen=True)
class Exposure:
    """How long a camera exposed, as its strobe line says.

    Attributes:
        channel: number of the line that triggered it.
        count: running number of the pulse.
        start_us: board time of the start.
        duration_us: length.
    """

    channel: int
    count: int
    start_us: int
    duration_us: int


@dataclass(frozen=True)
class TimeReply:
    """The answer to a time request.

    Attributes:
        cookie: the number that came with the request.
        rx_us, tx_us: board time when the request had come and when this was sent.
    """

    cookie: int
    rx_us: int
    tx_us: int


class StatusFlag(int, Enum):
    """Bits of a status."""

    TRIGGERS_ON = 1
    PPS_ON = 2
    UTC_KNOWN = 4
    GPS_LOCKED = 8


@dataclass(frozen=True)
class BoardStatus:
    """How the board does, once a second.

    Attributes:
        flags: see `StatusFlag`.
        n_pps: pulses per second so far.
        n_lost: lines that it could not send because the host did not read.
        n_by_channel: pulses so far on each line.
    """

    flags: int
    n_pps: int
    n_lost: int
    n_by_channel: tuple[int, ...]


@dataclass(frozen=True)
class BoardError:
    """What the board could not do.

    Attributes:
        code: number of the error.
        text: what it was, in words.
    """

    code: int
    text: str


@dataclass(frozen=True)
class UtcTime:
    """The time in an NMEA RMC sentence: the second that began with the last pulse.

    Attributes:
        utc_ns: the time; None where the receiver has none yet.
        is_valid: whether the receiver vouches for it (status A).
    """

    utc_ns: int | None
    is_valid: bool


Message: TypeAlias = Hello | PpsEdge | TriggerEdge | Exposure | TimeReply | BoardStatus | BoardError | UtcTime


class LineFault(Enum):
    """Why a line is no message."""

    CHECKSUM = "wrong checksum"
    MALFORMED = "malformed"
    UNKNOWN = "unknown"
    TOO_LONG = "too long"
