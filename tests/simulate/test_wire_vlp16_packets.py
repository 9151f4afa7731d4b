"""Simulated packets carry what was simulated, as a VLP-16 would send it."""

import numpy as np
import pytest
from wire.vlp16_packets import STREAMED_VLP16, Vlp16Packets

from lce_rig.core import velodyne
from lce_rig.core.board import Board
from lce_rig.core.data import Scan
from lce_rig.core.geometry import Array
from lce_rig.io.velodyne.packet import read_data_packet
from lce_rig.io.velodyne.stream import Vlp16Stream
from lce_rig.simulate.options import LidarNoise
from lce_rig.simulate.room import Room, build_carrier
from lce_rig.simulate.scene import Scene
from tests.io.vlp16_room import (
    T0_NS,
    largest_errors,
    packets_of,
    push,
    room_scan,
    room_scans,
    settings,
)

from .conftest import board_before_lidar, simulate_scan

HALF_RANGE_STEP_M = 0.001
# A block's azimuth is rounded in the packet, each point's once more on decoding.
AZIMUTH_ERROR_RAD = np.radians(0.0101)


@pytest.fixture(scope="module")
def scans(room: Room, board: Board, T_world_lidar: Array) -> list[Scan]:
    """Two revolutions of free phase, with all noise."""
    T = board_before_lidar(2.2)
    scene = Scene(room.raycaster, build_carrier("person", board, T, np.random.default_rng(3)), board, T)
    rng = np.random.default_rng(1)
    return [
        simulate_scan(
            scene, T_world_lidar, STREAMED_VLP16, LidarNoise(), rng,
            stamp_ns=T0_NS + k * STREAMED_VLP16.period_ns,
        )
        for k in range(2)
    ]  # fmt: skip


@pytest.mark.parametrize("mode", [velodyne.STRONGEST, velodyne.LAST, velodyne.DUAL])
def test_a_simulated_scan_comes_back_within_the_steps_of_range_and_azimuth(
    mode: int, scans: list[Scan]
) -> None:
    decoded = push(Vlp16Stream("lidar", settings()), packets_of(scans, mode))
    assert len(decoded) == len(scans)
    for k, (truth, scan) in enumerate(zip(scans, decoded, strict=True)):
        assert truth.offset_ns is not None and scan.offset_ns is not None and scan.stamp_ns is not None
        assert len(scan.points) == len(truth.points) > 25_000
        np.testing.assert_array_equal(scan.intensity, truth.intensity)
        assert abs(scan.stamp_ns - int(truth.stamp_ns or 0)) <= 1000
        assert np.abs(scan.offset_ns - truth.offset_ns).max() <= 1000
        # Phases are drawn scan by scan; a rotor cannot jump, and catches up within 12 degrees of the cut.
        is_eased = (truth.offset_ns < 30 * velodyne.BLOCK_NS) & (k > 0)
        along_m, across_rad = largest_errors(truth.select(~is_eased), scan.select(~is_eased))
        assert along_m <= HALF_RANGE_STEP_M * 1.01
        assert across_rad <= AZIMUTH_ERROR_RAD
        if is_eased.any():
            assert largest_errors(truth.select(is_eased), scan.select(is_eased))[1] < np.radians(0.21)


def test_packets_leave_at_the_rate_of_a_vlp16_and_pass_every_check() -> None:
    packets = packets_of(room_scans(10))
    data = [packet for packet in packets if packet.port == velodyne.DATA_PORT]
    duration_s = 10 * STREAMED_VLP16.period_ns * 1e-9
    assert len(data) / duration_s == pytest.approx(753.5, abs=1)
    times_us = [read_data_packet(packet.payload, packet.sent_ns).us for packet in data]
    assert set(np.diff(times_us)) == {1327, 1328}
    leaves_us = np.diff([packet.sent_ns for packet in data]) / 1000
    np.testing.assert_allclose(leaves_us, 1327.104, atol=0.001)


def test_a_scan_after_a_break_begins_a_packet_of_its_own() -> None:
    later = room_scan(T0_NS + 3_000_000_000)
    sender = Vlp16Packets()
    packets = sender.feed(room_scan(T0_NS)) + sender.feed(later) + sender.finish()
    starts_us = {
        read_data_packet(packet.payload, 0).us for packet in packets if packet.port == velodyne.DATA_PORT
    }
    assert int(later.stamp_ns or 0) // 1000 % velodyne.HOUR_US in starts_us
    stream = Vlp16Stream("lidar", settings())
    assert len(push(stream, packets)) == 2
    assert stream.flaws() == []
