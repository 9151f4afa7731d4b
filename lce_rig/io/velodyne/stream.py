"""From a stream of Velodyne packets, live or recorded, to scans of one revolution each."""

from collections import Counter, deque
from dataclasses import dataclass

import numpy as np

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding
from lce_rig.core.losses import Losses
from lce_rig.io.velodyne.driver_controls import read_controls
from lce_rig.io.velodyne.packet import (
    BadPacketError,
    DataPacket,
    OtherModelError,
    PositionPacket,
    read_data_packet,
    read_position_packet,
)
from lce_rig.io.velodyne.packet_order import PacketOrder, Place
from lce_rig.io.velodyne.points import Vlp16Decoder, keep_brighter
from lce_rig.rig import LidarSettings
from lce_rig.timing.clock import resolve_hour
from lce_rig.words import describe

# The check of a VLP-16's time, and the timestamps of its scans if it fails.
#
# The counter in the packets runs free from power-up, and looks no different then: only pulses and
# sentences,
# which the position packets report, tie it to UTC. The hour is never sent.

#: Clocks further apart than this do not both show UTC.
MAX_DISAGREEMENT_NS = 100_000_000
# Position packets come 50 to 150 times per second; a sentence stays until the next, a second later.
_MAX_AGE_S = 3
_SENTENCE_LAG_S = (0, 1)
# The least delayed arrival of a tenth of a second gives the host's time of a firing best. Of twenty of them
# the lower quartile is safe from late arrivals and from a damaged packet.
_WINDOW_NS = 100_000_000
_N_WINDOWS = 20


class VelodyneClock:
    """Keeps the sensor's counter, its position packets and the host's clock together."""

    def __init__(self, is_device_wanted: bool = True) -> None:
        self._is_device_wanted = is_device_wanted
        self._position: PositionPacket | None = None
        self._delays_ns: deque[tuple[int, int]] = deque(maxlen=_N_WINDOWS)
        self._last_us = 0
        self._last_elapsed_ns = 0

    @property
    def position(self) -> PositionPacket | None:
        """The position packet that came last."""
        return self._position

    def restart(self) -> None:
        """Forget how the counter was tied to the host: it was set."""
        self._delays_ns.clear()

    def see_position(self, packet: PositionPacket) -> None:
        """Take note of what the sensor says of its clock."""
        self._position = packet

    def see_data(self, packet: DataPacket, elapsed_ns: int) -> None:
        """Take note of an arrival.

        Args:
            packet: in its place.
            elapsed_ns: of the counter since any fixed moment.
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
        """Give by how much the sensor's time is ahead of the host's; None where there is no host's time.

        The hour is the host's. A packet arrives after its last firing, so its length is subtracted from the
        arrival; what is left is the host's time of the first firing, late by the network's delay.
        """
        host_ns = self._host_ns(self._last_elapsed_ns)
        if host_ns is None:
            return None
        return resolve_hour(1000 * self._last_us, host_ns) - host_ns

    def stamp_ns(self, elapsed_ns: int) -> int | None:
        """Stamp a moment of the counter, with the sensor's time where it can be trusted, else the host's."""
        host_ns = self._host_ns(elapsed_ns)
        if host_ns is None:
            return None
        if not self.is_utc:
            return host_ns
        past_hour_ns = 1000 * self._last_us + elapsed_ns - self._last_elapsed_ns
        return resolve_hour(past_hour_ns, host_ns)

    @property
    def is_utc(self) -> bool:
        """Whether scans are timestamped with the sensor's own time, UTC."""
        return not self._doubt()

    def state(self) -> Finding:
        """Find whose time scans are timestamped with, and why it is not the sensor's.

        The sensor's time is trusted where it is locked to pulses, the sentence it holds is of the second that
        its counter shows, and the host's clock agrees.
        """
        code, ahead_ns, position = self._doubt(), self.ahead_ns(), self._position
        figures: dict[str, Figure] = {} if ahead_ns is None else {"ahead_s": ahead_ns * 1e-9}
        if position is not None:
            figures |= {"pps": velodyne.PPS_STATES[position.pps], "is_fix": position.is_fix}
            figures["nmea_past_hour_s"] = position.nmea_s
        if not code:
            return Finding("clock.lidar_utc", "note", figures=figures)
        is_usual = code in ("clock.host_wanted", "clock.arrivals_unknown")
        return Finding(code, "note" if is_usual else "warning", figures=figures)

    def _doubt(self) -> str:
        """Find the first reason not to trust the sensor's time, as its code; "" for none."""
        if not self._is_device_wanted:
            return "clock.host_wanted"
        position, ahead_ns = self._position, self.ahead_ns()
        if position is None:
            return "clock.no_position_packets"
        age_s = ((self._last_us - position.us) % velodyne.HOUR_US) // 1_000_000
        # A position packet may have overtaken the data packets it belongs to.
        if _MAX_AGE_S <= age_s < 3600 - _MAX_AGE_S:
            return "clock.position_packets_stopped"
        if position.pps != velodyne.PPS_LOCKED:
            return "clock.pps_not_locked"
        if position.nmea_s is None:
            return "clock.nmea_damaged" if position.nmea else "clock.no_nmea"
        if (position.us // 1_000_000 - position.nmea_s) % 3600 not in _SENTENCE_LAG_S:
            return "clock.nmea_of_other_second"
        if ahead_ns is None:
            return "clock.arrivals_unknown"
        return "clock.lidar_utc_differs" if abs(ahead_ns) > MAX_DISAGREEMENT_NS else ""

    def _host_ns(self, elapsed_ns: int) -> int | None:
        if not self._delays_ns:
            return None
        delays_ns = sorted(delay_ns for _, delay_ns in self._delays_ns)
        return elapsed_ns + delays_ns[len(delays_ns) // 4]


# A scan with more of its packets lost is not worth looking at.
_MIN_COVERAGE = 0.5
# Timestamps by arrival and by the sensor may differ by a tenth of a second when one takes over from the
# other.
_MAX_OVERLAP_NS = 1_000_000_000
_PARTIAL, _THIN = Finding("scan.partial", "note"), Finding("scan.thin", "warning")
_EMPTY, _NOT_RISING = Finding("scan.empty", "warning"), Finding("scan.not_rising", "warning")


@dataclass(frozen=True, eq=False)
class _Piece:
    """Blocks of one packet that belong to one revolution.

    Attributes:
        packet: as it came.
        elapsed_ns: of the counter at the packet's first firing.
        blocks: which of its blocks.
    """

    packet: DataPacket
    elapsed_ns: int
    blocks: slice

    @property
    def start_ns(self) -> int:
        """Counter at the first firing of the first block."""
        n_before = int(self.blocks.start) // (2 if self.packet.is_dual else 1)
        return self.elapsed_ns + self.packet.product.block_ns * n_before


class Vlp16Stream:
    """Assembles the packets of one sensor into scans.

    Attributes:
        n_data, n_position: data and position packets that passed the checks.
        n_scans: revolutions handed on.
        losses: packets and revolutions lost or skipped, and steps of the sensor's clock.
        product: the model whose packets are taken.
        other_models: data packets of other models, by name.
        clock: what scans are timestamped with.
        mode: return mode of the packet that came last, of velodyne.RETURN_MODES; 0 before the first.
        rotor_hz: speed of the rotor as it was last; 0 before the first packet.

    Raises:
        SourceError: velodyne-decoder is not installed, the model's packets are not read, or `driver.controls`
            cannot be meant.
    """

    def __init__(self, sensor: str, settings: LidarSettings) -> None:
        self.n_data = self.n_position = self.n_scans = 0
        self.losses = Losses()
        self.other_models: Counter[str] = Counter()
        self.clock = VelodyneClock(settings.timestamps.clock != "host")
        self.mode = 0
        self.rotor_hz = 0.0
        product = velodyne.product_of(settings.model)
        if product is None:
            known = ", ".join(each.name for each in velodyne.READ)
            raise SourceError(
                f"lidars.{sensor}.model: packets of {settings.model} are not read", f"Read: {known}."
            )
        self.product = product
        self._sensor = sensor
        self._order = PacketOrder(self.losses)
        self._decoder = Vlp16Decoder(settings.min_range_m, settings.max_range_m, self.product)
        # The sensor counts clockwise.
        cut_rad = -read_controls(sensor, settings).cut_azimuth_rad
        self._cut = round(cut_rad / velodyne.AZIMUTH_STEP_RAD) % velodyne.AZIMUTH_STEPS
        self._pieces: list[_Piece] = []
        self._is_from_cut = False
        self._last_stamp_ns: int | None = None

    def flaws(self) -> list[Finding]:
        """List what was wrong with single packets of either kind."""
        return [
            Finding(each.code, each.severity, figures={**each.figures, "of": each.subject})
            for each in self.losses.findings()
            if each.subject
        ]

    def account(self) -> list[str]:
        """Say what was lost or skipped, in words."""
        lost = [each for each in self.losses.findings() if not each.subject]
        return [describe(each) for each in lost + self.flaws()]

    def push_position(self, payload: bytes | memoryview, host_ns: int) -> None:
        """Take a position packet; a bad one is counted."""
        try:
            packet = read_position_packet(payload, host_ns)
        except BadPacketError as error:
            self.losses.add(Finding(error.code, "warning", "position"))
            return
        self.n_position += 1
        self.clock.see_position(packet)

    def push_data(self, payload: bytes | memoryview, host_ns: int) -> Scan | None:
        """Take a data packet; returns the scan that it completes. A bad one is counted.

        Args:
            payload: of the UDP packet.
            host_ns: its arrival; 0 where unknown.
        """
        try:
            packet = read_data_packet(payload, host_ns, self.product)
        except BadPacketError as error:
            self.losses.add(Finding(error.code, "warning", "data"))
            if isinstance(error, OtherModelError):
                self.other_models[error.model] += 1
            return None
        place = self._order.place(packet)
        if place is Place.HELD:
            return None
        self.n_data += 1
        if place is Place.AFTER_STEP:
            # What is left of the revolution is counted when the rotor passes the cut.
            self._pieces, self._is_from_cut = [], False
            self.clock.restart()
        self.mode, self.rotor_hz = packet.mode, packet.steps_per_ns * 1e9 / velodyne.AZIMUTH_STEPS
        self.clock.see_data(packet, self._order.elapsed_ns)
        return self._add(packet, self._order.elapsed_ns)

    def finish(self) -> Scan | None:
        """End the stream; returns the last scan where it is whole but for the packet that would close it."""
        if not self._pieces:
            return None
        last = self._pieces[-1]
        to_go = velodyne.AZIMUTH_STEPS - self._past_cut(int(last.packet.azimuth[-1]))
        if to_go <= 2 * last.packet.steps_per_ns * self.product.block_ns:
            return self._close()
        self._pieces, self._is_from_cut = [], False
        self.losses.add(_PARTIAL)
        return None

    def _add(self, packet: DataPacket, elapsed_ns: int) -> Scan | None:
        """Add a packet to its revolution, or to two where the rotor passes the cut within it."""
        past_cut = (packet.azimuth - self._cut) % velodyne.AZIMUTH_STEPS
        drops = np.flatnonzero(np.diff(past_cut) < 0)
        scan = None
        if self._pieces and self._passed_cut_before(packet, elapsed_ns, int(past_cut[0])):
            scan = self._close()
            self._is_from_cut = True
        elif not self._pieces:
            self._is_from_cut = bool(past_cut[0] <= packet.steps_per_ns * self.product.block_ns)
        if len(drops) == 0:
            self._pieces.append(_Piece(packet, elapsed_ns, slice(0, velodyne.N_BLOCKS)))
            return scan
        first_after = int(drops[0]) + 1
        self._pieces.append(_Piece(packet, elapsed_ns, slice(0, first_after)))
        closed = self._close()
        self._is_from_cut = True
        self._pieces = [_Piece(packet, elapsed_ns, slice(first_after, velodyne.N_BLOCKS))]
        return closed or scan

    def _passed_cut_before(self, packet: DataPacket, elapsed_ns: int, past_cut: int) -> bool:
        """Return whether the rotor passed the cut between the last packet and this one."""
        last = self._pieces[-1]
        before = self._past_cut(int(last.packet.azimuth[-1]))
        turned = packet.steps_per_ns * (elapsed_ns - last.elapsed_ns)
        return past_cut < before or turned > velodyne.AZIMUTH_STEPS

    def _past_cut(self, azimuth: int) -> int:
        return (azimuth - self._cut) % velodyne.AZIMUTH_STEPS

    def _close(self) -> Scan | None:
        """Build the scan of the revolution that has ended."""
        pieces, self._pieces = self._pieces, []
        if not self._is_from_cut:
            self.losses.add(_PARTIAL)
            return None
        n_blocks = sum(piece.blocks.stop - piece.blocks.start for piece in pieces)
        packet = pieces[-1].packet
        n_wanted = (
            velodyne.AZIMUTH_STEPS / (packet.steps_per_ns * self.product.block_ns) * (1 + packet.is_dual)
        )
        if n_blocks < _MIN_COVERAGE * n_wanted:
            self.losses.add(_THIN)
            return None
        return self._decode(pieces)

    def _decode(self, pieces: list[_Piece]) -> Scan | None:
        packets = np.array([piece.packet.fields for piece in pieces], velodyne.DATA_PACKET)
        for piece, ranges in zip(pieces, packets["blocks"]["returns"]["range"], strict=True):
            ranges[: piece.blocks.start] = 0
            ranges[piece.blocks.stop :] = 0
        if pieces[0].packet.is_dual:
            keep_brighter(packets)
        batch = self._decoder.decode(packets, [piece.elapsed_ns for piece in pieces])
        if len(batch.points) == 0:
            self.losses.add(_EMPTY)
            return None
        first_ns = pieces[0].start_ns
        stamp_ns = self.clock.stamp_ns(first_ns)
        if not self._rises(stamp_ns):
            self.losses.add(_NOT_RISING)
            return None
        self.n_scans += 1
        return Scan(
            self._sensor,
            stamp_ns,
            batch.points,
            batch.intensity,
            batch.ring,
            batch.offset_ns - (first_ns - pieces[0].elapsed_ns),
            pieces[-1].packet.host_ns or None,
        )

    def _rises(self, stamp_ns: int | None) -> bool:
        """Return whether a timestamp follows the one before; a clock that is set back far starts again."""
        last_ns = self._last_stamp_ns
        if stamp_ns is None or (last_ns is not None and 0 <= last_ns - stamp_ns < _MAX_OVERLAP_NS):
            return stamp_ns is None
        self._last_stamp_ns = stamp_ns
        return True
