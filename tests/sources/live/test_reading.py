"""The reader thread: in order, to the end, and with the reason of the end."""

import threading
import time

import pytest

from lce_rig.core.data import Pulse
from lce_rig.core.errors import SourceError
from lce_rig.sources.live.reading import RateMeter, ReaderThread


def pulse(count: int) -> Pulse:
    return Pulse("cam", count, count, 0)


class Script:
    """Gives what it was told to, one entry a call; an error is raised; then nothing."""

    def __init__(self, *entries: list[Pulse] | Exception) -> None:
        self.entries = list(entries)

    def __call__(self) -> list[Pulse]:
        if not self.entries:
            time.sleep(0.01)
            return []
        entry = self.entries.pop(0)
        if isinstance(entry, Exception):
            raise entry
        return entry


def counts(reader: ReaderThread) -> list[int]:
    return [sample.count for sample in reader.samples() if isinstance(sample, Pulse)]


def test_samples_come_in_order_and_then_the_reason_of_the_end() -> None:
    reader = ReaderThread(
        "sensor 's'", Script([pulse(0), pulse(1)], [pulse(2)], SourceError("gone")), 9, 5, ""
    )
    reader.start()
    came = []
    with pytest.raises(SourceError, match="gone"):
        came.extend(reader.samples())
    assert reader.n_samples == 3
    reader.stop()


def test_nothing_for_too_long_is_an_error_with_a_hint() -> None:
    reader = ReaderThread("sensor 's'", Script(), 9, 0.1, "Check the plug.")
    reader.start()
    with pytest.raises(SourceError, match=r"sensor 's' sends nothing: nothing for 0\.1 s") as caught:
        counts(reader)
    assert caught.value.hint == "Check the plug."
    reader.stop()


def test_stopping_ends_the_samples_without_error() -> None:
    reader = ReaderThread("sensor 's'", Script([pulse(0)]), 9, 60, "")
    reader.start()
    taken: list[int] = []
    taker = threading.Thread(target=lambda: taken.extend(counts(reader)))
    taker.start()
    while reader.n_samples == 0:
        time.sleep(0.005)
    reader.stop()
    taker.join()
    assert taken == [0]


def test_reading_can_begin_anew() -> None:
    reader = ReaderThread("sensor 's'", Script([pulse(0)], SourceError("gone"), [pulse(1)]), 9, 0.1, "")
    for expected, reason in ((0, "gone"), (1, "fell silent")):
        reader.start()
        came = []
        with pytest.raises(SourceError, match=reason):
            came.extend(reader.samples())
        assert [sample.count for sample in came if isinstance(sample, Pulse)] == [expected]
        assert reader.n_samples == 1
        reader.stop()


def test_what_nobody_takes_is_dropped_oldest_first_and_counted() -> None:
    reader = ReaderThread("sensor 's'", Script([pulse(k) for k in range(10)], SourceError("gone")), 4, 5, "")
    reader.start()
    reader.stop()
    came = []
    with pytest.raises(SourceError, match="gone"):
        for sample in reader.samples():
            came.append(sample)
    assert [sample.count for sample in came if isinstance(sample, Pulse)] == [6, 7, 8, 9]
    assert (reader.n_samples, reader.n_dropped) == (10, 6)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_bug_in_a_reader_ends_the_samples_and_is_called_one() -> None:
    reader = ReaderThread("sensor 's'", Script([pulse(0)], ZeroDivisionError("oops")), 9, 5, "")
    reader.start()
    with pytest.raises(SourceError, match="its reader failed: ZeroDivisionError") as caught:
        counts(reader)
    assert "report" in caught.value.hint
    reader.stop()


def test_a_rate_is_that_of_what_came_and_falls_when_nothing_comes() -> None:
    clock_s = [100.0]
    meter = RateMeter(lambda: clock_s[0])
    assert meter.rate_hz == 0
    for _ in range(21):
        clock_s[0] += 0.1
        meter.add(5)
    assert meter.rate_hz == pytest.approx(50)
    clock_s[0] += 0.1
    assert meter.rate_hz == pytest.approx(50)
    clock_s[0] += 0.8
    assert meter.rate_hz < 40
    clock_s[0] += 3
    assert meter.rate_hz == 0
