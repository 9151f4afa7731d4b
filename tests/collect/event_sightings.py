"""Sightings of a board on a given way before an event camera, and its stream; no picture is drawn."""

import numpy as np

from lce_rig.collect.board_tracker import BoardDetection
from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.timing.scan_pairing import AFTER_NS, BEFORE_NS, EventBuffer, Frame
from tests.calibrate.boards import measured_plate

T0_NS = 1_700_000_000 * 10**9
S = 10**9
_SCAN_S = 0.1
# Columns and rows that a board three metres away may cover on the ways that the tests let it go.
_LEFT, _RIGHT, _TOP, _BOTTOM = 30, 316, 60, 200


def event_stream(rates_px_s, seed=0, lamp_hz=0.0):
    """Events of (from s, to s, events a second and pixel), cut into packets.

    With `lamp_hz` all pixels turn brighter, then darker, so often a second.
    """
    rng = np.random.default_rng(seed)
    packets = []
    for begin_s, end_s, rate in rates_px_s:
        n = round(rate * (end_s - begin_s) * (_RIGHT - _LEFT) * (_BOTTOM - _TOP))
        t_s = np.sort(rng.uniform(begin_s, end_s, n))
        polarity = rng.random(n) < 0.5
        if lamp_hz:
            polarity = np.floor(t_s * 2 * lamp_hz) % 2 < 1
        t_ns = T0_NS + np.rint(t_s * 1e6).astype(np.int64) * 1000
        x, y = rng.integers(_LEFT, _RIGHT, n), rng.integers(_TOP, _BOTTOM, n)
        whole = Events("davis", t_ns, x.astype(np.uint16), y.astype(np.uint16), polarity, 346, 260)
        edges = range(0, n, max(1, n // 20))
        packets += [whole.select(slice(k, k + max(1, n // 20))) for k in edges]
    return packets


def watch(rig, way, duration_s, stream, *, channel="frames", is_seen=lambda _time_s: True, has_lidar=True):
    """Sight a board at (x, y) m, three metres away, once a scan; the middle of the first sweep is 0.05 s."""
    buffer = EventBuffer(rig)
    for packet in stream:
        if len(packet):
            buffer.add(packet)
    found = []
    for k in range(round(duration_s / _SCAN_S)):
        time_s = (k + 0.5) * _SCAN_S
        time_ns, half_ns = T0_NS + round(time_s * S), round(_SCAN_S * S / 2)
        pixels = np.zeros((260, 346), np.uint8)
        images = (Image("davis", channel, time_ns, pixels),)
        column = np.zeros(1, np.float32)
        scan = Scan("lidar", time_ns - half_ns, np.ones((1, 3), np.float32), column, np.zeros(1, np.int16))
        events = buffer.cut(time_ns - half_ns - BEFORE_NS, time_ns + half_ns + AFTER_NS)
        boards = {("davis", channel): board_at(*way(time_s))} if is_seen(time_s) else {}
        lidars = {"lidar": [plate()]} if boards and has_lidar else {}
        found.append(BoardDetection(Frame(time_ns, images, (scan,), events), boards, lidars))
    return found


def board_at(x_m, y_m):
    """A board that faces the camera."""
    T_cam_board = np.diag([1.0, -1.0, -1.0, 1.0])
    T_cam_board[:3, 3] = x_m, y_m, 3.0
    return ImageBoard(T_cam_board, np.eye(6) * 1e-6, None, np.inf, np.zeros((54, 2)), 0.1, 0.1)


def plate():
    """What a scan shows of it; only that there is something counts."""
    none, nothing = np.zeros((0, 3)), np.zeros(0)
    ring, side = np.zeros(0, np.int16), np.zeros(0, np.int8)
    plane = np.array([0, 0, 1.0, -3.0])
    quality = measured_plate(0.8, 0.6, none)
    return LidarBoard(none, plane, np.eye(4), ring, none, ring, side, nothing, nothing, 0.003, 0.01, quality)
