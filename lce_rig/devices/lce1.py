"""LCE1, the line protocol of lce-rig's sync board (docs/sync-protocol.md): bytes in, messages out.

Sentences are framed as NMEA 0183 frames them: `$`, name and fields, `*`, and the exclusive or of what lies
between. The sum is weak: two characters that trade places leave it unchanged. What passes is still compared
with a strict grammar, and with what the board has said before (`BoardState`).
"""

import re
from collections.abc import Callable
from functools import reduce
from operator import xor
from typing import Any, NamedTuple, TypeAlias

VERSION = 1
MAX_LINE = 512
# Microseconds that still fit into 64 bits as nanoseconds: 292 years.
MAX_US = (2**63 - 1) // 1000
MAX_COUNT = 2**32 - 1
N_CHANNELS = 16

_SENTENCE = re.compile(rb"([!-#%-)+-~ ]+)\*([0-9A-Fa-f]{1,2})\Z")
_NUMBER = re.compile(rb"(?:0|[1-9][0-9]{0,18})\Z")
_WORD = re.compile(rb"[A-Za-z0-9._ -]{1,32}\Z")
_TEXT = re.compile(rb"[!-)+-~ ]{0,80}\Z")


class Hello(NamedTuple):
    """The board has started, or identifies itself on request; `tick_hz` are its clock's steps per second."""

    version: int
    firmware: str
    board: str
    tick_hz: int


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
    """How the board does, once a second: bits, pulses per second so far, lines that the host did not read."""

    flags: int
    n_pps: int
    n_lost: int


class BoardError(NamedTuple):
    """A command that the board could not carry out."""

    code: int
    text: str


Message: TypeAlias = Hello | PpsEdge | TriggerEdge | TimeReply | BoardStatus | BoardError


def _count(field: bytes, largest: int = MAX_COUNT) -> int:
    if not _NUMBER.match(field) or int(field) > largest:
        raise ValueError(field)
    return int(field)


def _time_us(field: bytes) -> int:
    return _count(field, MAX_US)


def _matching(pattern: re.Pattern[bytes]) -> Callable[[bytes], str]:
    def read(field: bytes) -> str:
        if not pattern.match(field):
            raise ValueError(field)
        return field.decode("ascii")

    return read


_word = _matching(_WORD)
SENTENCES: dict[bytes, tuple[Callable[..., Message], tuple[Callable[[bytes], Any], ...]]] = {
    b"LCEHI": (Hello, (_count, _word, _word, _count)),
    b"LCEPP": (
        PpsEdge,
        (
            *(_count, _time_us),
            lambda field: _count(field, MAX_US // 1_000_000) if field else None,
            {b"G": "G", b"I": "I", b"N": "N"}.__getitem__,
        ),
    ),
    b"LCETG": (
        TriggerEdge,
        (
            lambda field: _count(field, N_CHANNELS - 1),
            *(_count, _time_us),
            {b"R": True, b"F": False}.__getitem__,
        ),
    ),
    b"LCETM": (TimeReply, (_count, _time_us, _time_us)),
    # The pulses of each line follow; the numbers of their edges say the same.
    b"LCEST": (BoardStatus, (_count, _count, lambda fields: _count(fields.partition(b",")[0]))),
    b"LCEER": (BoardError, (_count, _matching(_TEXT))),
}
"""The board's sentences by name: the message, and how each field is read; the last takes the rest."""


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


def read_line(line: bytes) -> Message | None:
    """Read one line, without its end; None where it is text or another sentence.

    Raises:
        ValueError: the line is damaged.
    """
    if len(line) > MAX_LINE:
        raise ValueError(line)
    if b"$" not in line:
        return None
    name, _, rest = read_sentence(line).partition(b",")
    if name not in SENTENCES:
        return None
    kind, readers = SENTENCES[name]
    fields = rest.split(b",", len(readers) - 1)
    try:
        message = kind(*(read(field) for read, field in zip(readers, fields, strict=True)))
    except KeyError as error:
        raise ValueError(line) from error
    if isinstance(message, TimeReply) and message.rx_us > message.tx_us:
        raise ValueError(line)
    return message


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
