"""Findings about recordings and packets: parts that were skipped, repaired, lost or assumed."""

from lce_rig.core.findings import Finding, Kind, Losses, note_kind, warning_kind


def worded(losses: Losses) -> list[str]:
    """List the losses, one per line."""
    return [finding.sentence for finding in losses.findings()]


def _loss(name: str, text: str) -> Kind:
    return warning_kind(f"recording.{name}", text)


BROKEN_PACKETS = _loss("broken_packets", "{n} broken packets skipped (first: {where})")
TORN_END = _loss("torn_end", "{n} torn ends of the file skipped (first: {where})")
PACKETS_LOST = _loss("packets_lost", "{n} packets lost in recording (first: {where})")
BAG_TORN = _loss("bag_torn", "{n} places where the bag is torn (first: {where})")
EVENTS_STRAY = _loss("events_stray", "{n} events with stray timestamps skipped (first: {where})")
EVENTS_OFF_SENSOR = _loss("events_off_sensor", "{n} events off the sensor skipped (first: {where})")
OUT_OF_ORDER = _loss("out_of_order", "{n} sent twice or out of order, skipped")
CLOCK_SET_BACK = _loss("clock_set_back", "{n} jumps of the clock back by more than 1 s")
NOT_DECODED = _loss("not_decoded", "{n} could not be decoded (first: {where})")

BEAMS_OF_OTHER_MODEL = warning_kind(
    "recording.beams_of_other_model",
    "{subject}: {n_rings} rings from {low_deg:.1f} to {high_deg:.1f} deg, model {model} has {n_model} "
    "from {model_low_deg:.1f} to {model_high_deg:.1f} deg",
    "name the LiDAR's model in lidars.{subject}.model",
    actions={"named": "set lidars.{subject}.model to {names}"},
)
_SKIPPED = "{n_seen} of {n_rings} rings in each direction: points are skipped"
_EVERY_POINT = "record every point (point_filter_num: 1), or correct lidars.{subject}.model"
RINGS_SKIPPED = warning_kind("recording.rings_skipped", "{subject}: " + _SKIPPED, _EVERY_POINT)
LIDAR_RINGS_SKIPPED = Kind("lidar.rings_skipped", _SKIPPED, _EVERY_POINT)
POINTS_SKIPPED = warning_kind(
    "recording.points_skipped",
    "{subject}: 1 of {n} returns per ring (azimuth step {step_deg:deg}, model {model_step_deg:deg}): "
    "points are skipped",
    "record every point (point_filter_num: 1), or correct lidars.{subject}.{key}",
)

DAMAGED = warning_kind("packet.damaged", "{n} damaged packets skipped (first: {where})")
OTHER_MODEL = warning_kind(
    "packet.other_model", "{n} packets of another LiDAR model skipped (first: {where})"
)
LOST = warning_kind("packet.lost", "{n} data packets lost")
LATE = warning_kind("packet.late", "{n} data packets late or sent twice, skipped")
CLOCK_SET = note_kind("packet.clock_set", "the LiDAR's clock was set {n} times")
SCAN_PARTIAL = note_kind(
    "scan.partial", "{n} revolutions skipped: cut off at an end, or where the clock was set"
)
SCAN_THIN = warning_kind(
    "scan.thin", "{n} revolutions skipped: more than half of their packets or all returns are missing"
)
CUT_SHORT = warning_kind(
    "datagram.cut_short", "{n} datagrams skipped: fragments, or cut short by the recorder"
)

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


LIDAR_UTC = note_kind("clock.lidar_utc", _lidar_utc)
HOST_WANTED = note_kind("clock.host_wanted", f"{_BY_ARRIVAL}timestamps.clock is host")
CLOCK_BY_RECEIPT = note_kind(
    "clock.by_receipt",
    "the timestamps of {subject} are of another clock, mapped by {n} times of receipt: {offset_s:+.3f} s, "
    "drift {drift_ppm:.1f} ppm, uncertainty {sigma_ms:.0f} ms",
    "hold boards still",
)
ARRIVALS_UNKNOWN = note_kind(
    "clock.arrivals_unknown", "scans are not timestamped: their arrivals and so the hour are unknown"
)
NO_POSITION_PACKETS = warning_kind(
    "clock.no_position_packets",
    f"{_BY_ARRIVAL}no position packets, which report PPS",
    "open port 8308 in the firewall, and record it beside the data",
)
POSITION_PACKETS_STOPPED = warning_kind(
    "clock.position_packets_stopped",
    f"{_BY_ARRIVAL}position packets have stopped, or their time differs",
    "check the network and the sensor",
)
PPS_NOT_LOCKED = warning_kind(
    "clock.pps_not_locked",
    f"{_BY_ARRIVAL}PPS is {{pps}}",
    "check the pulse at the interface box: 1 Hz, 3 to 15 V, rising edge",
)
NO_NMEA = warning_kind(
    "clock.no_nmea", f"{_BY_ARRIVAL}no NMEA, or damaged NMEA", "send $GPRMC at 9600 baud with RS-232 polarity"
)
NMEA_OF_OTHER_SECOND = warning_kind(
    "clock.nmea_of_other_second", _nmea_of_other_second, "send each sentence after its pulse, within a second"
)
LIDAR_UTC_DIFFERS = warning_kind(
    "clock.lidar_utc_differs",
    f"{_BY_ARRIVAL}the LiDAR's UTC differs by {{ahead_s:+.2f}} s from this computer's",
    "set this computer's clock by the same source (chrony with gpsd, or NTP)",
)
