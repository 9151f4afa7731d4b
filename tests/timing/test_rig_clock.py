"""Timestamps of several sensors on one clock, with pulses and models of a sync board."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from lce_rig.core.data import Image, Pulse, Scan
from lce_rig.rig import load_rig
from lce_rig.rig.profile import SyncSettings
from lce_rig.timing.clock_fit import fit_clock
from lce_rig.timing.rig_clock import RigClock

T0_NS = 1_700_000_000_000_000_000
HOST_AHEAD_NS = 37_000_000
PERIOD_NS = 50_000_000
LOCKED = ["lidar"]


def tie(source_ns, reference_ns):
    model = fit_clock(source_ns, reference_ns, "edges")
    assert model is not None
    return model


@dataclass
class Board:
    """A board with a clock that counts from power-up; the computer is 37 ms ahead of its UTC."""

    @property
    def host_clock(self):
        times_ns = np.arange(0, 20_000_000_000, 500_000_000)
        return tie(times_ns, times_ns + T0_NS + HOST_AHEAD_NS)

    @property
    def utc_clock(self):
        times_ns = np.arange(0, 20_000_000_000, 500_000_000)
        return tie(times_ns, times_ns + T0_NS)


def refresh(clock, board, locked):
    clock.refresh(board.host_clock, board.utc_clock, locked)


def synced(rig_name, camera, max_delay_s=0.03):
    trigger = {camera: {"channel": 0, "rate_hz": 20, "max_delay_s": max_delay_s}}
    sync = SyncSettings.model_validate({"type": "lce1", "device": "/dev/null", "triggers": trigger})
    return load_rig(rig_name).model_copy(update={"sync": sync})


def picture(stamp_ns, count=None):
    return Image("cam", "frames", stamp_ns, np.zeros((2, 2), np.uint8), stamp_ns, count)


def scan(stamp_ns):
    nothing = np.zeros(0)
    return Scan("lidar", stamp_ns, np.zeros((0, 3), np.float32), nothing, nothing.astype(np.int16))


def test_rig_clock_without_board_needs_still():
    clock = RigClock(load_rig("rlfs"), has_board=False)
    clock.refresh(None, None, [])
    assert clock.take("cam", picture(T0_NS))[0].stamp_ns == T0_NS
    assert clock.take("lidar", scan(T0_NS))[0].stamp_ns == T0_NS
    assert clock.verdict().requires_still_boards
    assert [reason.code for reason in clock.verdict().reasons] == ["sync.no_board"]


def test_rig_clock_locked_lidar_keeps_utc():
    """Images of the computer's time are converted to it."""
    rig = load_rig("rlfs").model_copy(update={"sync": synced("rlfs", "cam").sync})
    clock = RigClock(rig, has_board=True, edge_cameras=["davis"])
    refresh(clock, Board(), LOCKED)
    assert clock.take("lidar", scan(T0_NS + 5_000_000_000))[0].stamp_ns == T0_NS + 5_000_000_000
    shown = clock.take("cam", picture(T0_NS + 5_000_000_000 + HOST_AHEAD_NS))[0]
    assert shown.stamp_ns == pytest.approx(T0_NS + 5_000_000_000, abs=2000)
    assert not clock.verdict().requires_still_boards


def test_an_unlocked_lidar_counts_by_the_computers_clock():
    clock = RigClock(synced("rlfs", "cam"), has_board=True, edge_cameras=["davis"])
    refresh(clock, Board(), [])
    placed = clock.take("lidar", scan(T0_NS + 2_000_000_000 + HOST_AHEAD_NS))[0]
    assert placed.stamp_ns == pytest.approx(T0_NS + 2_000_000_000, abs=2000)


def test_rig_clock_images_get_pulse_times():
    clock = RigClock(synced("rlfs", "cam"), has_board=True, edge_cameras=["davis"])
    refresh(clock, Board(), LOCKED)
    rng = np.random.default_rng(3)
    errors_ns = []
    for k in range(60):
        sent_ns = 1_000_000_000 + k * PERIOD_NS
        clock.take("sync", Pulse("cam", sent_ns, k + 9, T0_NS + sent_ns + HOST_AHEAD_NS))
        # The computer timestamps the image 10 ms late, +- 3 ms.
        late_ns = 10_000_000 + int(rng.normal(0, 3_000_000))
        image = picture(T0_NS + sent_ns + HOST_AHEAD_NS + late_ns, 100 + k)
        placed = clock.take("cam", image)
        if k > 30:
            errors_ns += [int(each.stamp_ns or 0) - T0_NS - sent_ns - 10_000_000 for each in placed]
    assert clock.problems() == []
    assert len(errors_ns) >= 25
    assert np.std(errors_ns) < 1_200_000  # of 3 ms on arrival
    assert abs(np.mean(errors_ns)) < 2_000_000


def test_rig_clock_jumped_images_keep_time():
    clock, board = RigClock(synced("rlfs", "cam"), has_board=True), Board()
    refresh(clock, board, LOCKED)
    came = []
    for k in range(20):
        if k == 10:
            clock.refresh(None, None, [])
        came += [
            image
            for image in clock.take("sync", Pulse("cam", k * PERIOD_NS, k, 0))
            if isinstance(image, Image)
        ]
        stamp_ns = T0_NS + HOST_AHEAD_NS + k * PERIOD_NS + 10_000_000
        came += [image for image in clock.take("cam", picture(stamp_ns, k)) if isinstance(image, Image)]
    assert came[-1].count == 19 and came[-1].stamp_ns == came[-1].host_ns


def test_rig_clock_missed_pulse_is_reported():
    clock = RigClock(synced("rlfs", "cam"), has_board=True, edge_cameras=["davis"])
    refresh(clock, Board(), LOCKED)
    number = 100
    for k in range(60):
        sent_ns = 1_000_000_000 + k * PERIOD_NS
        clock.take("sync", Pulse("cam", sent_ns, k + 9, T0_NS + sent_ns + HOST_AHEAD_NS))
        if k == 30:
            continue  # No frame, and its number is given to the next.
        placed = clock.take("cam", picture(T0_NS + sent_ns + HOST_AHEAD_NS + 10_000_000, number))
        number += 1
    assert abs(int(placed[-1].stamp_ns or 0) - T0_NS - sent_ns - 10_000_000) < 1_000_000
    (slipped,) = clock.account()
    assert (slipped.code, slipped.subject, slipped.figures["n_restarts"]) == ("pulses.slipped", "cam", 1)


def test_rig_clock_fast_lines_start_slowly():
    clock = RigClock(synced("rlfs", "cam", max_delay_s=0.1), has_board=True, edge_cameras=["davis"])
    assert clock.needs_slow_triggers
    refresh(clock, Board(), LOCKED)
    for k in range(8):
        sent_ns = 1_000_000_000 + k * 250_000_000
        clock.take("sync", Pulse("cam", sent_ns, k, 0))
        clock.take("cam", picture(T0_NS + sent_ns + HOST_AHEAD_NS + 40_000_000, k))
    refresh(clock, Board(), LOCKED)
    assert not clock.needs_slow_triggers


def test_rig_clock_davis_is_synchronised_by_edges():
    rig = synced("rles", "davis")
    clock = RigClock(rig, has_board=True, edge_cameras=["davis"])
    refresh(clock, Board(), LOCKED)
    assert [found.code for found in clock.problems()] == ["edges.none_seen"]
    # Its clock was set on opening, 20 ms off, and gains 30 ppm.
    for k in range(40):
        sent_ns = 1_000_000_000 + k * 250_000_000
        clock.take("sync", Pulse("davis", sent_ns, k, 0))
        seen_ns = T0_NS + HOST_AHEAD_NS + 20_000_000 + round(sent_ns * (1 + 30e-6))
        clock.take("davis", Pulse("davis", seen_ns, k, 0))
    refresh(clock, Board(), LOCKED)
    assert clock.problems() == []
    stamp_ns = T0_NS + HOST_AHEAD_NS + 20_000_000 + round(8_000_000_000 * (1 + 30e-6))
    image = replace(picture(stamp_ns), sensor="davis")
    placed = clock.take("davis", image)[0]
    assert placed.stamp_ns == pytest.approx(T0_NS + 8_000_000_000, abs=3000)
    assert not clock.verdict().requires_still_boards
