"""Scans as VLP-16 packets: data packets, and position packets with PPS and NMEA."""

import socket
from dataclasses import dataclass, replace
from datetime import datetime, timezone

import numpy as np

from lce_rig.core import velodyne
from lce_rig.core.data_sheets import VLP_16
from lce_rig.simulate.lidar import LidarModel

#: A revolution of whole blocks, 10.0025 Hz: scans follow each other without a gap, as a real rotor's do.
STREAMED_VLP16 = replace(
    LidarModel.of(VLP_16, 10.0), name="VLP-16 of whole blocks", period_ns=904 * velodyne.BLOCK_NS
)
# Between one packet in five and one in fourteen is a position packet, depending on the firmware.
_DATA_PER_POSITION = 14
# A GPS sends its sentence for a pulse a while after that pulse.
_SENTENCE_DELAY_NS = 300_000_000
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True)
class SensorPacket:
    """One UDP packet of the sensor."""

    port: int
    sent_ns: int
    payload: bytes


@dataclass(frozen=True)
class Vlp16Clock:
    """The sensor's clock."""

    pps: str = "locked"
    has_nmea: bool = True
    is_valid: bool = True
    error_us: int = 0


class Vlp16Packets:
    """Cuts scans into packets; an incomplete packet waits for the next scan.

    Scans simulated with STREAMED_VLP16 and timestamped one period apart come out as they went in, within the
    steps of range and azimuth, if they begin at one azimuth, as those of a rotor do."""

    def __init__(self, mode=velodyne.STRONGEST, clock=None, model=STREAMED_VLP16):
        self.clock = clock or Vlp16Clock()
        self._mode = mode
        self._model = model
        self._blocks = np.zeros(0, velodyne.DATA_BLOCK)
        self._starts_ns = np.zeros(0, np.int64)
        self._n_data = 0
        self._next_ns = 0

    def feed(self, scan, last=None):
        """Send a scan; returns the packets that are full.

        A scan that does not follow the one before at once begins a new packet, as after a break."""
        packets = self.finish() if scan.stamp_ns != self._next_ns else []
        blocks, starts_ns = self._to_blocks(scan, last or scan)
        self._next_ns = int(scan.stamp_ns or 0) + self._model.period_ns
        self._blocks = np.concatenate([self._blocks, blocks])
        self._starts_ns = np.concatenate([self._starts_ns, starts_ns])
        n_whole = len(self._blocks) // velodyne.N_BLOCKS
        return packets + [packet for _ in range(n_whole) for packet in self._pop()]

    def finish(self):
        """Send pending data, padded with blocks without returns."""
        n_missing = -len(self._blocks) % velodyne.N_BLOCKS
        if not n_missing:
            return []
        n_returns = 2 if self._is_dual else 1
        ahead = np.arange(1, n_missing + 1) + (len(self._blocks) - 1) % n_returns
        step = velodyne.AZIMUTH_STEPS * velodyne.BLOCK_NS / self._model.period_ns
        padding = np.zeros(n_missing, velodyne.DATA_BLOCK)
        padding["flag"] = velodyne.BLOCK_FLAG
        azimuth = self._blocks["azimuth"][-1] + np.rint(ahead // n_returns * step).astype(np.int64)
        padding["azimuth"] = azimuth % velodyne.AZIMUTH_STEPS
        self._blocks = np.concatenate([self._blocks, padding])
        self._starts_ns = np.concatenate([self._starts_ns, np.repeat(self._starts_ns[-1:], n_missing)])
        return self._pop()

    @property
    def _is_dual(self):
        return self._mode == velodyne.DUAL

    def _to_blocks(self, strongest, last):
        """Lay a revolution out as blocks (B,) with the time (B,) of each one's first firing."""
        n_blocks = -(-int(self._model.period_ns // velodyne.SEQUENCE_NS) // 2)
        starts_ns = int(strongest.stamp_ns or 0) + velodyne.BLOCK_NS * np.arange(n_blocks)
        blocks = np.zeros(n_blocks, velodyne.DATA_BLOCK)
        blocks["flag"] = velodyne.BLOCK_FLAG
        turned_rad = 2 * np.pi * velodyne.BLOCK_NS / self._model.period_ns * np.arange(n_blocks)
        azimuth_rad = _start_azimuth_rad(strongest, self._model) + turned_rad
        steps = np.rint(azimuth_rad / velodyne.AZIMUTH_STEP_RAD)
        blocks["azimuth"] = steps.astype(np.int64) % velodyne.AZIMUTH_STEPS
        if self._is_dual:
            blocks, starts_ns = np.repeat(blocks, 2), np.repeat(starts_ns, 2)
            blocks["returns"][0::2] = _returns(last, self._model, n_blocks)
            blocks["returns"][1::2] = _returns(strongest, self._model, n_blocks)
        else:
            blocks["returns"] = _returns(strongest, self._model, n_blocks)
        return blocks, starts_ns

    def _pop(self):
        """Take one data packet, and the position packet that follows it now and then."""
        start_ns = int(self._starts_ns[0])
        sent_ns = start_ns + velodyne.READ[0].packet_ns(self._is_dual)
        data = np.zeros((), velodyne.DATA_PACKET)
        data["blocks"], data["us"] = self._blocks[: velodyne.N_BLOCKS], self._count_us(start_ns)
        data["mode"], data["product"] = self._mode, velodyne.VLP16
        self._blocks = self._blocks[velodyne.N_BLOCKS :]
        self._starts_ns = self._starts_ns[velodyne.N_BLOCKS :]
        packets = [SensorPacket(velodyne.DATA_PORT, sent_ns, data.tobytes())]
        if self._n_data % _DATA_PER_POSITION == 0:
            packets.append(SensorPacket(velodyne.POSITION_PORT, sent_ns, self._position(sent_ns)))
        self._n_data += 1
        return packets

    def _position(self, now_ns):
        packet = np.zeros((), velodyne.POSITION_PACKET)
        packet["us"] = self._count_us(now_ns)
        packet["pps"] = velodyne.PPS_STATES.index(self.clock.pps)
        if self.clock.has_nmea:
            packet["nmea"] = gprmc(now_ns - _SENTENCE_DELAY_NS, self.clock.is_valid).encode() + b"\r\n"
        return packet.tobytes()

    def _count_us(self, time_ns):
        return (time_ns // 1000 + self.clock.error_us) % velodyne.HOUR_US


def free_ports():
    """Find two unused UDP ports."""
    kind = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*kind) as data, socket.socket(*kind) as position:
        data.bind(("", 0))
        position.bind(("", 0))
        return data.getsockname()[1], position.getsockname()[1]


def gprmc(time_ns, is_valid=True):
    """Write the sentence for the last pulse before a time, without its line end."""
    when = datetime.fromtimestamp(time_ns // _NS_PER_S, timezone.utc)
    status = "A" if is_valid else "V"
    body = f"GPRMC,{when:%H%M%S},{status},2219.9000,N,11415.9000,E,000.0,000.0,{when:%d%m%y},,,A"
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8)))
    return f"${body}*{checksum:02X}"


def _start_azimuth_rad(scan, model):
    """Find the sensor's azimuth at the first firing from all points: the rotor turns evenly."""
    assert scan.offset_ns is not None
    azimuth_rad = np.arctan2(-scan.points[:, 1].astype(float), scan.points[:, 0].astype(float))
    turned_rad = 2 * np.pi * scan.offset_ns / model.period_ns
    return float(np.angle(np.exp(1j * (azimuth_rad - turned_rad)).mean()))


def _returns(scan, model, n_blocks):
    """Lay the points out as returns (n_blocks, 32)."""
    assert scan.offset_ns is not None
    laser = np.argsort(model.rings)[scan.ring]
    sequence, rest_ns = np.divmod(scan.offset_ns - laser * velodyne.FIRING_NS, velodyne.SEQUENCE_NS)
    assert not rest_ns.any() and 0 <= sequence.min() <= sequence.max() < 2 * n_blocks
    from_laser = scan.points.astype(np.float64)
    from_laser[:, 2] -= model.vertical_offsets_m[laser]
    steps = np.rint(np.linalg.norm(from_laser, axis=1) / VLP_16.range_step_m)
    returns = np.zeros((2 * n_blocks, velodyne.N_LASERS), velodyne.DATA_BLOCK["returns"].base)
    returns["range"][sequence, laser] = np.minimum(steps, np.iinfo(np.uint16).max)
    returns["reflectivity"][sequence, laser] = np.clip(np.rint(scan.intensity), 0, 255)
    return returns.reshape(n_blocks, 2 * velodyne.N_LASERS)
