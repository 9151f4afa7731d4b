"""Packets of a VLP-16 become scans whatever happens to them on the way, and bad ones do not."""

import struct
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.rig.sensors import TimestampSettings
from lce_rig.simulate.vlp16_packets import STREAMED_VLP16, SensorPacket, Vlp16Clock, Vlp16Packets
from lce_rig.sources.velodyne_packet import (
    BadPacketError,
    OtherModelError,
    read_data_packet,
    read_position_packet,
)
from lce_rig.sources.velodyne_points import Vlp16Decoder, keep_brighter
from lce_rig.sources.velodyne_stream import Vlp16Stream

from .vlp16_room import (
    NETWORK_NS,
    PERIOD_NS,
    T0_NS,
    decode_by_manual,
    largest_errors,
    packets_of,
    push,
    room_scan,
    room_scans,
    settings,
)

PACKET_NS = velodyne.packet_ns(is_dual=False)
HOUR_NS = 3600 * 10**9
US_AT, MODE_AT, PRODUCT_AT = 1200, 1204, 1205


def stream_of(**changes: object) -> Vlp16Stream:
    return Vlp16Stream("lidar", settings(**changes))


def only_data(packets: Iterable[SensorPacket]) -> list[SensorPacket]:
    return [packet for packet in packets if packet.port == velodyne.DATA_PORT]


def patched(packet: SensorPacket, at: int, value: bytes) -> SensorPacket:
    return replace(packet, payload=packet.payload[:at] + value + packet.payload[at + len(value) :])


def shifted_us(packet: SensorPacket, us: int) -> SensorPacket:
    (was,) = struct.unpack_from("<I", packet.payload, US_AT)
    return patched(packet, US_AT, struct.pack("<I", (was + us) % velodyne.HOUR_US))


def stamps(scans: Iterable[Scan]) -> list[int | None]:
    return [scan.stamp_ns for scan in scans]


@pytest.fixture(scope="module")
def packets() -> list[SensorPacket]:
    return packets_of(room_scans(5))


@pytest.fixture(scope="module")
def payload(packets: list[SensorPacket]) -> bytes:
    return packets[20].payload


# Decoding


@pytest.mark.parametrize("mode", [velodyne.STRONGEST, velodyne.DUAL])
def test_points_are_those_of_the_manual(mode: int) -> None:
    fields = np.frombuffer(
        b"".join(packet.payload for packet in only_data(packets_of([room_scan(T0_NS)], mode))[:30]),
        velodyne.DATA_PACKET,
    ).copy()
    if mode == velodyne.DUAL:
        keep_brighter(fields)
    starts_ns = [1000 * int(us) for us in fields["us"]]
    batch = Vlp16Decoder(0.1, 200.0).decode(fields, starts_ns)
    manual = decode_by_manual(fields)
    ring_of_laser = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
    np.testing.assert_array_equal(batch.ring, ring_of_laser[manual["laser"]])
    np.testing.assert_array_equal(batch.intensity, manual["reflectivity"])
    time_ns = np.array(starts_ns)[manual["packet"]] + manual["time_ns"] - starts_ns[0]
    assert np.abs(batch.offset_ns - time_ns).max() <= 50
    # The library rounds azimuths to 0.01 deg and takes the mean speed over a packet.
    assert (np.linalg.norm(batch.points - manual["points"], axis=1) / manual["range_m"]).max() < 3e-4


def test_ranges_beyond_the_profiles_limits_give_no_points(packets: list[SensorPacket]) -> None:
    near = push(stream_of(min_range_m=4.0, max_range_m=4.5), packets)[1]
    reach = np.linalg.norm(near.points, axis=1)
    assert 3.98 < reach.min() < 4.02 and 4.48 < reach.max() < 4.52
    assert np.all(np.diff(near.offset_ns) > 0)


def test_of_two_returns_the_brighter_one_is_kept() -> None:
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


def packets_of_dual(front: Scan, behind: Scan) -> list[SensorPacket]:
    sender = Vlp16Packets(velodyne.DUAL)
    return sender.feed(front, behind) + sender.finish()


def test_without_velodyne_decoder_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    with pytest.raises(SourceError, match="velodyne-decoder is not installed") as caught:
        stream_of()
    assert "pip install" in caught.value.hint


# Checks


def damage(payload: bytes, at: int, value: bytes) -> bytes:
    return payload[:at] + value + payload[at + len(value) :]


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [
        (lambda p: p[:-1], "wrong length"),
        (lambda p: p + b"\0", "wrong length"),
        (lambda p: b"", "wrong length"),
        (lambda p: damage(p, 500, b"\xff\xdd"), "block flag"),
        (lambda p: damage(p, 1102, struct.pack("<H", 36000)), "beyond 360 deg"),
        (lambda p: damage(p, 502, struct.pack("<H", 20000)), "uneven azimuths"),
        (lambda p: damage(p, MODE_AT, b"\x39"), "uneven azimuths"),
        (lambda p: damage(p, US_AT, struct.pack("<I", velodyne.HOUR_US)), "beyond the hour"),
        (lambda p: damage(p, MODE_AT, b"\0\0"), "factory bytes"),
        (lambda p: damage(p, PRODUCT_AT, b"\x23"), "factory bytes"),
    ],
)
def test_a_damaged_data_packet_is_refused_with_its_cause(
    spoil: Callable[[bytes], bytes], cause: str, payload: bytes
) -> None:
    read_data_packet(payload, 0)
    with pytest.raises(BadPacketError, match=cause):
        read_data_packet(spoil(payload), 0)


def test_blocks_of_a_rotor_that_stands_still_are_refused(payload: bytes) -> None:
    fields = np.frombuffer(payload, velodyne.DATA_PACKET).copy()
    fields["blocks"]["azimuth"] = 12345
    for mode in (velodyne.STRONGEST, velodyne.DUAL):
        fields["mode"] = mode
        with pytest.raises(BadPacketError, match="uneven azimuths"):
            read_data_packet(fields.tobytes(), 0)


@pytest.mark.parametrize(("product", "name"), sorted(velodyne.PRODUCTS.items()))
def test_other_velodynes_are_refused_by_name(product: int, name: str, payload: bytes) -> None:
    other = damage(payload, PRODUCT_AT, bytes([product]))
    if name == "VLP-16":
        assert read_data_packet(other, 0).mode == velodyne.STRONGEST
        return
    with pytest.raises(OtherModelError, match=name):
        read_data_packet(other, 0)


@given(st.binary(max_size=600))
def test_whatever_comes_as_a_position_packet_is_read_or_refused(payload: bytes) -> None:
    for body in (payload, payload.ljust(velodyne.POSITION_BYTES, b"\0")[: velodyne.POSITION_BYTES]):
        try:
            read = read_position_packet(body, 1)
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
def test_only_sound_sentences_tell_the_time(sentence: bytes, second: int | None) -> None:
    body = bytearray(velodyne.POSITION_BYTES)
    body[0xCE : 0xCE + len(sentence)] = sentence
    assert read_position_packet(bytes(body), 0).nmea_s == second


# Order and losses


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
    assert stream.counts.n_partial == 2
    assert stream.counts.order.n_lost == 0


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
    assert stream.counts.order.n_lost == len(only_data(packets)) - len(only_data(kept))
    assert len(scans) == 5
    share = sum(len(s.points) for s in scans) / sum(len(s.points) for s in room_scans(5))
    assert share == pytest.approx(len(only_data(kept)) / len(only_data(packets)), abs=0.01)


def test_a_scan_of_which_more_than_half_is_lost_is_left_out(packets: list[SensorPacket]) -> None:
    gap = slice(90, 135)
    stream = stream_of()
    scans = push(stream, packets[: gap.start] + packets[gap.stop :])
    assert (len(scans), stream.counts.n_thin) == (4, 1)
    assert stream.counts.order.n_lost == len(only_data(packets[gap]))


def test_packets_sent_twice_or_late_change_nothing(packets: list[SensorPacket]) -> None:
    arrived = list(packets)
    arrived.insert(50, packets[40])
    arrived.insert(200, packets[198])
    stream = stream_of()
    scans = push(stream, arrived)
    assert stream.counts.order.n_late == 2
    for truth, scan in zip(room_scans(5), scans, strict=True):
        assert len(scan.points) == len(truth.points)


@pytest.mark.parametrize("us", [700, -700, 40_000, -40_000, 700_000, 1_800_000_000])
def test_a_damaged_time_costs_its_packet_only(us: int, packets: list[SensorPacket]) -> None:
    arrived = list(packets)
    arrived[100] = shifted_us(arrived[100], us)
    stream = stream_of()
    scans = push(stream, arrived)
    order = stream.counts.order
    assert (order.n_late + order.n_astray, order.n_lost, order.n_steps) == (1, 1, 0)
    n_points = [len(scan.points) for scan in scans]
    assert len(scans) == 5 and sum(n_points) == pytest.approx(
        sum(len(s.points) for s in room_scans(5)) - 346, abs=20
    )


@pytest.mark.parametrize("shift_us", [500_000, -700_000_000])
def test_a_sensor_whose_clock_is_set_loses_one_revolution(shift_us: int) -> None:
    before = packets_of(room_scans(3), clock=Vlp16Clock(error_us=shift_us, pps="absent"))
    after = packets_of(room_scans(6))
    at = 140
    stream = stream_of()
    scans = push(stream, before[:at] + after[at:])
    assert stream.counts.order.n_steps == 1
    assert len(scans) == 5
    assert stream.counts.n_partial == 1
    for stamp_ns in stamps(scans):
        assert min(abs(int(stamp_ns or 0) - int(s.stamp_ns or 0)) for s in room_scans(6)) < 1_000_000


def test_a_change_to_dual_returns_is_followed(packets: list[SensorPacket]) -> None:
    dual = packets_of(room_scans(3, T0_NS + 5 * PERIOD_NS), velodyne.DUAL)
    stream = stream_of()
    scans = push(stream, [*packets[:-2], *dual])
    # Of the revolutions before and after, one packet each is missing.
    assert stream.mode == velodyne.DUAL and len(scans) == 8 - 2


# Time


def test_time_goes_on_over_the_full_hour() -> None:
    truth = room_scans(6, T0_NS - T0_NS % HOUR_NS + HOUR_NS - 250_000_000)
    stream = stream_of()
    scans = push(stream, packets_of(truth))
    assert stream.clock.state().is_device
    assert np.abs(np.array(stamps(scans), np.int64) - np.array(stamps(truth), np.int64)).max() < 1000
    assert stream.counts.order.n_lost == 0


UNSYNCHRONISED = {
    "absent": (Vlp16Clock("absent", has_nmea=False, error_us=721_000_000), "PPS is absent"),
    "synchronising": (Vlp16Clock("synchronising"), "PPS is synchronising"),
    "in error": (Vlp16Clock("error"), "PPS is error"),
    "without sentences": (Vlp16Clock(has_nmea=False), "no NMEA"),
    "of another second": (Vlp16Clock(error_us=721_000_000), "NMEA says 13:"),
    "of another clock": (Vlp16Clock(error_us=-368_000), "the LiDAR's UTC is -0.37 s"),
}


@pytest.mark.parametrize("name", sorted(UNSYNCHRONISED))
def test_time_that_cannot_be_trusted_is_said_and_replaced_by_arrival(name: str) -> None:
    clock, cause = UNSYNCHRONISED[name]
    truth = room_scans(3, T0_NS + 500_000_000)
    stream = stream_of()
    scans = push(stream, packets_of(truth, clock=clock))
    state = stream.clock.state()
    assert not state.is_device and cause in state.text and state.remedy
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
    assert stream.clock.state().is_device


def test_without_position_packets_the_sensors_time_is_not_trusted(packets: list[SensorPacket]) -> None:
    stream = stream_of()
    scans = push(stream, only_data(packets))
    assert len(scans) == 5
    assert "no position packets" in stream.clock.state().text


def test_position_packets_that_stop_end_the_trust(packets: list[SensorPacket]) -> None:
    stream = stream_of()
    push(stream, packets)
    assert stream.clock.state().is_device
    push(stream, only_data(packets_of(room_scans(2, T0_NS + 4 * 10**9))))
    assert "position packets have stopped" in stream.clock.state().text


def test_the_profile_may_want_the_hosts_time(packets: list[SensorPacket]) -> None:
    stream = stream_of(timestamps=TimestampSettings(reference="first_firing", clock="host"))
    scans = push(stream, packets)
    assert "the profile says so" in stream.clock.state().text
    np.testing.assert_allclose(
        np.array(stamps(scans), np.int64) - np.array(stamps(room_scans(5)), np.int64), NETWORK_NS, atol=1000
    )


def test_packets_without_any_arrival_give_scans_without_stamps(packets: list[SensorPacket]) -> None:
    scans = push(stream_of(), packets, delay_ns=None)
    assert stamps(scans) == [None] * 5
    assert scans[0].host_ns is None


# Anything at all


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
    assert n_scans == 10 and stream.counts.bad.total() > 20


# Recordings by others


def einride(recordings: Path) -> np.ndarray:
    return np.fromfile(recordings / "vlp16_packets" / "einride" / "recording.bin", velodyne.DATA_PACKET)


@pytest.mark.dataset
def test_every_point_of_the_einride_payloads_is_that_of_the_manual(recordings: Path) -> None:
    fields = einride(recordings)
    batch = Vlp16Decoder(0.0, 200.0).decode(fields, [1000 * int(us) for us in fields["us"]])
    manual = decode_by_manual(fields)
    assert (
        len(batch.points) == len(manual["points"]) == np.count_nonzero(fields["blocks"]["returns"]["range"])
    )
    off = np.linalg.norm(batch.points - manual["points"], axis=1) / manual["range_m"]
    assert off.max() < 4.5e-4  # 0.025 deg


@pytest.mark.dataset
def test_the_einride_payloads_make_whole_scans_without_a_loss(recordings: Path) -> None:
    stream = stream_of()
    fields = einride(recordings)
    scans = [scan for packet in fields if (scan := stream.push_data(packet.tobytes(), 0)) is not None]
    assert (len(scans), stream.counts.order.n_lost, stream.counts.bad.total()) == (13, 0, 0)


def nebula_packets(recordings: Path) -> list[tuple[int, bytes]]:
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    packet = "builtin_interfaces/Time stamp\nuint8[1206] data"
    scan = "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets"
    store.register(
        get_types_from_msg(packet, "velodyne_msgs/msg/VelodynePacket")
        | get_types_from_msg(scan, "velodyne_msgs/msg/VelodyneScan")
    )
    with Reader(recordings / "vlp16_packets" / "nebula" / "vlp16" / "1673400471837873222") as reader:
        messages = [store.deserialize_cdr(raw, c.msgtype) for c, _, raw in reader.messages()]
    return [
        (p.stamp.sec * 10**9 + p.stamp.nanosec, bytes(p.data))
        for message in messages
        for p in message.packets
    ]


@pytest.mark.dataset
def test_every_point_of_nebulas_packets_is_that_of_the_manual(recordings: Path) -> None:
    fields = np.frombuffer(b"".join(p for _, p in nebula_packets(recordings)), velodyne.DATA_PACKET).copy()
    keep_brighter(fields)
    batch = Vlp16Decoder(0.0, 200.0).decode(fields, [1000 * int(us) for us in fields["us"]])
    manual = decode_by_manual(fields)
    order = np.argsort(manual["packet"] * 10**7 + manual["time_ns"])
    assert len(batch.points) == len(order) == 58_706
    off = np.linalg.norm(batch.points - manual["points"][order], axis=1) / manual["range_m"][order]
    assert off.max() < 4.5e-4  # 0.025 deg


@pytest.mark.dataset
def test_every_point_of_nebulas_reference_cloud_is_that_of_the_manual(recordings: Path) -> None:
    from lce_rig.sources.cloud_file import read_cloud

    reference = read_cloud(recordings / "vlp16_packets" / "nebula" / "vlp16" / "1673400472138016708.pcd")
    fields = np.frombuffer(b"".join(p for _, p in nebula_packets(recordings)), velodyne.DATA_PACKET)[-170:]
    manual = decode_by_manual(fields)
    ring = np.argsort(np.argsort(STREAMED_VLP16.elevations_rad))[manual["laser"]]
    # Of a packet's last firings nebula leaves the azimuth as it was at the block's beginning.
    is_last = manual["time_ns"] >= 5 * velodyne.BLOCK_NS
    block_deg = fields["blocks"]["azimuth"][manual["packet"][is_last], 10] / 100
    azimuth_deg = manual["azimuth_deg"].copy()
    azimuth_deg[is_last] = block_deg
    counts = np.rint(manual["range_m"] / velodyne.RANGE_STEP_M)
    # Nebula leaves the vertical offsets out, too.
    reach = np.sqrt(sum(reference[axis].astype(float) ** 2 for axis in "xyz"))
    assert np.abs(reach - reference["distance"]).max() < 1e-5
    seen_deg = np.degrees(np.arctan2(-reference["y"], reference["x"]))
    off_deg = []
    for channel, count, seen in zip(
        reference["channel"], np.rint(reach / velodyne.RANGE_STEP_M), seen_deg, strict=True
    ):
        candidates = azimuth_deg[(ring == channel) & (counts == count)]
        off_deg.append(np.abs((candidates - seen + 180) % 360 - 180).min())
    assert len(off_deg) == 14_831
    # Where two returns differ, nebula turns the strongest on by up to a block, with the last of a packet.
    is_off = np.array(off_deg) > 0.011
    assert is_off.sum() == 166
    assert max(off_deg) < 0.41


@pytest.mark.dataset
def test_nebulas_recording_was_not_synchronised_and_is_stamped_by_arrival(recordings: Path) -> None:
    stream = stream_of()
    sent = nebula_packets(recordings)
    scans = [scan for host_ns, body in sent if (scan := stream.push_data(body, host_ns)) is not None]
    assert stream.mode == velodyne.DUAL and len(scans) == 3
    assert not stream.clock.state().is_device
    ahead_ns = stream.clock.ahead_ns()
    assert ahead_ns is not None and ahead_ns * 1e-9 == pytest.approx(-1531.18, abs=0.01)
    assert all(sent[0][0] < int(stamp_ns or 0) < sent[-1][0] for stamp_ns in stamps(scans))
