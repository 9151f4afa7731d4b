"""How long events are gathered before the network takes a step."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lce_rig.core.data import Events
from lce_rig.core.errors import UsageError

# What the network was trained on, and E2VID's habit: about 0.35 events per pixel a step.
_EVENTS_PER_PIXEL = 0.35
_BLOCK_PX = 16
# Share of the sensor that takes part in a usual scene with the camera moving; see `active_share`.
_USUAL_ACTIVE_SHARE = 0.25
_MIN_ACTIVE_SHARE = 0.05
_AUTO_LONGEST_NS = 60_000_000
_AUTO_SHORTEST_NS = 20_000_000
_FOREVER_NS = 1 << 62


@dataclass(frozen=True)
class WindowOptions:
    """How the stream is cut into windows.

    Attributes:
        kind: "time" (constant duration), "count" (constant number of events) or "auto": as many events as the
            active part of the sensor calls for, but 20 to 60 ms.
        duration_s: of "time"; 0.05 is what the paper used.
        n_events: of "count"; None takes 0.35 events per pixel of the sensor.
    """

    kind: Literal["auto", "time", "count"] = "auto"
    duration_s: float = 0.05
    n_events: int | None = None

    def __post_init__(self) -> None:
        """Refuse windows that never end or hold nothing."""
        if not self.duration_s > 0 or (self.n_events is not None and self.n_events < 1):
            raise UsageError("a window must hold at least one event and last longer than 0 s")


@dataclass(frozen=True)
class WindowRule:
    """When the current window ends: at n_events and shortest_ns both, or at longest_ns."""

    n_events: int
    shortest_ns: int
    longest_ns: int

    def fill(self, n_events: int, age_ns: int) -> float:
        """Return how full a window is, 1 where it ends."""
        by_count = min(n_events / self.n_events, age_ns / self.shortest_ns if self.shortest_ns else np.inf)
        return max(by_count, age_ns / self.longest_ns)

    def end(self, events: Events, start_ns: int) -> int | None:
        """Find where the window ends that began at start_ns with the first of `events`, ns; None if not yet.

        The window is [start, end): the event that completes the count still belongs to it.
        """
        longest_end = start_ns + self.longest_ns
        ends = [longest_end] if len(events) and int(events.t_ns[-1]) >= longest_end else []
        if len(events) >= self.n_events:
            filled = max(int(events.t_ns[self.n_events - 1]) + 1, start_ns + self.shortest_ns)
            # Equal timestamps may go on in events yet to come: wait for a later one.
            if int(events.t_ns[-1]) >= filled:
                ends.append(filled)
        return min(ends, default=None)


def window_rule(options: WindowOptions, height_px: int, width_px: int, share: float) -> WindowRule:
    """Settle the next window's end from the options and the share of the sensor that is active."""
    if options.kind == "time":
        duration_ns = max(1, round(options.duration_s * 1e9))
        return WindowRule(1 << 62, 0, duration_ns)
    usual = _EVENTS_PER_PIXEL * height_px * width_px
    if options.kind == "count":
        return WindowRule(options.n_events or max(1, round(usual)), 0, _FOREVER_NS)
    relative = min(1.0, max(share, _MIN_ACTIVE_SHARE) / _USUAL_ACTIVE_SHARE)
    return WindowRule(max(1, round(usual * relative)), _AUTO_SHORTEST_NS, _AUTO_LONGEST_NS)


def active_share(events: Events) -> float:
    """Measure what share of the sensor the events come from: (sum n)^2 / (B sum n^2) over B blocks.

    The participation ratio does not depend on how many events there are, only on how they are spread; with it
    a small board before a still background gets windows of the same few pixels of motion as a full image.
    """
    if not len(events):
        return 1.0
    n_cols = -(-events.width_px // _BLOCK_PX)
    n_rows = -(-events.height_px // _BLOCK_PX)
    block = (events.y // _BLOCK_PX).astype(np.intp) * n_cols + events.x // _BLOCK_PX
    counts = np.bincount(block, minlength=n_rows * n_cols).astype(np.float64)
    return float(counts.sum() ** 2 / (len(counts) * np.square(counts).sum()))
