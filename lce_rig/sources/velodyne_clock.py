"""The check of a VLP-16's time, and the timestamps of its scans if it fails.

The counter in the packets runs free from power-up, and looks no different then: only pulses and sentences,
which the position packets report, tie it to UTC. The hour is never sent.
"""

from collections import deque

from lce_rig.core import velodyne
from lce_rig.core.findings import Figure, Finding
from lce_rig.sources.velodyne_packet import DataPacket, PositionPacket
from lce_rig.timing.clock import resolve_hour

#: Clocks further apart than this do not both show UTC.
MAX_DISAGREEMENT_NS = 100_000_000
# Position packets come 50 to 150 times per second; a sentence stays until the next, a second later.
_MAX_AGE_S = 3
_SENTENCE_LAG_S = (0, 1)
# The least delayed arrival of a tenth of a second tells the host's time of a firing best. Of twenty of them
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
        delay_ns = packet.host_ns - velodyne.packet_ns(packet.is_dual) - elapsed_ns
        window = elapsed_ns // _WINDOW_NS
        if self._delays_ns and self._delays_ns[-1][0] == window:
            delay_ns = min(delay_ns, self._delays_ns.pop()[1])
        self._delays_ns.append((window, delay_ns))

    def ahead_ns(self) -> int | None:
        """Give by how much the sensor's time is ahead of the host's; None where there is no host's time.

        The hour is the host's. A packet arrives after its last firing, so its length is taken off the
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
