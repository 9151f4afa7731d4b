"""Phrases of drivers: devices, streams, clocks, and the pulses and edges that synchronise them."""

from collections.abc import Mapping

from lce_rig.core.findings import Finding
from lce_rig.words.rendering import Phrase

_BY_ARRIVAL = "scans are timestamped by arrival: "


def _lidar_utc(finding: Finding) -> str:
    """The timestamps are the LiDAR's UTC by PPS and NMEA, {ahead_s} ahead of this computer's clock."""
    ahead_s = finding.figures.get("ahead_s")
    offset = f", {1000 * finding.figure('ahead_s'):+.1f} ms from this computer's clock" if ahead_s else ""
    return f"UTC by PPS and NMEA{offset}"


def _nmea_of_other_second(finding: Finding) -> str:
    """The sentences' time is {nmea_past_hour_s} past the hour, not the LiDAR's."""
    minute, second = divmod(round(finding.figure("nmea_past_hour_s")), 60)
    return f"{_BY_ARRIVAL}NMEA time {minute:02d}:{second:02d} past the hour is not the LiDAR's"


def _simulated_slowly(finding: Finding) -> str:
    """The simulation runs {factor} times slower than real time."""
    factor = f"{'more than' if finding.figures['is_more'] else 'about'} {finding.figures['factor']}"
    return f"simulated {factor} times slower than real time"


_SIMULATED: Mapping[str, Phrase] = {
    "clock.simulated": Phrase("simulated"),
    "stream.simulated_slowly": Phrase(
        _simulated_slowly, "expect low rates: this computer is too busy or too slow, no sensor is at fault"
    ),
}
_PACKETS: Mapping[str, Phrase] = {
    "packet.wrong_length": Phrase("{n} {of} packets of wrong length skipped"),
    "packet.wrong_flag": Phrase("{n} {of} packets with a wrong block flag skipped"),
    "packet.time_beyond_hour": Phrase("{n} {of} packets with a time beyond the hour skipped"),
    "packet.azimuth_beyond_360": Phrase("{n} {of} packets with an azimuth beyond 360 deg skipped"),
    "packet.unknown_factory_bytes": Phrase(
        "{n} {of} packets with unknown factory bytes skipped (firmware before 3.0.29 sends none)"
    ),
    "packet.uneven_azimuths": Phrase("{n} {of} packets with uneven azimuths skipped"),
    "packet.unknown_pps": Phrase("{n} {of} packets with an unknown PPS state skipped"),
    "packet.lost": Phrase("{n} data packets lost"),
    "packet.late": Phrase("{n} data packets late or sent twice, skipped"),
    "packet.astray": Phrase("{n} data packets with a damaged time skipped"),
    "packet.clock_set": Phrase("the LiDAR's clock was set {n} times"),
    "scan.partial": Phrase("{n} revolutions skipped: cut off at an end, or where the clock was set"),
    "scan.thin": Phrase("{n} revolutions skipped: more than half of their packets are lost"),
    "scan.empty": Phrase("{n} revolutions without a return"),
    "scan.not_rising": Phrase("{n} scans skipped: their timestamps do not rise"),
    "packet.other_model": Phrase("{n} {of} packets of another LiDAR model skipped"),
    "datagram.fragmented": Phrase("{n} datagrams sent in fragments skipped"),
    "datagram.cut_short": Phrase("{n} datagrams cut short by the recorder skipped"),
}
_LIDAR_CLOCK: Mapping[str, Phrase] = {
    "clock.lidar_utc": Phrase(_lidar_utc),
    "clock.host_wanted": Phrase(f"{_BY_ARRIVAL}timestamps.clock is host"),
    "clock.arrivals_unknown": Phrase("scans are not timestamped: their arrivals and so the hour are unknown"),
    "clock.no_position_packets": Phrase(
        f"{_BY_ARRIVAL}no position packets, which report PPS",
        "open port 8308 in the firewall, and record it beside the data",
    ),
    "clock.position_packets_stopped": Phrase(
        f"{_BY_ARRIVAL}position packets have stopped, or their time differs",
        "check the network and the sensor",
    ),
    "clock.pps_not_locked": Phrase(
        f"{_BY_ARRIVAL}PPS is {{pps}}",
        "check the pulse at the LiDAR's interface box: 1 Hz, 3 to 15 V, rising edge",
    ),
    "clock.no_nmea": Phrase(f"{_BY_ARRIVAL}no NMEA", "send $GPRMC at 9600 baud with RS-232 polarity"),
    "clock.nmea_damaged": Phrase(
        f"{_BY_ARRIVAL}NMEA is damaged", "send $GPRMC at 9600 baud with RS-232 polarity"
    ),
    "clock.nmea_of_other_second": Phrase(
        _nmea_of_other_second, "send each sentence after its pulse, within a second"
    ),
    "clock.lidar_utc_differs": Phrase(
        f"{_BY_ARRIVAL}the LiDAR's UTC differs by {{ahead_s:+.2f}} s from this computer's",
        "set this computer's clock by the same source (chrony with gpsd, or NTP)",
    ),
}
PHRASES: Mapping[str, Phrase] = {**_SIMULATED, **_PACKETS, **_LIDAR_CLOCK}
