"""What all dialects have in common, and a reader that turns bytes into messages with one of them."""

import re
from abc import ABC, abstractmethod
from collections import Counter
from functools import reduce
from operator import xor
from typing import TypeAlias

from lce_rig.devices.sync_board.lines.messages import LineFault, Message

# Bytes of a serial line cut into lines, with an end to those that have none.

MAX_LINE = 512


class LineSplitter:
    """Bytes in as they come, whole lines out.

    Attributes:
        n_too_long: lines longer than 512 bytes, which are skipped.
    """

    def __init__(self) -> None:
        self.n_too_long = 0
        self._rest = b""
        self._is_cut = False

    def feed(self, data: bytes) -> list[bytes]:
        """Take bytes and give the lines that they complete, without their ends; empty ones are skipped."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if lines and self._is_cut:
            del lines[0]
            self._is_cut = False
        if len(self._rest) > MAX_LINE:
            self.n_too_long += not self._is_cut
            self._is_cut = True
        if self._is_cut:
            self._rest = b""
        n_lines = len(lines)
        lines = [line for line in lines if len(line) <= MAX_LINE]
        self.n_too_long += n_lines - len(lines)
        return [line.strip() for line in lines if line.strip()]

    def clear(self) -> None:
        """Forget an unfinished line."""
        self._rest = b""
        self._is_cut = False


Reading: TypeAlias = tuple[Message, ...] | LineFault
"""What a line says, or why it says nothing; an empty tuple is the first half of something."""


class Dialect(ABC):
    """How a kind of board talks.

    Attributes:
        has_own_counts: whether each channel counts its own pulses, so that a gap is a lost one.
        has_triggers: whether the board tells of the pulses that it sends to cameras.
    """

    has_own_counts = True
    has_triggers = True

    @abstractmethod
    def read(self, line: bytes) -> Reading:
        """Read one line, without its end."""

    def greeting(self) -> bytes:
        """Ask the board who it is; empty where it cannot be asked."""
        return b""

    def time_request(self, cookie: int) -> bytes:
        """Ask the board for its time; empty where it cannot be asked."""
        return b""

    def set_trigger(self, channel: int, rate_hz: float, phase_us: int, pulse_us: int) -> bytes:
        """Set the pulses of a line; empty where the board decides by itself."""
        return b""

    def set_utc(self, t_us: int, utc_s: int) -> bytes:
        """Tell the board which UTC second begins at a moment of its clock; empty where it takes none."""
        return b""

    def start(self) -> bytes:
        """Let the pulses begin; empty where they always run."""
        return b""


class LineReader:
    """Bytes of a serial line in, messages out; what is no message is counted and survived.

    Attributes:
        dialect: how the lines are read.
        n_messages: messages so far.
        faults: how many lines were none, by reason.
    """

    def __init__(self, dialect: Dialect) -> None:
        self.dialect = dialect
        self.n_messages = 0
        self.faults: Counter[LineFault] = Counter()
        self._splitter = LineSplitter()

    def feed(self, data: bytes) -> list[Message]:
        """Take bytes as they come, and give the messages that they complete."""
        messages: list[Message] = []
        for line in self._splitter.feed(data):
            reading = self.dialect.read(line)
            if isinstance(reading, LineFault):
                self.faults[reading] += 1
            else:
                messages.extend(reading)
        if self._splitter.n_too_long:
            self.faults[LineFault.TOO_LONG] = self._splitter.n_too_long
        self.n_messages += len(messages)
        return messages


# Sentences as NMEA 0183 has them: `$`, name and fields, `*`, and the exclusive or of what lies between.
#
# The sum is weak: two characters that trade places leave it unchanged. What passes is still compared with a
# strict grammar, and with what the board has said before (`BoardState`).
#
# References:
#     NMEA 0183 sentence format; checksums of one digit instead of two are written by boards in the field.

_SENTENCE = re.compile(rb"([!-#%-)+-~ ]+)\*([0-9A-Fa-f]{1,2})\Z")


def checksum(body: bytes) -> int:
    """Compute the exclusive or of all bytes between `$` and `*`."""
    return reduce(xor, body, 0)


def write_sentence(body: str) -> bytes:
    """Frame the name and fields of a sentence."""
    data = body.encode("ascii")
    return b"$%s*%02X\r\n" % (data, checksum(data))


def split_sentence(line: bytes) -> list[bytes] | LineFault:
    """Take a sentence apart into its name and fields.

    What stands before the last `$` is skipped: a board that restarts breaks off in the middle of a line.

    Args:
        line: without its end.
    """
    start = line.rfind(b"$")
    found = _SENTENCE.match(line, start + 1) if start >= 0 else None
    if found is None:
        return LineFault.MALFORMED if start >= 0 else LineFault.UNKNOWN
    if checksum(found[1]) != int(found[2], 16):
        return LineFault.CHECKSUM
    return found[1].split(b",")
