"""Events rotated, inverted or late relative to the frames of the same camera."""

from dataclasses import replace

import numpy as np
import pytest

from lce_rig.collect.events_check import EventsCheck
from lce_rig.core.errors import SourceError
from lce_rig.timing.scan_pairing import AFTER_NS, BEFORE_NS, EventBuffer, Frame

from . import simulated_moves as moves

pytestmark = pytest.mark.long
PERIOD_NS = 100_000_000


@pytest.fixture(scope="module")
def images():
    start_ns = moves.recording().start_ns
    n_images = round(moves.DURATION_S * 1e9) // PERIOD_NS
    return [moves.recording().take_image("davis", start_ns + k * PERIOD_NS, (k,)) for k in range(n_images)]


def check(images, change=lambda events: events):
    rig = moves.rig()
    buffer, checked = EventBuffer(rig), EventsCheck(rig)
    for packet in moves.events():
        buffer.add(change(packet))
    stamps = [image.stamp_ns for image in images]
    cuts = [buffer.cut(stamp_ns - BEFORE_NS, stamp_ns + AFTER_NS) for stamp_ns in stamps]
    frames = [Frame(t, (image,), (), cut) for t, image, cut in zip(stamps, images, cuts, strict=True)]
    assert list(checked.watch(frames)) == frames
    return checked.findings()


def flipped(events, *, columns, rows):
    x = (events.width_px - 1 - events.x).astype(np.uint16) if columns else events.x
    y = (events.height_px - 1 - events.y).astype(np.uint16) if rows else events.y
    return replace(events, x=x, y=y)


def test_events_check_right_events_has_no_findings(images):
    assert check(images) == []


@pytest.mark.parametrize(
    ("columns", "rows", "words"),
    [(True, True, "rotated by 180 deg"), (True, False, "mirrored"), (False, True, "upside down")],
)
def test_events_check_turned_events_are_refused(images, columns, rows, words):
    with pytest.raises(SourceError, match=words):
        check(images, lambda events: flipped(events, columns=columns, rows=rows))


def test_events_check_inverted_polarity_is_named(images):
    (found,) = check(images, lambda events: replace(events, polarity=~events.polarity))
    assert found.code == "events.polarity"


@pytest.mark.parametrize("late_s", [0.3, -0.2])
def test_events_check_late_events_name_the_offset(images, late_s):
    (found,) = check(images, lambda events: replace(events, t_ns=events.t_ns + round(late_s * 1e9)))
    assert found.code == "events.late"
    assert found.figure("late_s") == pytest.approx(late_s, abs=0.051)
    assert found.figure("expected_offset_s") == -found.figure("late_s")


def test_events_check_few_events_are_not_judged(images):
    assert check(images, lambda events: events.select(slice(0, 20))) == []
