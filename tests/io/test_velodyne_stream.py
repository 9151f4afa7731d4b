"""Packets of a VLP-16: only whole ones are believed; they become scans with the manual's points and time."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire.vlp16_packets import Vlp16Clock, Vlp16Packets

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.io.velodyne_packets import BadPacketError, read_data_packet, read_position_packet
from lce_rig.io.velodyne_scans import Vlp16Stream, read_controls
from lce_rig.rig.sensors import DriverSettings, TimestampSettings

from .vlp16_room import (
    HOUR_NS,
    NETWORK_NS,
    PERIOD_NS,
    T0_NS,
    largest_errors,
    only_data,
    packets_of,
    push,
    room_scan,
    room_scans,
    settings,
    stamps,
    stream_of,
)


@pytest.fixture(scope="module")
def packets():
    return packets_of(room_scans(5))


def test_scans_go_from_seam_to_seam_behind_the_sensor(packets):
    for truth, scan in zip(room_scans(5), push(stream_of(), packets), strict=True):
        assert scan.offset_ns is not None and scan.offset_ns[0] == 0
        assert len(scan.points) == len(truth.points)
        assert largest_errors(truth, scan)[1] < np.radians(0.0101)
        azimuth = np.degrees(np.unwrap(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
        assert np.ptp(azimuth) == pytest.approx(359.9, abs=0.3)
        assert abs(azimuth[0]) > 179.5


def test_velodyne_cut_revolutions_are_lost(packets):
    stream = stream_of()
    scans = push(stream, packets[30:-30])
    assert stream.finish() is None
    assert len(scans) == 3
    assert stream.losses.n("scan.partial") == 2
    assert stream.losses.n("packet.lost") == 0


def test_velodyne_losses_follow_the_counter(packets):
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


def test_velodyne_scan_with_most_packets_lost_is_skipped(packets):
    gap = slice(90, 135)
    stream = stream_of()
    scans = push(stream, packets[: gap.start] + packets[gap.stop :])
    assert (len(scans), stream.losses.n("scan.thin")) == (4, 1)
    assert stream.losses.n("packet.lost") == len(only_data(packets[gap]))


def test_velodyne_duplicate_or_late_packets_change_nothing(packets):
    arrived = list(packets)
    arrived.insert(50, packets[40])
    arrived.insert(200, packets[198])
    stream = stream_of()
    scans = push(stream, arrived)
    assert stream.losses.n("packet.late") == 2
    for truth, scan in zip(room_scans(5), scans, strict=True):
        assert len(scan.points) == len(truth.points)


@pytest.mark.parametrize("shift_us", [500_000, -700_000_000])
def test_a_sensor_whose_clock_is_set_loses_one_revolution(shift_us):
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


def test_a_change_to_dual_returns_is_followed(packets):
    dual = packets_of(room_scans(3, T0_NS + 5 * PERIOD_NS), velodyne.DUAL)
    stream = stream_of()
    scans = push(stream, [*packets[:-2], *dual])
    # The last packet before is missing, so that its revolution is broken.
    assert stream.mode == velodyne.DUAL and len(scans) == 8 - 1


@pytest.mark.parametrize(
    "controls",
    [{"rpm": 600}, {"position_port": "8308"}, {"position_port": 0}, {"cut_deg": True}, {"cut_deg": 500.0}],
)
def test_velodyne_implausible_settings_are_refused(controls):
    driver = DriverSettings.model_validate({"controls": controls})
    with pytest.raises(SourceError, match=next(iter(controls))):
        read_controls("lidar", settings(driver=driver))


@pytest.mark.parametrize("cut_deg", [-90, 0, 37.5])
def test_velodyne_seam_follows_profile(cut_deg):
    driver = DriverSettings(controls={"cut_deg": cut_deg})
    stream = Vlp16Stream("lidar", settings(driver=driver))
    scans = push(stream, packets_of(room_scans(4)))
    assert len(scans) == 3 and stream.losses.n("scan.partial") == 2
    for scan in scans:
        azimuth_deg = np.degrees(np.unwrap(np.arctan2(scan.points[:, 1], scan.points[:, 0])))
        off_deg = (azimuth_deg[0] - cut_deg + 180) % 360 - 180
        assert -0.45 < off_deg <= 0.01
        assert np.ptp(azimuth_deg) == pytest.approx(359.8, abs=0.4)


def test_velodyne_time_continues_over_the_hour():
    truth = room_scans(6, T0_NS - T0_NS % HOUR_NS + HOUR_NS - 250_000_000)
    stream = stream_of()
    scans = push(stream, packets_of(truth))
    assert stream.clock.is_utc
    assert np.abs(np.array(stamps(scans), np.int64) - np.array(stamps(truth), np.int64)).max() < 1000
    assert stream.losses.n("packet.lost") == 0


UNSYNCHRONISED = {
    "absent": (Vlp16Clock("absent", has_nmea=False, error_us=721_000_000), "clock.pps_not_locked"),
    "synchronising": (Vlp16Clock("synchronising"), "clock.pps_not_locked"),
    "in error": (Vlp16Clock("error"), "clock.pps_not_locked"),
    "without sentences": (Vlp16Clock(has_nmea=False), "clock.no_nmea"),
    "of another second": (Vlp16Clock(error_us=721_000_000), "clock.nmea_of_other_second"),
    "of another clock": (Vlp16Clock(error_us=-368_000), "clock.lidar_utc_differs"),
}


@pytest.mark.parametrize("name", sorted(UNSYNCHRONISED))
def test_velodyne_bad_clock_uses_arrival(name):
    clock, code = UNSYNCHRONISED[name]
    truth = room_scans(3, T0_NS + 500_000_000)
    stream = stream_of()
    scans = push(stream, packets_of(truth, clock=clock))
    state = stream.clock.state()
    assert not stream.clock.is_utc and (state.code, state.severity) == (code, "warning")
    late_ns = np.array(stamps(scans), np.int64) - np.array(stamps(truth), np.int64)
    # The packet's length is taken off; what is left is the way through the network, and the counter's step.
    np.testing.assert_allclose(late_ns, NETWORK_NS, atol=1000)


def test_arrivals_that_waited_do_not_shift_stamps():
    truth = room_scans(10)
    clock = Vlp16Clock("absent", has_nmea=False, error_us=5)
    rng = np.random.default_rng(1)
    arrived = [
        replace(p, sent_ns=p.sent_ns + int(rng.exponential(3_000_000)))
        for p in packets_of(truth, clock=clock)
    ]
    scans = push(stream_of(), arrived)
    late_ns = np.array(stamps(scans), np.int64) - np.array(stamps(truth), np.int64) - NETWORK_NS
    assert late_ns.min() > -1000 and late_ns[1:].max() < 300_000


def test_velodyne_without_position_packets_is_unsynchronised(packets):
    stream = stream_of()
    assert len(push(stream, only_data(packets))) == 5
    assert stream.clock.state().code == "clock.no_position_packets"
    stream = stream_of()
    push(stream, packets)
    assert stream.clock.is_utc
    push(stream, only_data(packets_of(room_scans(2, T0_NS + 4 * 10**9))))
    assert stream.clock.state().code == "clock.position_packets_stopped"


def test_velodyne_profile_may_select_host_time(packets):
    stream = stream_of(timestamps=TimestampSettings(reference="first_firing", clock="host"))
    scans = push(stream, packets)
    assert stream.clock.state().code == "clock.host_wanted"
    np.testing.assert_allclose(
        np.array(stamps(scans), np.int64) - np.array(stamps(room_scans(5)), np.int64), NETWORK_NS, atol=1000
    )


def test_velodyne_no_arrival_has_no_stamp(packets):
    scans = push(stream_of(), packets, delay_ns=None)
    assert stamps(scans) == [None] * 5
    assert scans[0].host_ns is None


def test_ranges_beyond_the_profiles_limits_give_no_points(packets):
    near = push(stream_of(min_range_m=4.0, max_range_m=4.5), packets)[1]
    reach = np.linalg.norm(near.points, axis=1)
    assert 3.98 < reach.min() < 4.02 and 4.48 < reach.max() < 4.52
    assert np.all(np.diff(near.offset_ns) > 0)


def test_velodyne_dual_return_keeps_brighter_one():
    front = room_scan(T0_NS, dropout=0.0)
    behind = room_scan(T0_NS, scale=1.5, dropout=0.0)
    # The last return is brighter in every other firing, and alone in the last hundred.
    brighter = np.arange(len(front.points)) % 2 == 0
    behind = replace(behind, intensity=front.intensity + np.where(brighter, 5, -5).astype(np.float32))
    front = front.select(np.arange(len(front.points)) < len(front.points) - 100)
    sender_packets = packets_of_dual(front, behind)
    scan = push(stream_of(), sender_packets)[0]
    assert len(scan.points) == len(behind.points)
    expected = np.where(brighter | (np.arange(len(behind.points)) >= len(front.points)), 1.5, 1.0)
    reach = np.linalg.norm(scan.points, axis=1)
    reach_behind = np.linalg.norm(behind.points, axis=1)
    np.testing.assert_allclose(reach, reach_behind * expected / 1.5, atol=0.02)


def packets_of_dual(front, behind):
    sender = Vlp16Packets(velodyne.DUAL)
    return sender.feed(front, behind) + sender.finish()


US_AT, MODE_AT, PRODUCT_AT = 1200, 1204, 1205


@pytest.fixture(scope="module")
def payload():
    return packets_of(room_scans(1))[20].payload


def damage(payload, at, value):
    return payload[:at] + value + payload[at + len(value) :]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: p[:-1],
        lambda p: p + b"\0",
        lambda p: b"",
        lambda p: damage(p, 500, b"\xff\xdd"),
        lambda p: damage(p, 1102, struct.pack("<H", 36000)),
        lambda p: damage(p, 502, struct.pack("<H", 20000)),
        lambda p: damage(p, MODE_AT, b"\x39"),
        lambda p: damage(p, US_AT, struct.pack("<I", velodyne.HOUR_US)),
        lambda p: damage(p, MODE_AT, b"\0\0"),
        lambda p: damage(p, PRODUCT_AT, b"\x23"),
    ],
)
def test_a_damaged_data_packet_is_refused(spoil, payload):
    read_data_packet(payload, 0)
    with pytest.raises(BadPacketError):
        read_data_packet(spoil(payload), 0)


@given(st.binary(max_size=600))
def test_position_packet_is_read_or_refused(payload):
    for body in (payload, payload.ljust(velodyne.POSITION_BYTES, b"\0")[: velodyne.POSITION_BYTES]):
        try:
            read = read_position_packet(body)
        except BadPacketError:
            continue
        assert 0 <= read.us < velodyne.HOUR_US and read.pps in range(4)


@pytest.mark.parametrize(
    ("sentence", "second"),
    [
        (b"$GPRMC,081802.00,A,3649.7478558,N,00224.4542928,W,0.034,212.5,210116,0.0,E,A*2E\r\n", 1082),
        (b"$GPRMC,220516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*70\n", 316),
        (b"$GPRMC,220516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*71\n", None),
        (b"$GNRMC,220516,V,,,,,,,130694,,,N*7A", None),
        (b"$GPGGA,220516,1,1*6C", None),
        (b"$GPRMC,226516,A,5133.82,N,00042.24,W,173.8,231.8,130694,004.2,W*76\n", None),
        (b"\xff" * 306, None),
    ],
)
def test_velodyne_only_valid_sentences_set_time(sentence, second):
    body = bytearray(velodyne.POSITION_BYTES)
    body[0xCE : 0xCE + len(sentence)] = sentence
    assert read_position_packet(bytes(body)).nmea_s == second
