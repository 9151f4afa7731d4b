"""LCE1, the line protocol of lce-rig's sync board (docs/sync-protocol.md): bytes in, messages out.

Sentences are framed as NMEA 0183 frames them: `$`, name and fields, `*`, and the exclusive or of what lies
between.
"""

import re
from functools import reduce
from operator import xor
from typing import NamedTuple, TypeAlias

VERSION = 1
MAX_LINE = 512
N_CHANNELS = 16
# Microseconds of 31 years; in ns they still fit into 64 bits.
_MAX_DIGITS = 15
_SENTENCE = re.compile(rb"([!-#%-)+-~ ]+)\*([0-9A-Fa-f]{1,2})\Z")


class Hello(NamedTuple):
    """The board has started, or identifies itself on request."""

    version: int
    firmware: str
    board: str


class PpsEdge(NamedTuple):
    """A pulse per second, sent or received by the board.

    Attributes:
        seq: running number.
        t_us: board time of the rising edge.
        utc_s: the UTC second that begins with it; None where the board does not know.
        origin: where the pulse comes from: "G", GPS; "I", the board's own clock; "N", there is none.
    """

    seq: int
    t_us: int
    utc_s: int | None
    origin: str


class TriggerEdge(NamedTuple):
    """An edge of the pulse `number` that the board sent on line `channel`, at board time."""

    channel: int
    number: int
    t_us: int
    is_rising: bool


class TimeReply(NamedTuple):
    """The answer to time request `cookie`: board time when that had come, and when this was sent."""

    cookie: int
    rx_us: int
    tx_us: int


class BoardStatus(NamedTuple):
    """How the board does, once a second: bits, and how many lines the host did not read so far."""

    flags: int
    n_lost: int


class BoardError(NamedTuple):
    """A command that the board could not carry out."""

    code: int
    text: str


Message: TypeAlias = Hello | PpsEdge | TriggerEdge | TimeReply | BoardStatus | BoardError


def checksum(body: bytes) -> int:
    """Compute the exclusive or of all bytes between `$` and `*`."""
    return reduce(xor, body, 0)


def write_sentence(body: str) -> bytes:
    """Frame the name and fields of a sentence."""
    data = body.encode("ascii")
    return b"$%s*%02X\r\n" % (data, checksum(data))


def read_sentence(line: bytes) -> bytes:
    """Return the body of a sentence, between `$` and `*`.

    Anything before the last `$` is skipped: a board that restarts breaks off in the middle of a line.

    Raises:
        ValueError: the line is damaged.
    """
    framed = _SENTENCE.match(line, line.rfind(b"$") + 1)
    if framed is None or checksum(framed[1]) != int(framed[2], 16):
        raise ValueError(line)
    return framed[1]


def _number(field: bytes) -> int:
    if not field.isdigit() or len(field) > _MAX_DIGITS:
        raise ValueError(field)
    return int(field)


def read_line(line: bytes) -> Message | None:
    """Read one line, without its end; None where it is text or another sentence.

    Raises:
        ValueError: the line is damaged.
    """
    if len(line) > MAX_LINE:
        raise ValueError(line)
    if b"$" not in line:
        return None
    match read_sentence(line).split(b","):
        case [b"LCEHI", version, firmware, board, _]:
            return Hello(_number(version), firmware.decode(), board.decode())
        case [b"LCEPP", seq, t_us, utc_s, (b"G" | b"I" | b"N") as origin]:
            second = _number(utc_s) if utc_s else None
            return PpsEdge(_number(seq), _number(t_us), second, origin.decode())
        case [b"LCETG", channel, number, t_us, (b"R" | b"F") as edge] if _number(channel) < N_CHANNELS:
            return TriggerEdge(_number(channel), _number(number), _number(t_us), edge == b"R")
        case [b"LCETM", cookie, rx_us, tx_us]:
            return TimeReply(_number(cookie), _number(rx_us), _number(tx_us))
        case [b"LCEST", flags, _, n_lost, *_]:
            return BoardStatus(_number(flags), _number(n_lost))
        case [b"LCEER", code, *text]:
            return BoardError(_number(code), b",".join(text).decode())
        case [b"LCEHI" | b"LCEPP" | b"LCETG" | b"LCETM" | b"LCEST", *_]:
            raise ValueError(line)
        case _:
            return None


class LineReader:
    """Bytes of a serial line in, messages out; damaged lines are counted and skipped.

    Attributes:
        n_messages, n_damaged: messages and damaged lines so far.
    """

    def __init__(self) -> None:
        self.n_messages = self.n_damaged = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes as they come, and give the messages that they complete."""
        *lines, rest = (self._rest + data).split(b"\n")
        # Enough of a line without an end to tell that it is too long.
        self._rest = rest[: MAX_LINE + 1]
        messages: list[Message] = []
        for line in lines:
            try:
                message = read_line(line.strip())
            except ValueError:
                self.n_damaged += 1
                continue
            if message is not None:
                messages.append(message)
        self.n_messages += len(messages)
        return messages


def set_trigger(channel: int, rate_hz: float, phase_us: int, pulse_us: int) -> bytes:
    """Write the command that sets the pulses of a line; a rate of 0 ends them."""
    return write_sentence(f"LCERT,{channel},{rate_hz:.6f},{phase_us},{pulse_us}")


def set_utc(t_us: int, utc_s: int) -> bytes:
    """Write the command that tells which UTC second begins at a moment of the board's clock."""
    return write_sentence(f"LCEUT,{t_us},{utc_s}")


def ask_time(cookie: int) -> bytes:
    """Write the command that asks for the board's time."""
    return write_sentence(f"LCETM?,{cookie}")


ASK_HELLO = write_sentence("LCEHI?")
START = write_sentence("LCEGO")
