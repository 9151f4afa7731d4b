"""LCE1, the line protocol of lce-rig's sync board (docs/sync-protocol.md), and the board's state from it.

Converts bytes to pulses, clocks and problems, without a device or a thread. Sentences are framed as in
NMEA 0183: `$`, name and fields, `*`, and the exclusive or of the bytes in between.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from functools import reduce
from operator import xor
from typing import Any, NamedTuple, TypeAlias

from lce_rig.core.data import Pulse
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices.reading import MAX_LOST_SHARE
from lce_rig.rig.profile import PPS_LINE
from lce_rig.timing.clock import NS_PER_S
from lce_rig.timing.clock_fit import ClockTracker

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
        utc_s: the UTC second that begins with it; None if unknown to the board.
        origin: source of the pulse: "G", GPS; "I", the board's own clock; "N", there is none.
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
    """The reply to time request `cookie`: board time of its arrival, and of this reply."""

    cookie: int
    rx_us: int
    tx_us: int


class BoardStatus(NamedTuple):
    """State of the board, once per second: flags, and the number of lines not read by the host."""

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

    Anything before the last `$` is skipped: a restarting board leaves a line unfinished.

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
    """Parse one line without its line terminator; None for plain text and sentences of other types.

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
    """Splits the bytes of a serial line into messages; damaged lines are counted and skipped.

    Attributes:
        n_messages, n_damaged: messages and damaged lines so far.
    """

    def __init__(self) -> None:
        self.n_messages = self.n_damaged = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Process received bytes, and return the messages that they complete."""
        *lines, rest = (self._rest + data).split(b"\n")
        # The start of an unfinished line suffices to detect that it is too long.
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


# Longest plausible round trip, ns: above it, the computer's clock was set meanwhile.
_MAX_ROUND_TRIP_NS = 2 * NS_PER_S
# Largest step back of the board's time between messages out of order; a larger one is a restart.
_MOST_BACK_NS = NS_PER_S
_STALLED_S = 3.0
_MIN_DAMAGED = 5
_PPS_LATE_S = 2.5
_NO_CLOCK_S = 5.0


class Arrival(NamedTuple):
    """Arrival time of a message: by the time of day, which may be set, and by a monotonic clock."""

    host_ns: int
    steady_ns: int


class BoardState:
    """Converts bytes and messages to pulses; keeps clocks, counts and problems.

    Attributes:
        reader: reads the lines, and counts damaged ones.
        n_pulses: pulses returned, by line.
        n_lost_by_line: pulses whose messages were lost, by line, from gaps in the sequence numbers.
        n_restarts: restarts of the board.
        restarted_ns: time of the last restart, by the steady clock; None before one.
        heard_ns: time of the last message, or of opening the port, by the steady clock.
        hello, error: last message of each kind; None before the first.
        pps: the last pulse per second, with its arrival.
        round_trip_ns: round trip of the last time request.
        host_tracker, utc_tracker: fits of the computer's time of day and of UTC to the board's clock, from
            time requests and pulses per second; without a model until there are enough of them.
    """

    def __init__(self, lines: Mapping[int, str]) -> None:
        """Start with a board that has not sent a message yet.

        Args:
            lines: name of the camera on each channel; pulses on others are skipped.
        """
        self.reader = LineReader()
        self.n_pulses: Counter[str] = Counter()
        self.n_lost_by_line: Counter[str] = Counter()
        self.n_restarts = self.heard_ns = 0
        self.restarted_ns: int | None = None
        self.hello: Hello | None = None
        self.pps: tuple[PpsEdge, Arrival] | None = None
        self.error: BoardError | None = None
        self.round_trip_ns: int | None = None
        self.host_tracker = ClockTracker("time requests")
        self.utc_tracker = ClockTracker("pulses per second")
        self._opened_ns = 0
        self._lines = dict(lines)
        self._latest_ns = 0
        self._last_numbers: dict[str, int] = {}
        self._asked: tuple[int, int] | None = None

    def opened(self, steady_ns: int) -> None:
        """Handle an opened port: an unplugged board has lost its state."""
        self.hello = None
        self._opened_ns = self.heard_ns = steady_ns

    def asked(self, cookie: int, sent_ns: int) -> None:
        """Store the time of day of a time request."""
        self._asked = (cookie, sent_ns)

    def feed(self, data: bytes, arrival: Arrival) -> list[Pulse]:
        """Process received bytes, and return the pulses that they report."""
        messages = self.reader.feed(data)
        if messages:
            self.heard_ns = arrival.steady_ns
        return [pulse for message in messages for pulse in self.take(message, arrival)]

    def take(self, message: Message, arrival: Arrival) -> list[Pulse]:
        """Process a message, and return the pulses that it reports."""
        match message:
            case PpsEdge(_, t_us, _, _) | TriggerEdge(_, _, t_us, _) | TimeReply(_, _, t_us):
                if t_us * 1000 < self._latest_ns - _MOST_BACK_NS:
                    self.n_restarts, self.restarted_ns = self.n_restarts + 1, arrival.steady_ns
                    self._latest_ns = 0
                    self._last_numbers.clear()
                    self._asked = None
                    self.host_tracker.restart()
                    self.utc_tracker.restart()
                    self.pps = None
                self._latest_ns = max(self._latest_ns, t_us * 1000)
        match message:
            case Hello():
                self.hello = message
            case TriggerEdge(channel, number, t_us, True) if channel in self._lines:
                return self._pulse(self._lines[channel], number, t_us, arrival)
            case PpsEdge(seq, t_us, utc_s, _):
                self.pps = (message, arrival)
                pulses = self._pulse(PPS_LINE, seq, t_us, arrival)
                if pulses and utc_s is not None:
                    self.utc_tracker.add(t_us * 1000, utc_s * NS_PER_S)
                return pulses
            case TimeReply(cookie, rx_us, tx_us) if self._asked is not None and self._asked[0] == cookie:
                sent_ns, self._asked = self._asked[1], None
                self.round_trip_ns = arrival.host_ns - sent_ns - 1000 * (tx_us - rx_us)
                # If the clock is set between request and reply, both readings are unusable.
                if 0 <= self.round_trip_ns <= _MAX_ROUND_TRIP_NS:
                    middle_ns = sent_ns + (arrival.host_ns - sent_ns) // 2
                    self.host_tracker.add(500 * (rx_us + tx_us), middle_ns, self.round_trip_ns / 2)
            case BoardError():
                self.error = message
        return []

    @property
    def has_answered(self) -> bool:
        """Whether no time request is pending."""
        return self._asked is None

    def clock_state(self) -> Finding:
        """Report the clock of the timestamps and its synchronisation with others."""
        figures: dict[str, Any] = {}
        for name, model in (("host", self.host_tracker.model), ("utc", self.utc_tracker.model)):
            if model is not None:
                figures |= {
                    f"{name}_by": model.origin,
                    f"{name}_drift_ppm": 1e6 * model.drift,
                    f"{name}_sigma_us": model.sigma_ns(model.last_ns) / 1000,
                }
        if self.round_trip_ns is not None:
            figures["round_trip_ms"] = self.round_trip_ns / 1e6
        return findings.BOARD_CLOCK(**figures)

    def problems(self, now_ns: int) -> tuple[Finding, ...]:
        """List the problems at a time of the monotonic clock."""
        silent_s = (now_ns - self.heard_ns) / NS_PER_S
        if silent_s > _STALLED_S:
            return (findings.BOARD_SILENT(silent_s=silent_s),)
        has_waited = now_ns - self._opened_ns > _NO_CLOCK_S * NS_PER_S
        problems: list[Finding] = []
        n_damaged = self.reader.n_damaged
        n_lines = n_damaged + self.reader.n_messages
        if n_damaged >= _MIN_DAMAGED and n_damaged > MAX_LOST_SHARE * n_lines:
            problems.append(findings.DAMAGED_LINES(n=n_damaged, n_lines=n_lines))
        if self.restarted_ns is not None:
            ago_s = (now_ns - self.restarted_ns) / NS_PER_S
            problems.append(findings.BOARD_RESTARTED(n=self.n_restarts, ago_s=ago_s))
        if self.error is not None:
            problems.append(findings.BOARD_ERROR(message=self.error.text, number=self.error.code))
        for line in sorted(self._lines.values()):
            if has_waited and not self.n_pulses[line]:
                problems.append(findings.NO_PULSES(line=line))
        if self.n_lost_by_line:
            by_line = ", ".join(f"{line} {n}" for line, n in sorted(self.n_lost_by_line.items()))
            problems.append(findings.PULSE_LINES_LOST(n=sum(self.n_lost_by_line.values()), by_line=by_line))
        if self.host_tracker.model is None and has_waited:
            problems.append(findings.BOARD_NOT_TIED())
        steps = self.host_tracker.steps
        if steps:
            problems.append(findings.COMPUTER_JUMPED(n=len(steps), last_s=steps[-1].size_ns / NS_PER_S))
        late_s = math.inf if self.pps is None else (now_ns - self.pps[1].steady_ns) / NS_PER_S
        if self.hello is not None and has_waited and late_s > _PPS_LATE_S:
            problems.append(findings.NO_PPS())
        elif self.pps is not None and self.pps[0].utc_s is None:
            problems.append(findings.BOARD_WITHOUT_UTC())
        return tuple(problems)

    def _pulse(self, line: str, count: int, t_us: int, arrival: Arrival) -> list[Pulse]:
        n_lost = count - self._last_numbers.get(line, count - 1) - 1
        if n_lost > 0:
            self.n_lost_by_line[line] += n_lost
        self._last_numbers[line] = count
        self.n_pulses[line] += 1
        return [Pulse(line, t_us * 1000, count, arrival.host_ns)]
