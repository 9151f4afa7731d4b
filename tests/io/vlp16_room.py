"""A round room as a VLP-16 sees it, made without ray casting, and a decoder written from the manual alone."""

from collections.abc import Iterable

import numpy as np
from wire.vlp16_packets import STREAMED_VLP16, SensorPacket, Vlp16Clock, Vlp16Packets

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.io.velodyne.stream import Vlp16Stream
from lce_rig.rig import LidarSettings, load_rig

PERIOD_NS = STREAMED_VLP16.period_ns
#: 14 November 2023, 22:13:20 UTC.
T0_NS = 1_700_000_000_000_000_000
NETWORK_NS = 120_000
HOUR_NS = 3600 * 10**9


def settings(**changes: object) -> LidarSettings:
    return load_rig("rles").lidars["lidar"].model_copy(update=changes)


def room_scan(stamp_ns: int, *, scale: float = 1.0, phase: float = 0.25, dropout: float = 0.1) -> Scan:
    """One revolution in a wavy round room, on the grid of firings, with a tenth of the returns missing."""
    n_sequences = PERIOD_NS // velodyne.SEQUENCE_NS
    sequence, laser = np.divmod(np.arange(n_sequences * velodyne.N_LASERS), velodyne.N_LASERS)
    offset_ns = sequence * velodyne.SEQUENCE_NS + laser * velodyne.FIRING_NS
    azimuth = np.pi - phase * STREAMED_VLP16.step_rad - 2 * np.pi * offset_ns / PERIOD_NS
    elevation = STREAMED_VLP16.elevations_rad[laser]
    reach = scale * (4 + np.sin(3 * azimuth)) / np.cos(elevation)
    points = reach[:, None] * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    points[:, 2] += STREAMED_VLP16.vertical_offsets_m[laser]
    keep = np.random.default_rng(stamp_ns % 1000).random(len(points)) >= dropout
    # The first firing always returns: its time is the scan's stamp.
    keep[0] = True
    return Scan(
        "lidar",
        stamp_ns,
        points[keep].astype(np.float32),
        (laser[keep] * 5.0 + 10.0).astype(np.float32),
        STREAMED_VLP16.rings[laser[keep]],
        offset_ns[keep],
        stamp_ns + PERIOD_NS,
    )


def room_scans(n: int, start_ns: int = T0_NS) -> list[Scan]:
    return [room_scan(start_ns + k * PERIOD_NS) for k in range(n)]


def packets_of(
    scans: Iterable[Scan], mode: int = velodyne.STRONGEST, clock: Vlp16Clock | None = None
) -> list[SensorPacket]:
    sender = Vlp16Packets(mode, clock)
    return [packet for scan in scans for packet in sender.feed(scan)] + sender.finish()


def push(
    stream: Vlp16Stream, packets: Iterable[SensorPacket], delay_ns: int | None = NETWORK_NS
) -> list[Scan]:
    """Feed packets as they would arrive, then end the stream; without a delay arrivals are unknown."""
    scans = []
    for packet in packets:
        host_ns = 0 if delay_ns is None else packet.sent_ns + delay_ns
        if packet.port == velodyne.POSITION_PORT:
            stream.push_position(packet.payload)
        elif (scan := stream.push_data(packet.payload, host_ns)) is not None:
            scans.append(scan)
    last = stream.finish()
    return scans if last is None else [*scans, last]


def stream_of(**changes: object) -> Vlp16Stream:
    return Vlp16Stream("lidar", settings(**changes))


def only_data(packets: Iterable[SensorPacket]) -> list[SensorPacket]:
    return [packet for packet in packets if packet.port == velodyne.DATA_PORT]


def stamps(scans: Iterable[Scan]) -> list[int | None]:
    return [scan.stamp_ns for scan in scans]


def largest_errors(truth: Scan, decoded: Scan) -> tuple[float, float]:
    """Largest error along the ray in m, and across it in rad; the scans have the same points."""
    np.testing.assert_array_equal(truth.ring, decoded.ring)
    centre = np.zeros((len(truth.points), 3))
    centre[:, 2] = np.sort(STREAMED_VLP16.vertical_offsets_m)[::-1][truth.ring]
    a, b = truth.points - centre, decoded.points - centre
    range_a, range_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    across = np.linalg.norm(a / range_a[:, None] - b / range_b[:, None], axis=1)
    return float(np.abs(range_a - range_b).max()), float(across.max())


def decode_by_manual(fields: np.ndarray) -> dict[str, np.ndarray]:
    """Decode data packets (P,) as the manual says (chapter 9, appendix A), interpolating block by block.

    Returns:
        points (N, 3) m in the lidar frame, range_m, reflectivity, laser, azimuth_deg, packet (N,) and
        time_ns (N,) after each packet's stamp.
    """
    elevation = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
    height = 1e-3 * np.array(
        [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]
    )
    out: dict[str, list[np.ndarray]] = {}
    for number, packet in enumerate(fields):
        stride = 2 if packet["mode"] == 0x39 else 1
        azimuth = packet["blocks"]["azimuth"].astype(float) / 100
        gaps = (azimuth[stride::stride] - azimuth[:-stride:stride]) % 360
        for block in range(12):
            firing = block // stride
            gap = gaps[min(firing, len(gaps) - 1)]
            for channel in range(32):
                count, reflectivity = packet["blocks"]["returns"][block][channel]
                if count == 0:
                    continue
                laser = channel % 16
                within_us = 55.296 * (channel // 16) + 2.304 * laser
                angle_deg = (azimuth[block] + gap * within_us / 110.592) % 360
                angle, reach = np.radians(angle_deg), 0.002 * count
                point = [
                    reach * np.cos(elevation[laser]) * np.cos(angle),
                    -reach * np.cos(elevation[laser]) * np.sin(angle),
                    reach * np.sin(elevation[laser]) + height[laser],
                ]
                row = {
                    "points": point, "range_m": reach, "reflectivity": reflectivity, "laser": laser,
                    "azimuth_deg": angle_deg, "packet": number,
                    "time_ns": 110_592 * firing + round(1000 * within_us),
                }  # fmt: skip
                for key, value in row.items():
                    out.setdefault(key, []).append(np.asarray(value))
    return {key: np.array(values) for key, values in out.items()}
