"""What a camera's pictures and events are like, and the board in them and in a LiDAR's scans."""

import numpy as np

from lce_rig.collect.health.check import Check, Severity
from lce_rig.collect.health.examination import Examination
from lce_rig.detect.event_gate import events_problem
from lce_rig.detect.image_quality import strongest_edge_px
from lce_rig.timing.event_buffer import join_events
from lce_rig.words import describe, recommend

_BLACK, _WHITE = 5, 250
_MAX_WHITE, _MAX_BLACK = 0.2, 0.6
_DARK_GREY, _FLAT_GREY = 50.0, 3.0
# As the finder of boards has it: edges that are wider are blurred.
_MAX_EDGE_PX = 6.0


def check_picture(exam: Examination, sensor: str) -> Check | None:
    """Judge the exposure and sharpness of the last picture."""
    images = exam.seen[sensor].images
    if not images:
        return None
    grey = next(iter(images.values())).grey
    low, high = (float(value) for value in np.percentile(grey, (1, 99)))
    white, black = float(np.mean(grey >= _WHITE)), float(np.mean(grey <= _BLACK))
    edge_px = strongest_edge_px(grey, high - low)
    values = {"grey_1": low, "grey_99": high, "white_share": white, "black_share": black}
    figure = f"grey {low:.0f} to {high:.0f}, {100 * white:.0f} % white"
    if high - low < _FLAT_GREY:
        remedy = "Take the lens cap off; is the cable in the right port?"
        return Check(sensor, "picture", "red", f"{figure}: nothing to be seen", remedy, values)
    values["edge_px"] = edge_px
    problem = ""
    if high < _DARK_GREY or black > _MAX_BLACK:
        problem = f"underexposed ({100 * black:.0f} % black): expose longer, open the lens, or add light"
    elif white > _MAX_WHITE:
        problem = "overexposed: expose shorter, or turn away from the light"
    elif edge_px > _MAX_EDGE_PX:
        problem = "blurred: focus the lens, clean it, and expose shorter"
    severity: Severity = "yellow" if problem else "green"
    figure += f", edges {edge_px:.1f} px"
    remedy = problem[:1].upper() + problem[1:] + "." if problem else ""
    return Check(sensor, "picture", severity, figure, remedy, values)


def check_events(exam: Examination, sensor: str) -> Check | None:
    """Judge the last second of events: lamps that flicker, hot pixels, too few."""
    seen = exam.seen[sensor]
    if not seen.events:
        return None
    events = join_events(list(seen.events))
    problem = events_problem(events, int(events.t_ns[-1]) + 1, exam.rig.quality)
    if problem is None:
        return Check(sensor, "events", "green", "moving edges, no flicker, no hot pixels to speak of")
    return Check(sensor, "events", "yellow", describe(problem), recommend(problem))


def check_board(exam: Examination, sensor: str) -> Check | None:
    """Say whether the sensor sees the board now."""
    sights = {channel: sight for (name, channel), sight in exam.boards.items() if name == sensor}
    if not sights:
        return None
    best = min(sights.values(), key=lambda sight: sight.refusal is not None)
    if best.refusal is None:
        return Check(sensor, "board", "green", best.figure, values=best.values)
    return Check(sensor, "board", "yellow", describe(best.refusal), recommend(best.refusal))
