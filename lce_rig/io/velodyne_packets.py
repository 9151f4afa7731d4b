"""Velodyne packets, checked and ordered by the sensor's counter, and its clock; UDP may deliver anything."""

import re
import struct
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import velodyne
from lce_rig.core.findings import Figure, Finding, Kind
from lce_rig.io import findings
from lce_rig.timing.clock import resolve_hour

# Neighbouring blocks of a real rotor at 600 rpm lie 0.38 to 0.42 deg apart.
_MAX_UNEVEN_STEPS = 6
_MAX_UNEVEN_SHARE = 0.15
# 240 rpm to 1260 rpm; the sensor turns at 300 to 1200.
_ROTOR_HZ = (4.0, 21.0)
# Flag and azimuth of each block, then time, mode and product.
_HEADS = struct.Struct("<" + "HH96x" * velodyne.N_BLOCKS + "IBB")
_FLAGS = [velodyne.BLOCK_FLAG] * velodyne.N_BLOCKS
_RMC = re.compile(
    rb"\$G[PN]RMC,(\d\d)(\d\d)(\d\d)(?:\.\d*)?,([AV]),[^*\r\n]*\*([0-9A-Fa-f]{1,2})(?![0-9A-Fa-f])"
)


class BadPacketError(ValueError):
    """A payload that is not a packet of the LiDAR; `model` names the Velodyne that sent it, if any."""

    def __init__(self, what: str, model: str = "") -> None:
        super().__init__(what)
        self.model = model


@dataclass(frozen=True, eq=False)
class DataPacket:
    """One data packet that passed the checks.

    Attributes:
        host_ns: arrival at the host; 0 where unknown.
        us: time of the first firing past the hour, on the sensor's counter.
        mode: return mode, a key of velodyne.RETURN_MODES.
        product: the model that sent it.
        azimuth: (12,) int64 of each block, 0.01 deg clockwise from the lidar frame's x axis.
        fields: () of velodyne.DATA_PACKET.
    """

    host_ns: int
    us: int
    mode: int
    product: velodyne.Product
    azimuth: NDArray[np.int64]
    fields: NDArray[np.void]

    @property
    def is_dual(self) -> bool:
        """Whether each firing has two returns, in blocks of equal azimuth."""
        return self.mode == velodyne.DUAL

    @property
    def steps_per_ns(self) -> float:
        """Rotor speed over this packet, in 0.01 deg per ns."""
        n_blocks_turned = velodyne.N_BLOCKS // 2 - 1 if self.is_dual else velodyne.N_BLOCKS - 1
        turned = (self.azimuth[-1] - self.azimuth[0]) % velodyne.AZIMUTH_STEPS
        return float(turned) / (n_blocks_turned * self.product.block_ns)

    @property
    def packet_ns(self) -> int:
        """Time from its first firing to that of the next packet."""
        return self.product.packet_ns(self.is_dual)


class PositionPacket(NamedTuple):
    """The sensor's report on its clock.

    Attributes:
        us: time past the hour on the sensor's counter.
        pps: index into velodyne.PPS_STATES.
        nmea_s: second past the hour in the last sentence received; None without a valid $GPRMC.
        is_fix: whether that sentence is marked valid (status A).
    """

    us: int
    pps: int
    nmea_s: int | None
    is_fix: bool


def read_data_packet(
    payload: bytes | memoryview, host_ns: int, wanted: velodyne.Product = velodyne.READ[0]
) -> DataPacket:
    """Check everything in a payload that its layout determines.

    Ranges and reflectivities can have any value; everything else is checked: flags, azimuths that rise
    evenly, a time within the hour, known factory bytes.

    Args:
        payload: payload of the UDP packet.
        host_ns: its arrival; 0 where unknown.
        wanted: the model whose packets are read.

    Raises:
        BadPacketError: not a data packet of that model.
    """
    if len(payload) != velodyne.DATA_BYTES:
        raise BadPacketError(f"{len(payload)} bytes")
    # Four times faster without NumPy; packets come 754 times per second.
    *heads, us, mode, product = _HEADS.unpack_from(payload)
    flags, azimuth = heads[0::2], heads[1::2]
    if flags != _FLAGS:
        raise BadPacketError("wrong block flag")
    if us >= velodyne.HOUR_US:
        raise BadPacketError(f"time {us} us beyond the hour")
    if max(azimuth) >= velodyne.AZIMUTH_STEPS:
        raise BadPacketError("azimuth beyond 360 deg")
    if product != wanted.code and product in velodyne.PRODUCTS and mode in velodyne.RETURN_MODES:
        raise BadPacketError(f"of a {velodyne.PRODUCTS[product]}", velodyne.PRODUCTS[product])
    if product != wanted.code or mode not in velodyne.RETURN_MODES:
        raise BadPacketError("unknown factory bytes (firmware before 3.0.29 sends none)")
    if not _is_even(azimuth, mode == velodyne.DUAL, wanted.block_ns):
        raise BadPacketError("uneven azimuths")
    fields = np.frombuffer(payload, velodyne.DATA_PACKET)[0]
    return DataPacket(host_ns, us, mode, wanted, np.array(azimuth, np.int64), fields)


def _is_even(azimuth: Sequence[int], is_dual: bool, block_ns: int) -> bool:
    """Check whether 12 blocks advance like those of a rotating rotor."""
    steps = [(b - a) % velodyne.AZIMUTH_STEPS for a, b in pairwise(azimuth)]
    if is_dual:
        if any(steps[0::2]):
            return False
        steps = steps[1::2]
    middle = sorted(steps)[len(steps) // 2]
    rotor_hz = middle / (velodyne.AZIMUTH_STEPS * block_ns * 1e-9)
    if not _ROTOR_HZ[0] <= rotor_hz <= _ROTOR_HZ[1]:
        return False
    most = max(_MAX_UNEVEN_STEPS, _MAX_UNEVEN_SHARE * middle)
    return max(middle - min(steps), max(steps) - middle) <= most


def read_position_packet(payload: bytes | memoryview) -> PositionPacket:
    """Decode a position packet, the sensor's report on its clock.

    Raises:
        BadPacketError: not a position packet.
    """
    if len(payload) != velodyne.POSITION_BYTES:
        raise BadPacketError(f"{len(payload)} bytes")
    fields = np.frombuffer(payload, velodyne.POSITION_PACKET)[0]
    us, pps = int(fields["us"]), int(fields["pps"])
    if us >= velodyne.HOUR_US:
        raise BadPacketError(f"time {us} us beyond the hour")
    if pps >= len(velodyne.PPS_STATES):
        raise BadPacketError("unknown PPS state")
    return PositionPacket(us, pps, *_read_rmc(bytes(fields["nmea"]).split(b"\0")[0]))


def _read_rmc(raw: bytes) -> tuple[int | None, bool]:
    """Extract the seconds past the hour and the status from a sentence with a valid checksum."""
    match = _RMC.match(raw)
    if match is None:
        return None, False
    body = raw[1 : raw.index(b"*")]
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    minute, second = int(match[2]), int(match[3])
    if checksum != int(match[5], 16) or minute > 59 or second > 59:
        return None, False
    return 60 * minute + second, match[4] == b"A"


#: Largest difference of two clocks that both show UTC.
MAX_DISAGREEMENT_NS = 100_000_000
# Position packets arrive 50 to 150 times per second and repeat a sentence until the next, a second later.
_MAX_AGE_S = 3
_SENTENCE_LAG_S = (0, 1)
# The host's time of a firing is best given by the least delayed arrival in 0.1 s. The lower quartile of
# twenty of them is robust to late arrivals and a damaged packet.
_WINDOW_NS = 100_000_000
_N_WINDOWS = 20


class VelodyneClock:
    """Relates the sensor's counter, its position packets and the host's clock.

    The counter in the packets runs free from power-up, and looks the same without synchronisation: only
    pulses and sentences, which the position packets report, relate it to UTC. The hour is never sent.

    Attributes:
        position: last position packet; None before the first.
    """

    def __init__(self, is_device_wanted: bool = True) -> None:
        self.position: PositionPacket | None = None
        self._is_device_wanted = is_device_wanted
        self._delays_ns: deque[tuple[int, int]] = deque(maxlen=_N_WINDOWS)
        self._last_us = 0
        self._last_elapsed_ns = 0

    def restart(self) -> None:
        """Discard the delays between counter and host after the counter was set."""
        self._delays_ns.clear()

    def see_data(self, packet: DataPacket, elapsed_ns: int) -> None:
        """Record an arrival.

        Args:
            packet: packet in order.
            elapsed_ns: reading of the counter since any fixed time.
        """
        self._last_us, self._last_elapsed_ns = packet.us, elapsed_ns
        if not packet.host_ns:
            return
        delay_ns = packet.host_ns - packet.packet_ns - elapsed_ns
        window = elapsed_ns // _WINDOW_NS
        if self._delays_ns and self._delays_ns[-1][0] == window:
            delay_ns = min(delay_ns, self._delays_ns.pop()[1])
        self._delays_ns.append((window, delay_ns))

    def ahead_ns(self) -> int | None:
        """Compute how far the sensor's time is ahead of the host's, ns; None if the host's is unknown.

        The hour is the host's. A packet arrives after its last firing, so its length is subtracted from the
        arrival. The result is the host's time of the first firing, late by the network's delay.
        """
        host_ns = self._host_ns(self._last_elapsed_ns)
        return None if host_ns is None else resolve_hour(1000 * self._last_us, host_ns) - host_ns

    def stamp_ns(self, elapsed_ns: int) -> int | None:
        """Return the time of a counter value, ns: the sensor's time if reliable, else the host's."""
        host_ns = self._host_ns(elapsed_ns)
        if host_ns is None or not self.is_utc:
            return host_ns
        return resolve_hour(1000 * self._last_us + elapsed_ns - self._last_elapsed_ns, host_ns)

    @property
    def is_utc(self) -> bool:
        """Whether scans are timestamped with the sensor's own time, UTC."""
        return self._state() is findings.LIDAR_UTC

    def state(self) -> Finding:
        """Report the clock of the scans' timestamps, and the reason for not using the sensor's."""
        ahead_ns, position = self.ahead_ns(), self.position
        figures: dict[str, Figure] = {} if ahead_ns is None else {"ahead_s": ahead_ns * 1e-9}
        if position is not None:
            figures |= {"pps": velodyne.PPS_STATES[position.pps], "is_fix": position.is_fix}
            figures["nmea_past_hour_s"] = position.nmea_s
        return self._state()(**figures)

    def _state(self) -> Kind:
        """Find the first reason against using the sensor's time.

        The sensor's clock is trusted if it is locked to pulses, the NMEA sentence matches the second of the
        counter, and the host's clock agrees.
        """
        position, ahead_ns = self.position, self.ahead_ns()
        if not self._is_device_wanted:
            return findings.HOST_WANTED
        if position is None:
            return findings.NO_POSITION_PACKETS
        age_s = ((self._last_us - position.us) % velodyne.HOUR_US) // 1_000_000
        # A position packet may have overtaken the data packets it belongs to.
        if _MAX_AGE_S <= age_s < 3600 - _MAX_AGE_S:
            return findings.POSITION_PACKETS_STOPPED
        if position.pps != velodyne.PPS_LOCKED:
            return findings.PPS_NOT_LOCKED
        if position.nmea_s is None:
            return findings.NO_NMEA
        if (position.us // 1_000_000 - position.nmea_s) % 3600 not in _SENTENCE_LAG_S:
            return findings.NMEA_OF_OTHER_SECOND
        if ahead_ns is None:
            return findings.ARRIVALS_UNKNOWN
        return findings.LIDAR_UTC_DIFFERS if abs(ahead_ns) > MAX_DISAGREEMENT_NS else findings.LIDAR_UTC

    def _host_ns(self, elapsed_ns: int) -> int | None:
        if not self._delays_ns:
            return None
        delays_ns = sorted(delay_ns for _, delay_ns in self._delays_ns)
        return elapsed_ns + delays_ns[len(delays_ns) // 4]
