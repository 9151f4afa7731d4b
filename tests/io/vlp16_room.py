"""A round room as a VLP-16 sees it, made without ray casting."""

import numpy as np
from wire.vlp16_packets import STREAMED_VLP16, Vlp16Packets

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.io.velodyne_scans import Vlp16Stream
from lce_rig.rig import load_rig

PERIOD_NS = STREAMED_VLP16.period_ns
#: 14 November 2023, 22:13:20 UTC.
T0_NS = 1_700_000_000_000_000_000
NETWORK_NS = 120_000
HOUR_NS = 3600 * 10**9


def settings(**changes):
    return load_rig("rles").lidars["lidar"].model_copy(update=changes)


def room_scan(stamp_ns, *, scale=1.0, phase=0.25, dropout=0.1):
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


def room_scans(n, start_ns=T0_NS):
    return [room_scan(start_ns + k * PERIOD_NS) for k in range(n)]


def packets_of(scans, mode=velodyne.STRONGEST, clock=None):
    sender = Vlp16Packets(mode, clock)
    return [packet for scan in scans for packet in sender.feed(scan)] + sender.finish()


def push(stream, packets, delay_ns=NETWORK_NS):
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


def stream_of(**changes):
    return Vlp16Stream("lidar", settings(**changes))


def only_data(packets):
    return [packet for packet in packets if packet.port == velodyne.DATA_PORT]


def stamps(scans):
    return [scan.stamp_ns for scan in scans]


def largest_errors(truth, decoded):
    """Largest error along the ray in m, and across it in rad; the scans have the same points."""
    np.testing.assert_array_equal(truth.ring, decoded.ring)
    centre = np.zeros((len(truth.points), 3))
    centre[:, 2] = np.sort(STREAMED_VLP16.vertical_offsets_m)[::-1][truth.ring]
    a, b = truth.points - centre, decoded.points - centre
    range_a, range_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    across = np.linalg.norm(a / range_a[:, None] - b / range_b[:, None], axis=1)
    return float(np.abs(range_a - range_b).max()), float(across.max())
