"""What no scene made: hot pixels and background activity."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events

# A pixel is hot where it fires this many times as often as the 5 x 5 pixels around it.
_HOT_FACTOR = 8.0
_HOT_MIN_EVENTS = 20
_SUPPORT_NS = 10_000_000


def hot_pixels(n_events: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """Find pixels that fire on their own, (H, W), from events per pixel over half a second or more, (H, W).

    Real edges pass over neighbours too, whichever way they move; a hot pixel's neighbours stay quiet. The
    median of the neighbours is blind to a second hot pixel next door.
    """
    import cv2

    typical = cv2.medianBlur(n_events, 5).astype(np.float32)
    return np.asarray((n_events >= _HOT_MIN_EVENTS) & (n_events > _HOT_FACTOR * (typical + 1)))


def without_pixels(events: Events, is_bad: NDArray[np.bool_]) -> Events:
    """Leave out the events of marked pixels, (H, W)."""
    if not is_bad.any():
        return events
    return _select(events, ~is_bad[events.y, events.x])


def without_background_activity(events: Events, support_ns: int = _SUPPORT_NS) -> Events:
    """Leave out events that no neighbour accompanies.

    Time is cut into slices of `support_ns`; an event stays where its 3 x 3 neighbourhood holds another
    pixel's event in the same slice, the one before or the one after: the nearest-neighbour filter of [1] with
    slices in place of a map of time stamps.

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
        keep[cut] = _has_neighbour(near)[events.y[cut], events.x[cut]]
    return _select(events, keep)


def _has_neighbour(is_active: NDArray[np.bool_]) -> NDArray[np.bool_]:
    wide = np.pad(is_active.astype(np.uint8), 1)
    rows = wide[:-2] + wide[1:-1] + wide[2:]
    total = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return np.asarray(total > is_active)


def _select(events: Events, keep: NDArray[np.bool_]) -> Events:
    if keep.all():
        return events
    return replace(
        events, t_ns=events.t_ns[keep], x=events.x[keep], y=events.y[keep], polarity=events.polarity[keep]
    )
