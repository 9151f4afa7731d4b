"""Points of a VLP-16 are those of the manual."""

from dataclasses import replace

import numpy as np
import pytest
from wire.vlp16_packets import SensorPacket, Vlp16Packets

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.io.velodyne.stream import Vlp16Decoder, keep_brighter

from .vlp16_room import (
    T0_NS,
    decode_by_manual,
    only_data,
    packets_of,
    push,
    room_scan,
    room_scans,
    stream_of,
)


@pytest.fixture(scope="module")
def packets() -> list[SensorPacket]:
    return packets_of(room_scans(5))


@pytest.mark.parametrize("mode", [velodyne.STRONGEST, velodyne.DUAL])
def test_points_are_those_of_the_manual(mode: int) -> None:
    fields = np.frombuffer(
        b"".join(packet.payload for packet in only_data(packets_of([room_scan(T0_NS)], mode))[:30]),
        velodyne.DATA_PACKET,
    ).copy()
    if mode == velodyne.DUAL:
        keep_brighter(fields)
    starts_ns = [1000 * int(us) for us in fields["us"]]
    points, intensity, ring, offset_ns = Vlp16Decoder(0.1, 200.0).decode(fields, starts_ns)
    manual = decode_by_manual(fields)
    ring_of_laser = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
    np.testing.assert_array_equal(ring, ring_of_laser[manual["laser"]])
    np.testing.assert_array_equal(intensity, manual["reflectivity"])
    time_ns = np.array(starts_ns)[manual["packet"]] + manual["time_ns"] - starts_ns[0]
    assert np.abs(offset_ns - time_ns).max() <= 50
    # The library rounds azimuths to 0.01 deg and takes the mean speed over a packet.
    assert (np.linalg.norm(points - manual["points"], axis=1) / manual["range_m"]).max() < 3e-4


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
