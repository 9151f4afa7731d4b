"""Damaged packets of a VLP-16: none may crash the receiver, and no point may come of what was not sent.

Scans are judged by code that shares nothing with the decoder: each point must be a return of a packet, at the
place and time where the rotor was then. Ranges carry no check; where they are damaged, the damaged ones count
as sent.
"""

import resource
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.io.velodyne.stream import Vlp16Stream
from lce_rig.rig import LidarSettings

Mutation = Callable[[bytearray, np.random.Generator], bytes]
_N_PACKETS = 226
_START_NS = 1_700_000_000_000_000_000
_DELAY_NS = 1_500_000
_PACKET_NS = velodyne.READ[0].packet_ns(is_dual=False)
_RETURN_SHARE = 0.15
# What the checks let pass, as it does not matter: 0.2 deg where several packets before were lost, and 0.1 ms
# of a packet's time, twice where it is also the one that tells the host's time.
_MAX_OFF_NS = 203_000
_MAX_OFF_RAD = np.radians(0.25)
_ELEVATION_RAD = np.radians([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15])
_RING = np.array([0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15])
_MAX_ALIKE = 200
_HEIGHT_M = 1e-3 * np.array(
    [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]
)


@dataclass
class PacketReport:
    """What became of damaged packets.

    Attributes:
        n_damaged: damaged packets fed, beside as many sound ones.
        n_scans: scans made of both.
        n_points: points in them.
        n_wrong: points that nobody sent.
        refused: packets left out, by reason.
        grown_bytes: by how much the process grew after the first tenth.
        packets_per_s: speed, the judging included.
    """

    n_damaged: int = 0
    n_scans: int = 0
    n_points: int = 0
    n_wrong: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    grown_bytes: int = 0
    packets_per_s: float = 0.0


def fuzz_packets(n_damaged: int, seed: int) -> PacketReport:
    """Feed damaged data and position packets between sound ones, and judge every scan.

    Args:
        n_damaged: how many are damaged.
        seed: same seed, same packets.
    """
    rng = np.random.default_rng(seed)
    report, began_s, early_bytes = PacketReport(), time.perf_counter(), 0
    settings = LidarSettings(min_range_m=0.1, max_range_m=140.0)
    stream, positions = Vlp16Stream("lidar", settings), Vlp16Stream("lidar", settings)
    sent: list[tuple[int, np.void]] = []
    first = 0
    while report.n_damaged < n_damaged:
        for index, packet in enumerate(_sound_packets(first, rng), start=first):
            start_ns = _START_NS + index * _PACKET_NS
            payload = packet.tobytes()
            if rng.random() < 0.5:
                payload = _damaged(payload, rng)
                report.n_damaged += 1
                positions.push_position(payload[: velodyne.POSITION_BYTES], start_ns)
            if (kept := _as_sent(payload, packet)) is not None:
                sent.append((start_ns, kept))
            scan = stream.push_data(payload, start_ns + _PACKET_NS + _DELAY_NS)
            if scan is not None:
                report.n_scans += 1
                report.n_points += len(scan.points)
                report.n_wrong += _count_wrong(scan, sent)
                sent = sent[-2:]
        first += _N_PACKETS
        if not early_bytes and report.n_damaged > n_damaged // 10:
            early_bytes = _resident_bytes()
    report.grown_bytes = _resident_bytes() - early_bytes
    report.packets_per_s = first / (time.perf_counter() - began_s)
    stream.losses.update(positions.losses)
    report.refused = Counter(stream.losses.by_code())
    return report


def _sound_packets(first: int, rng: np.random.Generator) -> np.ndarray:
    """Make three revolutions' packets of a rotor that turns evenly, with returns here and there."""
    packets = np.zeros(_N_PACKETS, velodyne.DATA_PACKET)
    block = (first + np.arange(_N_PACKETS))[:, None] * velodyne.N_BLOCKS + np.arange(velodyne.N_BLOCKS)
    packets["blocks"]["flag"] = velodyne.BLOCK_FLAG
    packets["blocks"]["azimuth"] = (block * 40) % velodyne.AZIMUTH_STEPS
    shape = (_N_PACKETS, velodyne.N_BLOCKS, 2 * velodyne.N_LASERS)
    ranges = rng.integers(200, 60_000, shape)
    packets["blocks"]["returns"]["range"] = np.where(rng.random(shape) < _RETURN_SHARE, ranges, 0)
    starts_ns = _START_NS + (first + np.arange(_N_PACKETS)) * _PACKET_NS
    packets["us"] = starts_ns // 1000 % velodyne.HOUR_US
    packets["mode"], packets["product"] = velodyne.STRONGEST, velodyne.VLP16
    return packets


def _as_sent(payload: bytes, original: np.void) -> np.void | None:
    """Give the packet with what may have changed unnoticed; None where it must have been refused."""
    if len(payload) != velodyne.DATA_BYTES:
        return None
    kept = original.copy()
    kept["blocks"]["returns"] = np.frombuffer(payload, velodyne.DATA_PACKET)[0]["blocks"]["returns"]
    return kept


def _count_wrong(scan: Scan, sent: list[tuple[int, np.void]]) -> int:
    """Count the points that no packet explains."""
    if scan.stamp_ns is None or scan.offset_ns is None or not np.isfinite(scan.points).all():
        return max(1, len(scan.points))
    starts_ns = np.array([start_ns for start_ns, _ in sent])
    blocks = np.array([packet["blocks"] for _, packet in sent])
    number, block, channel = np.nonzero(blocks["returns"]["range"])
    laser = channel % velodyne.N_LASERS
    within_ns = velodyne.SEQUENCE_NS * (channel // velodyne.N_LASERS) + velodyne.FIRING_NS * laser
    time_ns = starts_ns[number] + velodyne.BLOCK_NS * block + within_ns
    angle = np.radians((blocks["azimuth"][number, block] + 40 * within_ns / velodyne.BLOCK_NS) / 100)
    reach = velodyne.RANGE_STEP_M * blocks["returns"]["range"][number, block, channel].astype(float)
    flat, up = reach * np.cos(_ELEVATION_RAD[laser]), reach * np.sin(_ELEVATION_RAD[laser])
    points = np.stack([flat * np.cos(angle), -flat * np.sin(angle), up + _HEIGHT_M[laser]], axis=1)
    # By arrival a point is stamped late by what the network takes, here always the same.
    wanted_ns = scan.stamp_ns + scan.offset_ns - _DELAY_NS
    height_m = np.sort(_HEIGHT_M)[::-1][scan.ring]
    seen = np.linalg.norm(scan.points - np.stack([0 * height_m, 0 * height_m, height_m], axis=1), axis=1)
    key = _key(_RING[laser], reach)
    order = np.argsort(key)
    at = np.searchsorted(key[order], _key(scan.ring, seen))
    # Few returns share ring and range, but for some that damage made: one of them must be the point's.
    is_open = np.ones(len(seen), dtype=bool)
    for _ in range(_MAX_ALIKE):
        if not is_open.any():
            break
        candidate = order[np.minimum(at, len(order) - 1)]
        off_m = np.linalg.norm(points[candidate] - scan.points, axis=1)
        is_right = off_m < _MAX_OFF_RAD * seen + 0.005
        is_open &= ~(is_right & (np.abs(time_ns[candidate] - wanted_ns) < _MAX_OFF_NS))
        at += 1
    return int(is_open.sum())


def _key(ring: np.ndarray, reach_m: np.ndarray) -> np.ndarray:
    return ring.astype(np.int64) * 100_000 + np.rint(reach_m / velodyne.RANGE_STEP_M).astype(np.int64)


def _resident_bytes() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _damaged(payload: bytes, rng: np.random.Generator) -> bytes:
    data = payload
    for _ in range(int(rng.integers(1, 4))):
        data = _MUTATIONS[int(rng.integers(len(_MUTATIONS)))](bytearray(data), rng)
    return data


def _place(data: bytearray, rng: np.random.Generator) -> int:
    return int(rng.integers(max(len(data), 1)))


def _flip_bit(data: bytearray, rng: np.random.Generator) -> bytes:
    if data:
        data[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(data)


def _replace_bytes(data: bytearray, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    n = len(data[at : at + int(rng.integers(1, 40))])
    data[at : at + n] = rng.bytes(n)
    return bytes(data)


def _zero_bytes(data: bytearray, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    n = len(data[at : at + int(rng.integers(1, 300))])
    data[at : at + n] = bytes(n)
    return bytes(data)


def _move_azimuth(data: bytearray, rng: np.random.Generator) -> bytes:
    """Damage one azimuth where it is hardest to see: by a little."""
    at = 100 * int(rng.integers(velodyne.N_BLOCKS)) + 2
    if len(data) >= at + 2:
        moved = int.from_bytes(data[at : at + 2], "little") + int(rng.integers(-60, 61))
        data[at : at + 2] = (moved % velodyne.AZIMUTH_STEPS).to_bytes(2, "little")
    return bytes(data)


def _turn_all(data: bytearray, rng: np.random.Generator) -> bytes:
    """Turn all azimuths by the same angle: each is right beside the others."""
    turn = int(rng.integers(velodyne.AZIMUTH_STEPS))
    for at in range(2, min(len(data) - 2, 1200), 100):
        turned = int.from_bytes(data[at : at + 2], "little") + turn
        data[at : at + 2] = (turned % velodyne.AZIMUTH_STEPS).to_bytes(2, "little")
    return bytes(data)


def _move_time(data: bytearray, rng: np.random.Generator) -> bytes:
    if len(data) >= 1204:
        reach_us = 10 ** int(rng.integers(1, 10))
        moved = int.from_bytes(data[1200:1204], "little") + int(rng.integers(-reach_us, reach_us))
        data[1200:1204] = (moved % velodyne.HOUR_US).to_bytes(4, "little")
    return bytes(data)


def _change_factory_bytes(data: bytearray, rng: np.random.Generator) -> bytes:
    codes = (*velodyne.RETURN_MODES, *velodyne.PRODUCTS, 0, 255)
    if len(data) >= 1206:
        data[1204 + int(rng.integers(2))] = codes[int(rng.integers(len(codes)))]
    return bytes(data)


def _swap_blocks(data: bytearray, rng: np.random.Generator) -> bytes:
    a, b = sorted(100 * int(block) for block in rng.choice(velodyne.N_BLOCKS, 2, replace=False))
    return bytes(data[:a] + data[b : b + 100] + data[a + 100 : b] + data[a : a + 100] + data[b + 100 :])


def _truncate(data: bytearray, rng: np.random.Generator) -> bytes:
    return bytes(data[: _place(data, rng)])


def _prolong(data: bytearray, rng: np.random.Generator) -> bytes:
    return bytes(data) + rng.bytes(int(rng.integers(1, 600)))


def _shift(data: bytearray, rng: np.random.Generator) -> bytes:
    at = int(rng.integers(1, 8))
    return bytes(data[at:]) + rng.bytes(at)


def _invent(data: bytearray, rng: np.random.Generator) -> bytes:
    return rng.bytes(len(data))


_MUTATIONS: tuple[Mutation, ...] = (
    _flip_bit, _flip_bit, _flip_bit, _replace_bytes, _zero_bytes, _move_azimuth, _turn_all, _move_time,
    _change_factory_bytes, _swap_blocks, _truncate, _prolong, _shift, _invent,
)  # fmt: skip
