"""Which times and running numbers of a sync board can be, and which tell that it began anew.

A line may be damaged and keep its sum. One odd value is left out; two in a row that agree with each other
are believed: the board, or one of its counters, began anew.
"""

from enum import Enum

from lce_rig.timing.clock import NS_PER_S

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
    """The board's clock against one of the computer's that nobody sets."""

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
