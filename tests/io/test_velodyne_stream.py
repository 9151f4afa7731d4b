"""Packets of a VLP-16 become scans whatever happens to them on the way."""

from dataclasses import replace

import numpy as np
import pytest
from wire.vlp16_packets import SensorPacket, Vlp16Clock

from lce_rig.core import velodyne

from .vlp16_room import (
    PERIOD_NS,
    T0_NS,
    largest_errors,
    only_data,
    packets_of,
    push,
    room_scans,
    stamps,
    stream_of,
)


@pytest.fixture(scope="module")
def packets() -> list[SensorPacket]:
    return packets_of(room_scans(5))


def test_scans_go_from_seam_to_seam_behind_the_sensor(packets: list[SensorPacket]) -> None:
    for truth, scan in zip(room_scans(5), push(stream_of(), packets), strict=True):
        assert scan.offset_ns is not None and scan.offset_ns[0] == 0
        assert len(scan.points) == len(truth.points)
        assert largest_errors(truth, scan)[1] < np.radians(0.0101)
        azimuth = np.degrees(np.unwrap(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
        assert np.ptp(azimuth) == pytest.approx(359.9, abs=0.3)
        assert abs(azimuth[0]) > 179.5


def test_a_stream_that_begins_and_ends_anywhere_loses_only_the_broken_revolutions(
    packets: list[SensorPacket],
) -> None:
    stream = stream_of()
    scans = push(stream, packets[30:-30])
    assert stream.finish() is None
    assert len(scans) == 3
    assert stream.losses.n("scan.partial") == 2
    assert stream.losses.n("packet.lost") == 0


def test_losses_are_counted_by_the_sensors_counter_whatever_the_hosts_clock_does(
    packets: list[SensorPacket],
) -> None:
    rng = np.random.default_rng(0)
    is_kept = rng.random(len(packets)) > 0.3
    is_kept[[0, -1]] = True
    kept = [packet for packet, keep in zip(packets, is_kept, strict=True) if keep]
    late = [replace(p, sent_ns=p.sent_ns + int(rng.integers(20_000_000))) for p in kept]
    stream = stream_of()
    scans = push(stream, late)
    assert stream.losses.n("packet.lost") == len(only_data(packets)) - len(only_data(kept))
    assert len(scans) == 5
    share = sum(len(s.points) for s in scans) / sum(len(s.points) for s in room_scans(5))
    assert share == pytest.approx(len(only_data(kept)) / len(only_data(packets)), abs=0.01)


def test_a_scan_of_which_more_than_half_is_lost_is_left_out(packets: list[SensorPacket]) -> None:
    gap = slice(90, 135)
    stream = stream_of()
    scans = push(stream, packets[: gap.start] + packets[gap.stop :])
    assert (len(scans), stream.losses.n("scan.thin")) == (4, 1)
    assert stream.losses.n("packet.lost") == len(only_data(packets[gap]))


def test_packets_sent_twice_or_late_change_nothing(packets: list[SensorPacket]) -> None:
    arrived = list(packets)
    arrived.insert(50, packets[40])
    arrived.insert(200, packets[198])
    stream = stream_of()
    scans = push(stream, arrived)
    assert stream.losses.n("packet.late") == 2
    for truth, scan in zip(room_scans(5), scans, strict=True):
        assert len(scan.points) == len(truth.points)


@pytest.mark.parametrize("shift_us", [500_000, -700_000_000])
def test_a_sensor_whose_clock_is_set_loses_one_revolution(shift_us: int) -> None:
    before = packets_of(room_scans(3), clock=Vlp16Clock(error_us=shift_us, pps="absent"))
    after = packets_of(room_scans(6))
    at = 140
    stream = stream_of()
    scans = push(stream, before[:at] + after[at:])
    assert stream.losses.n("packet.clock_set") == 1
    assert len(scans) == 5
    assert stream.losses.n("scan.partial") == 1
    for stamp_ns in stamps(scans):
        assert min(abs(int(stamp_ns or 0) - int(s.stamp_ns or 0)) for s in room_scans(6)) < 1_000_000


def test_a_change_to_dual_returns_is_followed(packets: list[SensorPacket]) -> None:
    dual = packets_of(room_scans(3, T0_NS + 5 * PERIOD_NS), velodyne.DUAL)
    stream = stream_of()
    scans = push(stream, [*packets[:-2], *dual])
    # The last packet before is missing, so that its revolution is broken.
    assert stream.mode == velodyne.DUAL and len(scans) == 8 - 1


def test_mutated_packets_never_make_a_scan_that_breaks_its_own_rules() -> None:
    rng = np.random.default_rng(0)
    stream = stream_of()
    n_scans = 0
    for packet in only_data(packets_of(room_scans(10))):
        body = bytearray(packet.payload)
        if rng.random() < 0.3:
            for at in rng.integers(0, len(body), rng.integers(1, 6)):
                body[at] = rng.integers(256)
        scan = stream.push_data(bytes(body), packet.sent_ns)
        if scan is not None:
            n_scans += 1
            assert np.isfinite(scan.points).all() and 0 <= scan.ring.min() <= scan.ring.max() <= 15
            assert scan.offset_ns is not None and np.all(np.diff(scan.offset_ns) > -100_000)
            assert scan.offset_ns[0] >= 0 and scan.offset_ns[-1] < 101_000_000
    assert n_scans >= 5 and sum(flaw.figure("n") for flaw in stream.flaws()) > 20
