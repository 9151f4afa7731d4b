"""How an attached VLP-16 does, in figures and in sentences."""

from collections import Counter
from dataclasses import dataclass, field

from lce_rig.core import velodyne
from lce_rig.rig import LidarSettings
from lce_rig.sources.live.base import SourceStatus
from lce_rig.sources.live.vlp16_recorder import PcapRecorder
from lce_rig.sources.live.vlp16_socket import PACKET_COST_BYTES
from lce_rig.sources.velodyne_stream import Vlp16Stream

# A computer that is busy elsewhere for longer than this is too slow anyhow.
_MIN_BUFFER_S = 0.25
_MAX_LOST_SHARE = 0.01
_MAX_OFF_RATE = 0.05
_N_STRANGERS = 8


@dataclass
class Reception:
    """What the host saw of the packets.

    Attributes:
        address: whose packets are taken; "" before the first.
        n_dropped: scans that nobody took in time.
        rate_hz: scans a second.
        n_overflowed: datagrams that the kernel dropped because they were not taken in time.
        granted_bytes: receive buffer of a port.
        strangers: datagrams of other senders, by IP address; the first few.
        n_strange: datagrams of other senders.
    """

    address: str = ""
    n_dropped: int = 0
    rate_hz: float = 0.0
    n_overflowed: int = 0
    granted_bytes: int = 0
    strangers: Counter[str] = field(default_factory=Counter)
    n_strange: int = 0

    def see_stranger(self, address: str) -> None:
        """Count a datagram of another sender."""
        self.n_strange += 1
        if address in self.strangers or len(self.strangers) < _N_STRANGERS:
            self.strangers[address] += 1


def to_status(
    sensor: str,
    settings: LidarSettings,
    stream: Vlp16Stream | None,
    reception: Reception,
    recorder: PcapRecorder | None,
) -> SourceStatus:
    """Put everything into words and figures."""
    if stream is None:
        return SourceStatus(sensor, clock="closed")
    counts, state = stream.counts, stream.clock.state()
    n_bad, n_lost = counts.bad.total(), counts.order.n_lost
    ahead_ns, position = stream.clock.ahead_ns(), stream.clock.position
    figures = {
        "data_packets": float(counts.n_data),
        "position_packets": float(counts.n_position),
        "bad_packets": float(n_bad),
        "late_packets": float(counts.order.n_late),
        "overflowed_packets": float(reception.n_overflowed),
        "stranger_packets": float(reception.n_strange),
        "clock_steps": float(counts.order.n_steps),
        "receive_buffer_bytes": float(reception.granted_bytes),
        "rotor_hz": stream.rotor_hz,
        "is_dual": float(stream.mode == velodyne.DUAL),
        "is_device_time": float(state.is_device),
    }
    if position is not None:
        figures["pps_state"] = float(position.pps)
        figures["nmea_fix"] = float(position.is_fix)
        if position.nmea_s is not None:
            figures["nmea_past_hour_s"] = float(position.nmea_s)
    if ahead_ns is not None:
        figures["device_ahead_s"] = ahead_ns * 1e-9
    if recorder is not None:
        figures["recorded_packets"] = float(recorder.n_written)
        figures["unrecorded_packets"] = float(recorder.n_dropped)
    problems = _find_problems(settings, stream, reception)
    if recorder is not None and recorder.failure:
        problems.append(recorder.failure)
    return SourceStatus(
        sensor,
        counts.n_scans,
        reception.n_dropped,
        n_lost,
        reception.rate_hz,
        state.text,
        tuple(problems),
        figures,
        f"{velodyne.PRODUCTS[velodyne.VLP16]} at {reception.address}" if reception.address else "",
    )


def _find_problems(settings: LidarSettings, stream: Vlp16Stream, reception: Reception) -> list[str]:
    counts, state = stream.counts, stream.clock.state()
    problems = []
    if not state.is_device and state.remedy:
        problems.append(f"scans are stamped with {state.text}; {state.remedy}")
    n_lost_on_way = counts.order.n_lost - reception.n_overflowed
    if n_lost_on_way > _MAX_LOST_SHARE * max(counts.n_data, 1):
        share = 100 * n_lost_on_way / (counts.n_data + n_lost_on_way)
        problems.append(
            f"{share:.1f} % of the packets were lost on the way: check cable and switch, and that the "
            "LiDAR's field of view is 0 to 359"
        )
    if reception.n_overflowed:
        problems.append(
            f"this computer was too slow for {reception.n_overflowed} packets: close other programs, and "
            f"{_raise_limit(reception)}"
        )
    packets_per_s = 1e9 / velodyne.packet_ns(stream.mode == velodyne.DUAL)
    buffer_s = reception.granted_bytes / PACKET_COST_BYTES / packets_per_s
    if 0 < buffer_s < _MIN_BUFFER_S:
        problems.append(f"the receive buffer holds {1000 * buffer_s:.0f} ms: {_raise_limit(reception)}")
    for what, n_bad in sorted(counts.bad.items()):
        if n_bad > _MAX_LOST_SHARE * counts.n_data:
            problems.append(f"{n_bad} {what} left out")
    if stream.rotor_hz and abs(stream.rotor_hz / settings.rate_hz - 1) > _MAX_OFF_RATE:
        problems.append(
            f"the rotor turns at {stream.rotor_hz:.1f} Hz, the profile says {settings.rate_hz:g}: set "
            f"rate_hz in the profile, or rpm {60 * settings.rate_hz:.0f} on the web page"
        )
    return problems


def _raise_limit(reception: Reception) -> str:
    now_kib = reception.granted_bytes // 2048
    return f"raise its limit, now {now_kib} KiB: sudo sysctl -w net.core.rmem_max=4194304"
