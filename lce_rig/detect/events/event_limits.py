"""The profile's limits on boards in images from events, and refusals if none was detected."""

import numpy as np

from lce_rig.core.data import Events
from lce_rig.core.findings import Refusal
from lce_rig.core.results import ImageBoard
from lce_rig.detect.events.figures import MEMORY_NS, busiest_events
from lce_rig.detect.events.flicker import measure_flicker
from lce_rig.detect.events.reconstruct.filters import hot_pixels
from lce_rig.detect.findings import (
    IMAGE_FEW_EVENTS,
    IMAGE_FLICKER,
    IMAGE_HARDLY_MOVED,
    IMAGE_HOT_PIXELS,
    IMAGE_NO_EVENTS,
    IMAGE_SMEARED,
    IMAGE_STILL_SCENE,
    IMAGE_TOO_FAST,
    IMAGE_TURNING,
)
from lce_rig.rig import QualitySettings

_MAX_HOT_SHARE = 0.5
# One event per hundred pixels in 1 s counts as none.
_MIN_EVENTS_PX = 0.01
# Boards at 2 to 5 cm/s make 2 to 4 events a pixel in a second: with fewer one that is missing was too slow.
_SLOW_EVENTS_PX = 4.0


def gate_event_board(found: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Compare a board in an image from events with the profile's limits on events and motion.

    A figure that could not be measured, and images that others reconstructed, are not judged; speeds count
    if they exceed the limit by two standard deviations.

    Args:
        found: the board with figures of its events.
        limits: `quality` of the rig profile.
    """
    q = found.events
    if q is None:
        return found
    if q.events_px < limits.min_events_px:
        figures = {"events_px": q.events_px, "min_events_px": limits.min_events_px}
        return IMAGE_HARDLY_MOVED.refusal(**figures)
    # Comparisons with a figure that is not known are false.
    if q.speed_mps - 2 * q.speed_sigma_mps > limits.max_board_speed_mps:
        return too_fast(q.speed_mps, limits)
    if q.turn_deg_s - 2 * q.turn_sigma_deg_s > limits.max_turn_deg_s:
        figures = {"turn_deg_s": q.turn_deg_s, "max_turn_deg_s": limits.max_turn_deg_s}
        return IMAGE_TURNING.refusal(**figures)
    if q.smear_m > limits.max_smear_m:
        return IMAGE_SMEARED.refusal(smear_m=q.smear_m, max_smear_m=limits.max_smear_m)
    return found


def too_fast(speed_mps: float, limits: QualitySettings) -> Refusal:
    """Refuse a board that moves faster than the profile allows."""
    figures = {"speed_mps": speed_mps, "max_speed_mps": limits.max_board_speed_mps}
    return IMAGE_TOO_FAST.refusal(**figures)


def explain_missing_board(events: Events, stamp_ns: int, seen: Refusal, limits: QualitySettings) -> Refusal:
    """Return the fault of the events that prevents a detection; `seen` if there is none.

    Args:
        events: about the image.
        stamp_ns: of the image.
        seen: why there is no image, or no board in it.
        limits: `quality` of the rig profile.
    """
    if len(events) and seen.stage == "read":
        return seen
    return events_problem(events, stamp_ns, limits) or seen


def events_problem(events: Events, stamp_ns: int, limits: QualitySettings) -> Refusal | None:
    """Say what about the events before a timestamp keeps a board from being found; None if nothing does."""
    if not len(events):
        return IMAGE_NO_EVENTS.refusal()
    recent = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    n_pixels = events.width_px * events.height_px
    if len(recent) < _MIN_EVENTS_PX * n_pixels:
        return IMAGE_FEW_EVENTS.refusal(n_events=len(recent))
    lamps = look_for_flicker(recent)
    if lamps is not None:
        return lamps
    # Count hot pixels and measure their share of the events.
    shape = recent.height_px, recent.width_px
    index = recent.y.astype(np.intp) * recent.width_px + recent.x
    counts = np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
    is_hot = hot_pixels(np.minimum(counts, 65535).astype(np.uint16))
    n_hot, hot_share = int(is_hot.sum()), float(counts[is_hot].sum() / max(counts.sum(), 1))
    if hot_share > _MAX_HOT_SHARE:
        return IMAGE_HOT_PIXELS.refusal(n_hot=n_hot, share=hot_share)
    events_px, needed_px = busiest_events(events, stamp_ns), max(_SLOW_EVENTS_PX, limits.min_events_px)
    if events_px < needed_px:
        figures = {"events_px": events_px, "min_events_px": needed_px}
        return IMAGE_STILL_SCENE.refusal(**figures)
    return None


def look_for_flicker(events: Events) -> Refusal | None:
    """Name the lamps that make most of the events of about a second; None if none do."""
    flicker = measure_flicker(events)
    if not flicker.is_storm:
        return None
    return IMAGE_FLICKER.refusal(frequency_hz=flicker.frequency_hz)
