"""Packets of a Velodyne, checked and ordered by its clock; UDP delivers anything sent to the port."""

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core import velodyne
from lce_rig.core.losses import Losses
from lce_rig.io import findings

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
# So many packets ahead are believed whatever the host's clock says; beyond, both clocks must agree.
_MAX_BLIND = 4
_MAX_DISAGREEMENT_NS = 20_000_000


class BadPacketError(ValueError):
    """A payload that is not a packet of the LiDAR; `model` names the Velodyne whose packet it is, if any."""

    def __init__(self, what: str, model: str = "") -> None:
        super().__init__(what)
        self.model = model


@dataclass(frozen=True, eq=False)
class DataPacket:
    """One data packet that passed the checks.

    Attributes:
        host_ns: arrival at the host; 0 where unknown.
        us: time of the first firing past the hour, on the sensor's counter.
        mode: of velodyne.RETURN_MODES.
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
        nmea: the sentence it last received, without its line end; "" for none.
        nmea_s: second past the hour of that sentence; None where it is no sound $GPRMC.
        is_fix: whether that sentence claims to be valid (status A).
    """

    us: int
    pps: int
    nmea: str
    nmea_s: int | None
    is_fix: bool


def read_data_packet(
    payload: bytes | memoryview, host_ns: int, wanted: velodyne.Product = velodyne.READ[0]
) -> DataPacket:
    """Check a payload in every way its layout allows.

    Ranges and reflectivities can have any value; everything else is bound: flags, azimuths that rise evenly,
    a time within the hour, known factory bytes.

    Args:
        payload: of the UDP packet.
        host_ns: its arrival; 0 where unknown.
        wanted: the model whose packets are read.

    Raises:
        BadPacketError: it is not a data packet of that model.
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
    """Return whether 12 blocks advance as those of a turning rotor."""
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
    """Read what the sensor reports of its clock.

    Raises:
        BadPacketError: it is not a position packet.
    """
    if len(payload) != velodyne.POSITION_BYTES:
        raise BadPacketError(f"{len(payload)} bytes")
    fields = np.frombuffer(payload, velodyne.POSITION_PACKET)[0]
    us, pps = int(fields["us"]), int(fields["pps"])
    if us >= velodyne.HOUR_US:
        raise BadPacketError(f"time {us} us beyond the hour")
    if pps >= len(velodyne.PPS_STATES):
        raise BadPacketError("unknown PPS state")
    raw = bytes(fields["nmea"]).split(b"\0")[0]
    nmea_s, is_fix = _read_rmc(raw)
    nmea = raw.strip().decode("ascii", "replace")
    return PositionPacket(us, pps, nmea, nmea_s, is_fix)


def _read_rmc(raw: bytes) -> tuple[int | None, bool]:
    """Find second past the hour and status of a sentence whose checksum is right."""
    match = _RMC.match(raw)
    if match is None:
        return None, False
    body = raw[1 : raw.index(b"*")]
    checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
    minute, second = int(match[2]), int(match[3])
    if checksum != int(match[5], 16) or minute > 59 or second > 59:
        return None, False
    return 60 * minute + second, match[4] == b"A"


class PacketOrder:
    """Follows the sensor's counter from packet to packet.

    Args:
        losses: receives packets that never arrived or came late, and steps of the clock.

    Attributes:
        elapsed_ns: of the counter since the first packet; hours are counted on, and steps excluded.
    """

    def __init__(self, losses: Losses) -> None:
        self._losses = losses
        self.elapsed_ns = 0
        self._last: DataPacket | None = None

    def place(self, packet: DataPacket) -> Literal["next", "late", "after a step"]:
        """Compare the sensor's counter with the host's clock since the packet before.

        Returns:
            "late" for a packet to skip: it was sent before another that has arrived, or twice;
            "after a step" where the sensor's clock was set, as it is when it locks to a pulse, or its return
            mode.
        """
        last, self._last = self._last, packet
        if last is None:
            return "next"
        # The shorter way around the hour.
        half_us = velodyne.HOUR_US // 2
        step_ns = 1000 * ((packet.us - last.us + half_us) % velodyne.HOUR_US - half_us)
        n_ahead = round(step_ns / packet.packet_ns)
        is_host_known = bool(last.host_ns and packet.host_ns)
        off_ns = packet.host_ns - last.host_ns - step_ns if is_host_known else 0
        do_agree = abs(off_ns) <= _MAX_DISAGREEMENT_NS
        if packet.mode == last.mode and n_ahead > 0 and (n_ahead <= _MAX_BLIND or do_agree):
            self._losses.add(findings.LOST(), n_ahead - 1)
            self.elapsed_ns += step_ns
            return "next"
        if n_ahead <= 0 and step_ns > -_MAX_DISAGREEMENT_NS and do_agree:
            self._last = last
            self._losses.add(findings.LATE())
            return "late"
        self._losses.add(findings.CLOCK_SET())
        return "after a step"
