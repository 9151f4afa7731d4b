"""What a sync board's messages add up to: pulses, clocks, and what is wrong; no device, no thread."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

import numpy as np

from lce_rig.core.data import Pulse
from lce_rig.core.findings import Finding
from lce_rig.core.losses import Losses
from lce_rig.devices.sync_board.lines.messages import (
    BoardError,
    BoardStatus,
    Exposure,
    Hello,
    Message,
    PpsEdge,
    TimeReply,
    TriggerEdge,
    UtcTime,
)
from lce_rig.rig.sync_settings import PPS_LINE
from lce_rig.timing.clock import NS_PER_S, ClockModel
from lce_rig.timing.clock_fit import fit_arrivals
from lce_rig.timing.clock_tracker import ClockTracker

# Which times and running numbers of a sync board can be, and which tell that it restarted.
#
# A line may be damaged and keep its sum. One odd value is skipped; two in a row that agree with each other
# are believed: the board, or one of its counters, restarted.

# A line is written within milliseconds of what it tells, and read whenever the computer gets to it.
ROOM_NS = 2 * NS_PER_S
_MOST_BACK_NS = NS_PER_S
# Answers may overtake what the board had queued before; a board that has just started is not that far.
_MOST_BACK_GREETED_NS = NS_PER_S // 10


class Verdict(Enum):
    """What to make of a value."""

    SOUND = "sound"
    ODD = "odd"
    ANEW = "anew"


class BoardTime:
    """The board's clock against one of the computer's that is never set."""

    def __init__(self) -> None:
        self._latest_ns: int | None = None
        self._least_late_ns = 0
        self._odd_late_ns: int | None = None
        self._was_greeted = False

    def greeted(self) -> None:
        """Note that the board said hello: it was asked to, or has just started."""
        self._was_greeted = True

    def judge(self, board_ns: int, steady_ns: int) -> Verdict:
        """Judge a time on the board's clock by when it came.

        Messages may come late, and many at once; never early, and never much out of order.
        """
        late_ns = steady_ns - board_ns
        if self._latest_ns is None:
            self._begin(board_ns, late_ns)
            return Verdict.SOUND
        most_back_ns = _MOST_BACK_GREETED_NS if self._was_greeted else _MOST_BACK_NS
        is_back = board_ns < self._latest_ns - most_back_ns
        if is_back or late_ns < self._least_late_ns - ROOM_NS:
            is_confirmed = self._odd_late_ns is not None and abs(late_ns - self._odd_late_ns) < ROOM_NS
            self._odd_late_ns = late_ns
            if not is_confirmed and not (is_back and self._was_greeted):
                return Verdict.ODD
            self._begin(board_ns, late_ns)
            return Verdict.ANEW
        self._odd_late_ns, self._was_greeted = None, False
        self._latest_ns = max(self._latest_ns, board_ns)
        self._least_late_ns = min(self._least_late_ns, late_ns)
        return Verdict.SOUND

    def _begin(self, board_ns: int, late_ns: int) -> None:
        self._latest_ns, self._least_late_ns = board_ns, late_ns
        self._odd_late_ns, self._was_greeted = None, False


class RunningNumber:
    """The running number of a line's pulses.

    Attributes:
        n_lost: numbers that never came.
    """

    def __init__(self) -> None:
        self.n_lost = 0
        self._last: int | None = None
        self._last_us = 0
        self._least_period_us = 0
        self._odd: int | None = None

    def judge(self, number: int, t_us: int) -> Verdict:
        """Judge a number; one that skips others must have left them the time to happen."""
        if self._last is None:
            self._take(number, t_us)
            return Verdict.SOUND
        n_steps, elapsed_us = number - self._last, t_us - self._last_us
        if n_steps < 1 or (n_steps > 1 and elapsed_us < (n_steps - 0.5) * self._least_period_us):
            is_confirmed = self._odd is not None and number == self._odd + 1
            self._odd = number
            if not is_confirmed:
                return Verdict.ODD
            self._take(number, t_us)
            return Verdict.ANEW
        if n_steps == 1 and elapsed_us > 0:
            self._least_period_us = min(self._least_period_us or elapsed_us, elapsed_us)
        self.n_lost += n_steps - 1
        self._take(number, t_us)
        return Verdict.SOUND

    def begin(self) -> None:
        """Take the next number for the first of a new row."""
        self._last = self._odd = None

    def _take(self, number: int, t_us: int) -> None:
        self._last, self._last_us, self._odd = number, t_us, None


_N_ARRIVALS = 2048


@dataclass(frozen=True)
class Arrival:
    """When a message came.

    Attributes:
        host_ns: the computer's time of day, which may be set at any moment.
        steady_ns: a clock of the computer that is never set.
    """

    host_ns: int
    steady_ns: int


PULSE_LOST = "stream.pulse_lines_lost"
RESTARTED = "device.board_restarted"
IMPLAUSIBLE = "stream.damaged_lines"


class BoardState:
    """Messages in, pulses out; clocks and counts in between.

    Attributes:
        n_pulses: pulses handed on, by line.
        losses: pulses whose messages never came, by line; restarts; messages whose figures cannot be.
        reset_steady_ns: when it last restarted; None where it did not.
        hello, status, utc: the last of each; None before the first.
        pps: the last pulse per second, with its arrival.
        error: the last complaint.
        exposure_us: last measured exposure, by camera.
        round_trip_ns: of the last time request.
        host_tracker, utc_tracker: followers of the computer's time of day and of UTC on the board's clock.
    """

    def __init__(self, lines: Mapping[int, str], has_own_counts: bool = True) -> None:
        """Begin with a board that has said nothing yet.

        Args:
            lines: name of the camera on each channel; pulses on others are skipped.
            has_own_counts: whether each channel counts its own pulses.
        """
        self.n_pulses: Counter[str] = Counter()
        self.losses = Losses()
        self.reset_steady_ns: int | None = None
        self.hello: Hello | None = None
        self.status: BoardStatus | None = None
        self.utc: UtcTime | None = None
        self.pps: tuple[PpsEdge, Arrival] | None = None
        self.error: BoardError | None = None
        self.exposure_us: dict[str, int] = {}
        self.round_trip_ns: int | None = None
        self.host_tracker = ClockTracker("time requests")
        self.utc_tracker = ClockTracker("pulses per second")
        self._lines = dict(lines)
        self._has_own_counts = has_own_counts
        self._time = BoardTime()
        self._numbers: dict[str, RunningNumber] = {}
        self._asked: tuple[int, int] | None = None
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_N_ARRIVALS)

    def asked(self, cookie: int, sent_ns: int) -> None:
        """Note that a time request was sent at a time of day."""
        self._asked = (cookie, sent_ns)

    def take(self, message: Message, arrival: Arrival) -> list[Pulse]:
        """Take a message, and give the pulses that it tells of."""
        if isinstance(message, Hello):
            self.hello = message
            self._time.greeted()
            return []
        board_us = _board_time_us(message)
        if board_us is not None:
            verdict = self._time.judge(board_us * 1000, arrival.steady_ns)
            if verdict is Verdict.ODD:
                self._count(IMPLAUSIBLE)
                return []
            if verdict is Verdict.ANEW:
                self._begin_anew(arrival)
        return self._sort(message, arrival)

    @property
    def has_answered(self) -> bool:
        """Whether no time request is under way."""
        return self._asked is None

    def n_lost_by_line(self) -> dict[str, int]:
        """Count the pulses whose messages never came; gaps in the running numbers tell."""
        return {each.subject: n for each, n in self.losses.counts() if each.code == PULSE_LOST}

    @property
    def host_clock(self) -> ClockModel | None:
        """The computer's time of day on the board's clock; by time requests, or else by arrivals."""
        model = self.host_tracker.model
        if model is None and len(self._arrivals) > 0 and self.round_trip_ns is None:
            stamps, arrivals = np.array(self._arrivals, dtype=np.int64).T
            model = fit_arrivals(stamps, arrivals, "arrivals of pulses")
        return model

    @property
    def utc_clock(self) -> ClockModel | None:
        """UTC on the board's clock, by the pulses per second; None where it does not know UTC."""
        return self.utc_tracker.model

    def _sort(self, message: Message, arrival: Arrival) -> list[Pulse]:
        match message:
            case TriggerEdge(channel, count, t_us, True) if channel in self._lines:
                return self._pulse(self._lines[channel], count, t_us, arrival)
            case PpsEdge(seq, t_us, utc_s, _):
                self.pps = (message, arrival)
                pulses = self._pulse(PPS_LINE, seq, t_us, arrival)
                if pulses and utc_s is not None:
                    self.utc_tracker.add(t_us * 1000, utc_s * NS_PER_S)
                return pulses
            case TimeReply():
                self._reply(message, arrival)
            case Exposure(channel, _, _, duration_us) if channel in self._lines:
                self.exposure_us[self._lines[channel]] = duration_us
            case BoardStatus():
                self.status = message
            case BoardError():
                self.error = message
            case UtcTime():
                self.utc = message
        return []

    def _pulse(self, line: str, count: int, t_us: int, arrival: Arrival) -> list[Pulse]:
        # Where all lines share one running number, its gaps on a line say nothing.
        number = self._numbers.setdefault(line if self._has_own_counts else "", RunningNumber())
        n_lost = number.n_lost
        if self._has_own_counts and number.judge(count, t_us) is Verdict.ODD:
            self._count(IMPLAUSIBLE)
            return []
        self._count(PULSE_LOST, line, number.n_lost - n_lost)
        self.n_pulses[line] += 1
        self._arrivals.append((t_us * 1000, arrival.host_ns))
        return [Pulse(line, t_us * 1000, count, arrival.host_ns)]

    def _reply(self, reply: TimeReply, arrival: Arrival) -> None:
        if self._asked is None or self._asked[0] != reply.cookie:
            return
        sent_ns, turn_ns = self._asked[1], 1000 * (reply.tx_us - reply.rx_us)
        self._asked = None
        self.round_trip_ns = arrival.host_ns - sent_ns - turn_ns
        # A clock that is set between question and answer spoils both.
        if 0 <= self.round_trip_ns <= ROOM_NS:
            middle_ns = sent_ns + (arrival.host_ns - sent_ns) // 2
            board_ns = 500 * (reply.rx_us + reply.tx_us)
            self.host_tracker.add(board_ns, middle_ns, self.round_trip_ns / 2)

    def _count(self, code: str, line: str = "", n: int = 1) -> None:
        self.losses.add(Finding(code, "warning", line), n)

    def _begin_anew(self, arrival: Arrival) -> None:
        self._count(RESTARTED)
        self.reset_steady_ns = arrival.steady_ns
        for number in self._numbers.values():
            number.begin()
        self._arrivals.clear()
        self._asked = None
        self.host_tracker.restart()
        self.utc_tracker.restart()
        self.pps = self.status = None


def _board_time_us(message: Message) -> int | None:
    match message:
        case PpsEdge(_, t_us, _, _) | TriggerEdge(_, _, t_us, _) | Exposure(_, _, t_us, _):
            return t_us
        case TimeReply(_, _, tx_us):
            return tx_us
    return None
