"""The profile's limits on boards seen through events, and why none was seen, with what to do about it."""

import numpy as np

from lce_rig.core.data import Events
from lce_rig.core.results import ImageBoard, Refusal
from lce_rig.detect.event_figures import MEMORY_NS, busiest_events
from lce_rig.detect.flicker import measure_flicker
from lce_rig.detect.image_quality import MOVE_SLOWLY
from lce_rig.detect.reconstruct.filters import hot_pixels
from lce_rig.rig import QualitySettings

_MAX_HOT_SHARE = 0.5
# One event in a hundred pixels in a second is none.
_MIN_EVENTS_PX = 0.01
# Boards at 2 to 5 cm/s make 2 to 4 events a pixel in a second: with fewer one that is missing was too slow.
_SLOW_EVENTS_PX = 4.0
_SLOWER = "move it slower, about 10 cm/s"


def gate_event_board(found: ImageBoard, limits: QualitySettings) -> ImageBoard | Refusal:
    """Hold a board seen through events against the profile's limits on events and motion.

    A figure that could not be measured, as of pictures that others reconstructed, is not judged; speeds count
    from where two standard deviations leave no doubt.

    Args:
        found: with the figures of its quality record.
        limits: `quality` of the rig profile.
    """
    q = found.quality
    events_px = q.get("events_px")
    if events_px is not None and events_px < limits.min_events_px:
        cause = f"the board hardly moved: {events_px:.1f} events a pixel of it in a second"
        return Refusal("image", f"{cause} ({limits.min_events_px:g} needed)", MOVE_SLOWLY)
    speed_mps = q.get("speed_mps", 0.0)
    if speed_mps - 2 * q.get("speed_sigma_mps", 0.0) > limits.max_board_speed_mps:
        cause = f"the board moved at {speed_mps:.2f} m/s while the LiDAR swept it"
        return Refusal("image", f"{cause} ({limits.max_board_speed_mps:g} allowed)", _SLOWER)
    turn_deg_s = q.get("turn_deg_s", 0.0)
    if turn_deg_s - 2 * q.get("turn_sigma_deg_s", 0.0) > limits.max_turn_deg_s:
        cause = f"the board turned at {turn_deg_s:.0f} deg/s while the LiDAR swept it"
        return Refusal(
            "image", f"{cause} ({limits.max_turn_deg_s:g} allowed)", "turn it less, move it sideways only"
        )
    smear_m = q.get("smear_m", 0.0)
    if smear_m > limits.max_smear_m:
        cause = f"the board moved {1000 * smear_m:.0f} mm while the LiDAR swept it"
        return Refusal("image", f"{cause} ({1000 * limits.max_smear_m:.0f} allowed)", _SLOWER)
    return found


def explain_missing_board(events: Events, stamp_ns: int, seen: Refusal, limits: QualitySettings) -> Refusal:
    """Say what about the events keeps the board from being found; what was seen where they are not to blame.

    Args:
        events: about the picture.
        stamp_ns: of the picture.
        seen: why there is no picture, or no board in it.
        limits: `quality` of the rig profile.
    """
    if not len(events):
        return Refusal("image", "the capture holds no events", "uncover the lens, switch the event stream on")
    if seen.stage == "read":
        return seen
    recent = events.between(stamp_ns - MEMORY_NS, stamp_ns)
    n_pixels = events.width_px * events.height_px
    if len(recent) < _MIN_EVENTS_PX * n_pixels:
        cause = f"no events to speak of: {len(recent)} in the second before the picture"
        return Refusal("image", cause, f"{MOVE_SLOWLY}; if it moved, uncover the lens")
    flicker = measure_flicker(recent)
    if flicker.is_storm:
        rhythm = f" at {flicker.frequency_hz:.0f} Hz" if flicker.frequency_hz else ""
        cause = f"most events come from light that flickers{rhythm}"
        return Refusal("image", cause, "record by daylight or under lamps that do not flicker")
    n_hot, hot_share = _hot(recent)
    if hot_share > _MAX_HOT_SHARE:
        cause = f"{n_hot} hot pixels make {100 * hot_share:.0f} % of the events; the board makes too few"
        return Refusal("image", cause, f"{MOVE_SLOWLY}; let the camera cool down, or mask them in its driver")
    events_px = busiest_events(events, stamp_ns)
    if events_px < max(_SLOW_EVENTS_PX, limits.min_events_px):
        cause = f"the board hardly moved: {events_px:.1f} events a pixel in a second where most are"
        return Refusal("image", cause, MOVE_SLOWLY)
    return seen


def _hot(events: Events) -> tuple[int, float]:
    """Count hot pixels and measure their share of the events."""
    shape = events.height_px, events.width_px
    index = events.y.astype(np.intp) * events.width_px + events.x
    counts = np.bincount(index, minlength=shape[0] * shape[1]).reshape(shape)
    is_hot = hot_pixels(np.minimum(counts, 65535).astype(np.uint16))
    return int(is_hot.sum()), float(counts[is_hot].sum() / max(counts.sum(), 1))
