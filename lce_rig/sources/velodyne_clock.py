"""The check of a VLP-16's time, and the timestamps of its scans if it fails.

The counter in the packets runs free from power-up, and looks no different then: only pulses and sentences,
which the position packets report, tie it to UTC. The hour is never sent.
"""

from collections import deque
from dataclasses import dataclass

from lce_rig.core import velodyne
from lce_rig.core.clock import NS_PER_S, resolve_hour
from lce_rig.sources.velodyne_packet import DataPacket, PositionPacket

#: Clocks further apart than this do not both show UTC.
MAX_DISAGREEMENT_NS = 100_000_000
# Position packets come 50 to 150 times a second; a sentence stays until the next, a second later.
_MAX_AGE_S = 3
_SENTENCE_LAG_S = (0, 1)
# The least delayed arrival of a tenth of a second tells the host's time of a firing best. Of twenty of them
# the lower quartile is safe from late arrivals and from a damaged packet.
_WINDOW_NS = 100_000_000
_N_WINDOWS = 20


@dataclass(frozen=True)
class ClockState:
    """The time base of the scans.

    Attributes:
        is_device: whether it is the sensor's own time, UTC.
        text: whose time it is and why, in words.
        remedy: what to do to get the sensor's own time; "" where it is had.
    """

    is_device: bool
    text: str
    remedy: str = ""


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
        if not self.state().is_device:
            return host_ns
        past_hour_ns = 1000 * self._last_us + elapsed_ns - self._last_elapsed_ns
        return resolve_hour(past_hour_ns, host_ns)

    def state(self) -> ClockState:
        """Say whose time scans are stamped with, and why.

        The sensor's time is trusted where it is locked to pulses, the sentence it holds is of the second that
        its counter shows, and the host's clock agrees.
        """
        cause, remedy = self._doubt()
        if not cause:
            ahead_ms = 1e-6 * (self.ahead_ns() or 0)
            return ClockState(True, f"UTC by PPS and NMEA, {ahead_ms:+.1f} ms from this computer's clock")
        return ClockState(False, f"this computer's clock, by arrival: {cause}", remedy)

    def _doubt(self) -> tuple[str, str]:
        """Find the first reason not to trust the sensor's time, and its remedy; ("", "") for none."""
        if not self._is_device_wanted:
            return "the profile says so (timestamps.clock: host)", ""
        position, ahead_ns = self._position, self.ahead_ns()
        if position is None:
            remedy = f"open port {velodyne.POSITION_PORT} in the firewall, and record it beside the data"
            return "no position packets have come, which tell of PPS", remedy
        age_s = ((self._last_us - position.us) % velodyne.HOUR_US) // 1_000_000
        # A position packet may have overtaken the data packets it belongs to.
        if _MAX_AGE_S <= age_s < 3600 - _MAX_AGE_S:
            return "its position packets have stopped, or count otherwise", "check the network and the sensor"
        if position.pps != velodyne.PPS_LOCKED:
            state = velodyne.PPS_STATES[position.pps]
            return (
                f"PPS is {state}",
                "check the pulse at the LiDAR's interface box: 1 Hz, 3 to 15 V, rising edge",
            )
        if position.nmea_s is None:
            what = "a damaged sentence" if position.nmea else "no NMEA"
            return f"PPS is locked, but {what} arrives", "send $GPRMC at 9600 baud with RS-232 polarity"
        if (position.us // 1_000_000 - position.nmea_s) % 3600 not in _SENTENCE_LAG_S:
            minute, second = divmod(position.nmea_s, 60)
            what = f"PPS is locked, but NMEA says {minute:02d}:{second:02d} past the hour, not the sensor"
            return what, "send each sentence after its pulse, within a second"
        if ahead_ns is None:
            return "arrivals are not known, and so neither is the hour", ""
        if abs(ahead_ns) > MAX_DISAGREEMENT_NS:
            what = f"the LiDAR's UTC is {ahead_ns / NS_PER_S:+.2f} s from it"
            return what, "set this computer's clock by the same source (chrony with gpsd, or NTP)"
        return "", ""

    def _host_ns(self, elapsed_ns: int) -> int | None:
        if not self._delays_ns:
            return None
        delays_ns = sorted(delay_ns for _, delay_ns in self._delays_ns)
        return elapsed_ns + delays_ns[len(delays_ns) // 4]
