"""Comparison of events with the frames of the same camera, by brightness changes at the same pixels."""

import math
from collections import deque
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from lce_rig.collect.findings import EVENTS_LATE, EVENTS_POLARITY, EVENTS_TURNED
from lce_rig.core.data import Events, Image
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.core.phrasing import as_line
from lce_rig.rig import Rig
from lce_rig.timing.scan_pairing import EventCut, Frame, event_channel, rig_time_ns

# Interval between two images that are compared, ns: changes of a board at 10 cm/s exceed the noise.
_LEAST_NS, _MOST_NS = 30_000_000, 250_000_000
# Time offsets of events, ns, at which they are compared. `EventCut`s of scans 0.4 s later cover all of them.
_STEP_NS, _MOST_LAG_NS = 50_000_000, 500_000_000
_LAGS_NS = tuple(range(-_MOST_LAG_NS, _MOST_LAG_NS + 1, _STEP_NS))
_WAIT_NS = 400_000_000
# Fraction of pixels with events between two images above which the scene counts as moving.
_MOVING = 0.01
# Maximum number of compared image pairs, and minimum for a finding.
_MOST_PAIRS, _LEAST_PAIRS = 60, 8
# Correlation that establishes a rotation, sign and offset, and its minimum ratio to that of another rotation
# or sign. Simulated DAVIS346 reach 0.4 to 0.7; neighbouring lobes a quarter of it.
_AGREES, _EXCEEDS = 0.1, 2.0
_SIGNED = 0.3
# Offset between events and frames above which it is reported, s; `calibrate` estimates smaller ones.
_LATE_S = 0.1
# Darkest grey value compared; it bounds the noise of the logarithm.
_DARKEST = 4.0
# Steps through the rows and columns of an image that undo each rotation of the events.
_TURNS = {
    "": (1, 1),
    "rotated by 180 deg": (-1, -1),
    "mirrored left to right": (1, -1),
    "upside down": (-1, 1),
}


class _Change(NamedTuple):
    """Change of an image's log brightness (H, W) between two times of the rig's clock."""

    start_ns: int
    end_ns: int
    brighter: Array


class EventsCheck:
    """Compares the events of cameras with their frames while the stream runs."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._last: dict[str, tuple[int, Array]] = {}
        self._waiting: dict[str, deque[_Change]] = {}
        self._scores: dict[str, list[Array]] = {}

    def watch(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Pass frames on, and compare the change between successive images with the events in between.

        Raises:
            SourceError: a camera's events are rotated or mirrored relative to its frames.
        """
        for frame in frames:
            for image in frame.images:
                if self._rig.cameras[image.sensor].channels[image.channel].kind == "frames":
                    self._add(image)
            for cut in frame.events:
                self._compare(cut, frame.time_ns)
            yield frame

    def findings(self) -> list[Finding]:
        """List faults of the events' polarity and clock, from the images so far."""
        found: list[Finding] = []
        for camera, scores in sorted(self._scores.items()):
            if len(scores) < _LEAST_PAIRS:
                continue
            score = np.nan_to_num(scores).mean(axis=0)[:, 0]
            best = int(np.argmax(np.abs(score)))
            others = score[np.sign(score) != np.sign(score[best])]
            if abs(score[best]) < _SIGNED or abs(score[best]) < _EXCEEDS * np.abs(others).max(initial=0):
                continue
            channel = event_channel(self._rig, camera) or ""
            if score[best] < 0:
                found.append(EVENTS_POLARITY(f"{camera}.{channel}", correlation=float(score[best])))
            late_s = round(1e-9 * _LAGS_NS[best], 3)
            if abs(late_s) >= _LATE_S:
                own = self._rig.cameras[camera].channels[channel].timestamps.expected_offset_s
                figures = {"late_s": late_s, "expected_offset_s": round(own - late_s, 3)}
                found.append(EVENTS_LATE(f"{camera}.{channel}", camera=camera, channel=channel, **figures))
        return found

    def _add(self, image: Image) -> None:
        """Take a camera's next image."""
        time_ns = rig_time_ns(image, self._rig)
        if time_ns is None:
            return
        grey = image.pixels if image.pixels.ndim == 2 else image.pixels.mean(axis=2)
        light = np.log(np.maximum(grey, _DARKEST, dtype=np.float64))
        last = self._last.get(image.sensor)
        self._last[image.sensor] = time_ns, light
        if last is not None and _LEAST_NS <= time_ns - last[0] <= _MOST_NS and last[1].shape == light.shape:
            changes = self._waiting.setdefault(image.sensor, deque(maxlen=_MOST_PAIRS))
            changes.append(_Change(last[0], time_ns, light - last[1]))

    def _compare(self, cut: EventCut, time_ns: int) -> None:
        """Compare the pending changes with a scan's events.

        Raises:
            SourceError: the events are rotated or mirrored.
        """
        waiting, scores = self._waiting.get(cut.sensor, deque()), self._scores.setdefault(cut.sensor, [])
        while waiting and waiting[0].end_ns <= time_ns - _WAIT_NS:
            change, n_before = waiting.popleft(), len(scores)
            if n_before < _MOST_PAIRS:
                score = np.array([_correlate(change, cut, lag_ns) for lag_ns in _LAGS_NS])
                scores += [] if np.isnan(score).all() else [score]
            if len(scores) > n_before:
                self._require_upright(cut.sensor, scores)

    def _require_upright(self, camera: str, scores: list[Array]) -> None:
        if len(scores) < _LEAST_PAIRS:
            return
        by_turn = np.abs(np.nan_to_num(scores).mean(axis=0)).max(axis=0)
        best = int(np.argmax(by_turn))
        if by_turn[best] >= _AGREES and by_turn[best] >= _EXCEEDS * by_turn[0]:
            name = f"{camera}.{event_channel(self._rig, camera)}"
            turned = EVENTS_TURNED(name, turn=list(_TURNS)[best], correlation=float(by_turn[best]))
            raise SourceError(turned.text, as_line(turned.advice))


def _correlate(change: _Change, cut: EventCut, lag_ns: int) -> list[float]:
    """Correlate a change with the events after a lag, for each rotation of the image."""
    size = cut.packets[0].height_px, cut.packets[0].width_px
    if change.brighter.shape != size:
        return [math.nan] * len(_TURNS)
    start_ns, end_ns = (time_ns - cut.offset_ns + lag_ns for time_ns in (change.start_ns, change.end_ns))
    if start_ns < cut.start_ns or end_ns > cut.end_ns:
        return [math.nan] * len(_TURNS)
    summed = _sum(cut.packets, start_ns, end_ns, size)
    return [_correlation(change.brighter[::rows, ::columns], summed) for rows, columns in _TURNS.values()]


def _sum(packets: tuple[Events, ...], start_ns: int, end_ns: int, size: tuple[int, int]) -> Array:
    """Sum the polarities of events start_ns <= t < end_ns at each pixel (H, W)."""
    total = np.zeros(size[0] * size[1])
    for packet in packets:
        part = packet.between(start_ns, end_ns)
        if len(part):
            where = part.y.astype(np.int64) * size[1] + part.x
            total += np.bincount(where, np.where(part.polarity, 1.0, -1.0), len(total))
    return total.reshape(size)


def _correlation(one: Array, other: Array) -> float:
    """Correlate two maps (H, W); NaN without motion."""
    spread = float(np.sqrt(np.mean(one**2) * np.mean(other**2)))
    if spread == 0 or np.count_nonzero(other) < _MOVING * other.size:
        return math.nan
    return float(np.mean(one * other)) / spread
