"""A VLP-16 whose time can be trusted is told from one whose time cannot."""

from dataclasses import replace

import numpy as np
import pytest
from wire.vlp16_packets import SensorPacket, Vlp16Clock

from lce_rig.rig.sensors import TimestampSettings

from .vlp16_room import (
    HOUR_NS,
    NETWORK_NS,
    T0_NS,
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


def test_time_goes_on_over_the_full_hour() -> None:
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
def test_time_that_cannot_be_trusted_is_said_and_replaced_by_arrival(name: str) -> None:
    clock, code = UNSYNCHRONISED[name]
    truth = room_scans(3, T0_NS + 500_000_000)
    stream = stream_of()
    scans = push(stream, packets_of(truth, clock=clock))
    state = stream.clock.state()
    assert not stream.clock.is_utc and (state.code, state.severity) == (code, "warning")
    late_ns = np.array(stamps(scans), np.int64) - np.array(stamps(truth), np.int64)
    # The packet's length is taken off; what is left is the way through the network, and the counter's step.
    np.testing.assert_allclose(late_ns, NETWORK_NS, atol=1000)


def test_arrivals_that_waited_do_not_shift_stamps() -> None:
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


def test_a_board_that_fakes_gps_is_good_enough() -> None:
    stream = stream_of()
    push(stream, packets_of(room_scans(2), clock=Vlp16Clock(is_valid=False)))
    assert stream.clock.is_utc


def test_without_position_packets_the_sensors_time_is_not_trusted(packets: list[SensorPacket]) -> None:
    stream = stream_of()
    scans = push(stream, only_data(packets))
    assert len(scans) == 5
    assert stream.clock.state().code == "clock.no_position_packets"


def test_position_packets_that_stop_end_the_trust(packets: list[SensorPacket]) -> None:
    stream = stream_of()
    push(stream, packets)
    assert stream.clock.is_utc
    push(stream, only_data(packets_of(room_scans(2, T0_NS + 4 * 10**9))))
    assert stream.clock.state().code == "clock.position_packets_stopped"


def test_the_profile_may_want_the_hosts_time(packets: list[SensorPacket]) -> None:
    stream = stream_of(timestamps=TimestampSettings(reference="first_firing", clock="host"))
    scans = push(stream, packets)
    assert stream.clock.state().code == "clock.host_wanted"
    np.testing.assert_allclose(
        np.array(stamps(scans), np.int64) - np.array(stamps(room_scans(5)), np.int64), NETWORK_NS, atol=1000
    )


def test_packets_without_any_arrival_give_scans_without_stamps(packets: list[SensorPacket]) -> None:
    scans = push(stream_of(), packets, delay_ns=None)
    assert stamps(scans) == [None] * 5
    assert scans[0].host_ns is None
