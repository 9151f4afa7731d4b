"""What a camera's pictures and events are like, and the board in them and in a LiDAR's scans."""

from dataclasses import replace

import numpy as np

from lce_rig.collect.health.check import Check
from lce_rig.collect.health.examination import Examination
from lce_rig.core.findings import Finding
from lce_rig.core.results import Refusal
from lce_rig.detect.event_gate import events_problem
from lce_rig.detect.image_quality import strongest_edge_px
from lce_rig.timing.event_buffer import join_events

_BLACK, _WHITE = 5, 250
_MAX_WHITE, _MAX_BLACK = 0.2, 0.6
_DARK_GREY, _FLAT_GREY = 50.0, 3.0
# As the finder of boards has it: edges that are wider are blurred.
_MAX_EDGE_PX = 6.0


def check_picture(exam: Examination, sensor: str) -> Check | None:
    """Judge the exposure and sharpness of the last image."""
    images = exam.seen[sensor].images
    if not images:
        return None
    grey = next(iter(images.values())).grey
    low, high = (float(value) for value in np.percentile(grey, (1, 99)))
    white, black = float(np.mean(grey >= _WHITE)), float(np.mean(grey <= _BLACK))
    edge_px = strongest_edge_px(grey, high - low)
    figures = {"grey_1": low, "grey_99": high, "white_share": white, "black_share": black, "edge_px": edge_px}
    wrong = None
    if high - low < _FLAT_GREY:
        wrong = Finding("exposure.nothing_visible")
    elif high < _DARK_GREY or black > _MAX_BLACK:
        wrong = Finding("exposure.dark", "warning", figures={"black_share": black})
    elif white > _MAX_WHITE:
        wrong = Finding("exposure.bright", "warning", figures={"white_share": white})
    elif edge_px > _MAX_EDGE_PX:
        wrong = Finding("exposure.blurred", "warning", figures={"limit_px": _MAX_EDGE_PX})
    return Check.of(sensor, "picture", Finding("exposure.grey", "note", figures=figures), wrong)


def check_events(exam: Examination, sensor: str) -> Check | None:
    """Judge the last second of events: lamps that flicker, hot pixels, too few."""
    seen = exam.seen[sensor]
    if not seen.events:
        return None
    events = join_events(list(seen.events))
    problem = events_problem(events, int(events.t_ns[-1]) + 1, exam.rig.quality)
    found = Finding("exposure.events", "note") if problem is None else replace(problem, severity="warning")
    return Check.of(sensor, "events", found)


def check_board(exam: Examination, sensor: str) -> Check | None:
    """Say whether the sensor sees the board now."""
    found = [board for (name, _), board in exam.boards.items() if name == sensor]
    if not found:
        return None
    # Where any channel sees it, it is there.
    seen = next((board for board in found if not isinstance(board, Refusal)), None)
    return Check.of(sensor, "board", seen or replace(found[0], severity="warning"))
