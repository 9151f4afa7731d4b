"""What no scene made: hot pixels and background activity."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# A pixel is hot where it fires this many times as often as the 5 x 5 pixels around it.
_HOT_FACTOR = 8.0
_HOT_MIN_EVENTS = 20
_SUPPORT_NS = 10_000_000


def hot_pixels(counts: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Find pixels that fire on their own, (H, W), from events per pixel over a second or so, (H, W).

    Real edges pass over neighbours too, whichever way they move; a hot pixel's neighbours stay quiet.
    """
    padded = np.pad(counts.astype(np.float32), 2, mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(*counts.shape, 25)
    # The median is blind to a second hot pixel next door.
    typical = np.median(around, axis=2)
    return np.asarray((counts >= _HOT_MIN_EVENTS) & (counts > _HOT_FACTOR * (typical + 1)))


def without_pixels(events: Events, is_bad: NDArray[np.bool_]) -> Events:
    """Leave out the events of marked pixels, (H, W)."""
    if not is_bad.any():
        return events
    return _select(events, ~is_bad[events.y, events.x])


def without_background_activity(events: Events, support_ns: int = _SUPPORT_NS) -> Events:
    """Leave out events that no neighbour accompanies.

    Time is cut into slices of `support_ns`; an event stays where its 3 x 3 neighbourhood holds another
    pixel's event in the same slice or the one before, so its support is up to two slices old [1].

    References:
        [1] Delbruck, Frame-free dynamic digital vision, ISSE 2008 (with slices in place of a timestamp map).
    """
    if len(events) == 0:
        return events
    n_slices = int((events.t_ns[-1] - events.t_ns[0]) // support_ns) + 1
    keep = np.zeros(len(events), bool)
    bounds = np.searchsorted(events.t_ns, events.t_ns[0] + support_ns * np.arange(n_slices + 1))
    before = np.zeros((events.height_px, events.width_px), bool)
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        x, y = events.x[first:last], events.y[first:last]
        now = np.zeros_like(before)
        now[y, x] = True
        keep[first:last] = _has_neighbour(now | before)[y, x]
        before = now
    return _select(events, keep)


def _has_neighbour(is_active: NDArray[np.bool_]) -> NDArray[np.bool_]:
    wide = np.pad(is_active.astype(np.uint8), 1)
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    total = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return np.asarray(total > is_active.astype(np.uint8))


def _select(events: Events, keep: NDArray[np.bool_]) -> Events:
    return replace(
        events, t_ns=events.t_ns[keep], x=events.x[keep], y=events.y[keep], polarity=events.polarity[keep]
    )
