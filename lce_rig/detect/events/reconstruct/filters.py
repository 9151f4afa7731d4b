"""Removal of hot pixels and background activity."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# A pixel is hot where it fires this many times as often as the 5 x 5 pixels around it.
_HOT_FACTOR = 8.0
_HOT_MIN_EVENTS = 20
_HOT_PERIOD_NS = 500_000_000
_SUPPORT_NS = 10_000_000


class NoiseFilter:
    """Learns along the stream which pixels are hot, and removes their events and isolated ones."""

    def __init__(self) -> None:
        self._n_events: NDArray[np.int64] | None = None
        self._since_ns = 0
        self._is_hot: NDArray[np.bool_] | None = None

    def learn(self, events: Events) -> None:
        """Count the next stretch of the stream; twice a second the hot pixels are determined again."""
        if not len(events):
            return
        shape = events.height_px, events.width_px
        if self._n_events is None:
            self._n_events, self._since_ns = np.zeros(shape, np.int64), int(events.t_ns[0])
        index = events.y.astype(np.intp) * events.width_px + events.x
        self._n_events += np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
        last_ns = int(events.t_ns[-1])
        if last_ns - self._since_ns >= _HOT_PERIOD_NS:
            self._is_hot = hot_pixels(np.minimum(self._n_events, 65535).astype(np.uint16))
            self._n_events[:] = 0
            self._since_ns = last_ns

    def clean(self, events: Events) -> Events:
        """Remove the events of hot pixels known so far and background activity."""
        if self._is_hot is not None:
            events = without_pixels(events, self._is_hot)
        return without_background_activity(events)


def hot_pixels(n_events: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Find pixels that fire on their own, (H, W), from events per pixel over half a second or more, (H, W).

    Real edges pass over neighbours too, whichever way they move; a hot pixel's neighbours stay quiet. The
    median of the neighbours is blind to a second hot pixel next door.
    """
    import cv2

    typical = cv2.medianBlur(n_events, 5).astype(np.float32)
    return np.asarray((n_events >= _HOT_MIN_EVENTS) & (n_events > _HOT_FACTOR * (typical + 1)))


def without_pixels(events: Events, is_bad: NDArray[np.bool_]) -> Events:
    """Remove the events of marked pixels, (H, W)."""
    if not is_bad.any():
        return events
    return _select(events, ~is_bad[events.y, events.x])


def without_background_activity(events: Events, support_ns: int = _SUPPORT_NS) -> Events:
    """Remove events without a neighbouring event.

    Time is cut into slices of `support_ns`; an event stays where its 3 x 3 neighbourhood holds another
    pixel's event in the same slice, the one before or the one after: the nearest-neighbour filter of [1] with
    slices in place of a map of timestamps.

    References:
        [1] Delbruck, Frame-free dynamic digital vision, ISSE 2008.
    """
    if not len(events):
        return events
    n_slices = int((events.t_ns[-1] - events.t_ns[0]) // support_ns) + 1
    bounds = np.searchsorted(events.t_ns, events.t_ns[0] + support_ns * np.arange(n_slices + 1))
    active = np.zeros((n_slices + 2, events.height_px, events.width_px), bool)
    for index in range(n_slices):
        cut = slice(bounds[index], bounds[index + 1])
        active[index + 1, events.y[cut], events.x[cut]] = True
    keep = np.empty(len(events), bool)
    for index in range(n_slices):
        cut = slice(bounds[index], bounds[index + 1])
        near = active[index] | active[index + 1] | active[index + 2]
        wide = np.pad(near.astype(np.uint8), 1)
        rows = wide[:-2] + wide[1:-1] + wide[2:]
        total = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
        keep[cut] = np.asarray(total > near)[events.y[cut], events.x[cut]]
    return _select(events, keep)


def _select(events: Events, keep: NDArray[np.bool_]) -> Events:
    if keep.all():
        return events
    return replace(
        events, t_ns=events.t_ns[keep], x=events.x[keep], y=events.y[keep], polarity=events.polarity[keep]
    )
