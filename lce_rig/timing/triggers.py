"""Triggered images and their pulses, matched by sequence number.

A camera numbers its frames, a sync board its pulses. The two numbers differ by a constant, found from the
times of a few images at the start. From then on images are matched by number only, so that a busy computer or
a lost line cannot mismatch them. The camera's timestamps are used to check the constant: a pulse missed by
the camera, or a frame not numbered by its driver, shifts every later image by whole pulses. The constant is
then determined again.
"""

from collections import Counter, deque
from collections.abc import Iterator
from itertools import islice, pairwise
from statistics import median
from typing import NamedTuple

from lce_rig.core.data import Image, Pulse
from lce_rig.core.findings import Figure, Finding, Kind
from lce_rig.timing import findings
from lce_rig.timing.clock import ClockModel

# Images in a row that must agree on the constant; VersaVIS requires four, too.
N_AGREE = 4

_N_WAITING = 64
_N_DELAYS = 31
# Largest deviation of an image's delay from the median, as a share of the pulses' period.
_NEAR = 0.3
_N_PULSES = 1024
_N_RECENT = 8
# Largest difference in number of two received pulses between which missing ones are interpolated.
_MAX_STEPS = 8


class TriggeredImage(NamedTuple):
    """An image and the pulse that triggered it.

    Attributes:
        image: image as received from the camera.
        pulse: running number of the pulse.
        pulse_ns: board time of its rising edge; interpolated if the pulse's line was lost.
        stamp_ns: board time of the image: the pulse plus the camera's typical delay.
    """

    image: Image
    pulse: int
    pulse_ns: int
    stamp_ns: int


class _Waiting(NamedTuple):
    image: Image
    number: int
    board_ns: int


class TriggerMatcher:
    """Matches one camera's images to pulses; each stream keeps its own order.

    Attributes:
        counts: n_matched images and n_unmatched ones; n_restarts of either count, or of the search for the
            constant.
        problem: why images are not matched now; None while they are.
    """

    def __init__(self, camera: str, max_delay_ns: int) -> None:
        """Prepare to find the constant.

        Args:
            camera: the camera's name in the profile.
            max_delay_ns: latest timestamp of an image after its pulse, on the board's clock.
        """
        self.counts = Counter[str]()
        self.problem: Finding | None = findings.NOTHING_YET(camera)
        self._camera = camera
        self._max_delay_ns = max_delay_ns
        self._clock: ClockModel | None = None
        # Board times of the last pulses by their numbers, both rising.
        self._pulses: dict[int, int] = {}
        self._waiting: deque[_Waiting] = deque()
        self._agreeing: list[_Waiting] = []
        self._constant: int | None = None
        self._candidate: int | None = None
        self._delays_ns: deque[int] = deque(maxlen=_N_DELAYS)
        self._n_odd = 0
        self._last: tuple[int, int] | None = None

    def set_clock(self, board_from_camera: ClockModel) -> None:
        """Take the board's time on the camera's clock, used to find the constant."""
        self._clock = board_from_camera

    def take_pulse(self, pulse: Pulse) -> list[TriggeredImage]:
        """Add a pulse, and return the images that waited for it."""
        last_count, last_ns = next(reversed(self._pulses.items()), (pulse.count - 1, 0))
        if pulse.count <= last_count:
            if self._pulses.get(pulse.count) == pulse.stamp_ns:
                return []
            self._restart(findings.RESTARTED)
            self._pulses.clear()
        elif (n_steps := pulse.count - last_count) <= _MAX_STEPS:
            # Interpolate pulses with lost lines between their neighbours.
            step_ns = (pulse.stamp_ns - last_ns) / n_steps
            self._pulses |= {last_count + k: last_ns + round(k * step_ns) for k in range(1, n_steps)}
        self._pulses[pulse.count] = pulse.stamp_ns
        while len(self._pulses) > _N_PULSES:
            del self._pulses[next(iter(self._pulses))]
        return list(self._proceed())

    def take_image(self, image: Image) -> list[TriggeredImage]:
        """Add an image, and return those with known pulses."""
        if image.count is None or image.stamp_ns is None or self._clock is None:
            self.counts["n_unmatched"] += 1
            is_numbered = image.count is not None
            kind = findings.CLOCK_NOT_TIED if is_numbered else findings.IMAGES_NOT_NUMBERED
            self.problem = kind(self._camera)
            return []
        if self._last is not None and image.count <= self._last[0]:
            if image.stamp_ns <= self._last[1]:
                return []
            self._restart(findings.RESTARTED)
        self._last = image.count, image.stamp_ns
        if len(self._waiting) == _N_WAITING:
            self._waiting.popleft()
            self.counts["n_unmatched"] += 1
            self.problem = findings.NO_PULSES(self._camera)
        self._waiting.append(_Waiting(image, image.count, self._clock.convert(image.stamp_ns)))
        return list(self._proceed())

    def _proceed(self) -> Iterator[TriggeredImage]:
        while self._waiting and self._pulses:
            frame = self._waiting[0]
            last_count, last_ns = next(reversed(self._pulses.items()))
            if self._constant is None:
                # All candidate pulses are known only once the pulses have passed the image's time.
                if last_ns <= frame.board_ns:
                    return
                yield from self._seek(self._waiting.popleft())
            elif frame.number - self._constant > last_count:
                return
            else:
                yield from self._follow(self._waiting.popleft(), self._constant)

    def _seek(self, frame: _Waiting) -> Iterator[TriggeredImage]:
        """Search for the constant: the same for several successive images with one possible pulse each."""
        window_ns = self._max_delay_ns
        possible = [n for n, ns in self._pulses.items() if 0 <= frame.board_ns - ns <= window_ns]
        # If a pulse line was lost, another pulse may look like the only candidate.
        is_ambiguous = len(possible) > 1 or self._period_ns() < window_ns
        constant = frame.number - possible[0] if len(possible) == 1 and not is_ambiguous else None
        if is_ambiguous:
            self.problem = findings.AMBIGUOUS_PULSES(self._camera, window_ms=window_ns / 1e6)
        elif not possible:
            self.problem = findings.IMAGES_WITHOUT_PULSES(self._camera)
        if constant is None or constant != self._candidate:
            self._drop(self._agreeing)
            self._candidate = constant
        if constant is None:
            self.counts["n_unmatched"] += 1
            return
        self._agreeing.append(frame)
        if len(self._agreeing) == N_AGREE:
            self._constant, self.problem = constant, None
            agreeing, self._agreeing = self._agreeing, []
            self._delays_ns.extend(each.board_ns - self._pulses[each.number - constant] for each in agreeing)
            for each in agreeing:
                yield self._matched(each, each.number - constant)

    def _follow(self, frame: _Waiting, constant: int) -> Iterator[TriggeredImage]:
        """Match by number, and check the time."""
        number = frame.number - constant
        if number not in self._pulses:
            self.counts["n_unmatched"] += 1
            return
        delay_ns = frame.board_ns - self._pulses[number]
        if abs(delay_ns - median(self._delays_ns)) < _NEAR * self._period_ns():
            self._n_odd = 0
            yield self._matched(frame, number)
            self._delays_ns.append(delay_ns)
            return
        # One timestamp may be late; several in a row show that the counts have slipped.
        self.counts["n_unmatched"] += 1
        self._n_odd += 1
        if self._n_odd == N_AGREE:
            self._restart(findings.PULSES_NOT_FOLLOWED)

    def _matched(self, frame: _Waiting, number: int) -> TriggeredImage:
        self.counts["n_matched"] += 1
        pulse_ns = self._pulses[number]
        return TriggeredImage(frame.image, number, pulse_ns, pulse_ns + round(median(self._delays_ns)))

    def _period_ns(self) -> float:
        """Return the shortest time between two of the last few pulses; infinite for a single pulse."""
        recent = islice(reversed(self._pulses.values()), _N_RECENT)
        return min((after - before for after, before in pairwise(recent)), default=float("inf"))

    def _restart(self, reason: Kind) -> None:
        self.problem = reason(self._camera)
        self.counts["n_restarts"] += 1
        for frames in (self._waiting, self._agreeing):
            self._drop(frames)
        self._constant = self._candidate = self._last = None
        self._delays_ns.clear()
        self._n_odd = 0

    def figures(self) -> dict[str, Figure]:
        """Return the counts for a finding."""
        return {name: self.counts[name] for name in ("n_matched", "n_unmatched", "n_restarts")}

    def _drop(self, frames: list[_Waiting] | deque[_Waiting]) -> None:
        self.counts["n_unmatched"] += len(frames)
        frames.clear()
