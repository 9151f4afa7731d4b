"""The thread that reads an attached sensor, and what it counts on the way."""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator

from lce_rig.core.data import LiveSample
from lce_rig.core.errors import SourceError
from lce_rig.sources.live.base import Mailbox

_TAKE_S = 0.2
_RATE_WINDOW_S = 3.0


class RateMeter:
    """How many a second came over the last seconds; may be asked from any thread.

    Args:
        now_s: the clock.
    """

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._came: deque[tuple[float, int]] = deque()
        self._lock = threading.Lock()

    def add(self, n: int) -> None:
        """Count n that have just come."""
        with self._lock:
            self._came.append((self._now_s(), n))

    @property
    def rate_hz(self) -> float:
        """How many a second; 0 before two have come, or where none has come for long."""
        now_s = self._now_s()
        with self._lock:
            while self._came and self._came[0][0] < now_s - _RATE_WINDOW_S:
                self._came.popleft()
            if len(self._came) < 2:
                return 0.0
            first_s, last_s = self._came[0][0], self._came[-1][0]
            # Up to now where the next is overdue: what has just stopped must not look alive.
            typical_s = (last_s - first_s) / (len(self._came) - 1)
            n = sum(n for _, n in self._came) - self._came[0][1]
            return n / max(max(last_s, now_s - typical_s) - first_s, 1e-9)


class ReaderThread:
    """Calls `read` again and again in a thread of its own and queues what it gives.

    Silence ends it, as does any error; `samples` then raises what happened, after all that came before.

    Args:
        who: the sensor, for messages: "camera 'cam'".
        read: waits a moment at most and gives the samples that came; raises SourceError for good.
        n_slots: samples that may wait; when more do, the oldest is dropped.
        silence_s: so long without a sample is an error.
        what_to_check: the hint of that error.
    """

    def __init__(
        self,
        who: str,
        read: Callable[[], Iterable[LiveSample]],
        n_slots: int,
        silence_s: float,
        what_to_check: str,
    ) -> None:
        self._who = who
        self._read = read
        self._n_slots = n_slots
        self._mailbox: Mailbox[LiveSample] = Mailbox(n_slots)
        self._silence_s = silence_s
        self._what_to_check = what_to_check
        self._is_stopping = threading.Event()
        self._rate = RateMeter()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start reading, for the first time or anew; what was queued and counted before is forgotten."""
        self._mailbox = Mailbox(self._n_slots)
        self._rate = RateMeter()
        self._is_stopping.clear()
        thread = threading.Thread(target=self._run, name=f"reader of {self._who}", daemon=True)
        thread.start()
        self._thread = (
            thread  # Stopping, which another thread may do meanwhile, waits for one that has begun.
        )

    def stop(self) -> None:
        """Stop reading and wait for the thread to end."""
        self._is_stopping.set()
        if self._thread is not None:
            self._thread.join()

    def samples(self) -> Iterator[LiveSample]:
        """Yield samples as they come, until reading ends.

        Raises:
            SourceError: why it ended, unless it was stopped.
        """
        yield from self._mailbox.items(_TAKE_S)

    @property
    def n_samples(self) -> int:
        """Samples so far."""
        return self._mailbox.n_put

    @property
    def n_dropped(self) -> int:
        """Samples that nobody took in time."""
        return self._mailbox.n_dropped

    @property
    def rate_hz(self) -> float:
        """Samples a second over the last seconds."""
        return self._rate.rate_hz

    def _run(self) -> None:
        failure: SourceError | None = None
        try:
            self._read_on()
        except SourceError as error:
            failure = error
        except BaseException as error:
            failure = SourceError(f"{self._who}: its reader failed: {error!r}", "This is a bug: report it.")
            raise
        finally:
            self._mailbox.close(failure)

    def _read_on(self) -> None:
        last_s = time.monotonic()
        while not self._is_stopping.is_set():
            came = list(self._read())
            now_s = time.monotonic()
            for sample in came:
                self._mailbox.put(sample)
            if came:
                last_s = now_s
                self._rate.add(len(came))
            elif now_s - last_s > self._silence_s:
                what = "fell silent" if self.n_samples else "sends nothing"
                raise SourceError(
                    f"{self._who} {what}: nothing for {self._silence_s:g} s", self._what_to_check
                )
