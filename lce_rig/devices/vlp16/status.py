"""How an attached VLP-16 does, as figures and findings."""

from collections import Counter
from dataclasses import dataclass, field

from lce_rig.core import velodyne
from lce_rig.core.findings import Finding
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.vlp16.packet_recorder import PcapRecorder
from lce_rig.devices.vlp16.socket import PACKET_COST_BYTES
from lce_rig.recordings.velodyne.stream import Vlp16Stream
from lce_rig.rig import LidarSettings

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
        n_overflowed: datagrams that the kernel dropped because they were not taken in time.
        granted_bytes: receive buffer of a port.
        strangers: datagrams of other senders, by IP address; the first few.
        n_strange: datagrams of other senders.
    """

    address: str = ""
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
    """Gather everything as figures and findings."""
    if stream is None:
        return SourceStatus(sensor)
    counts, state = stream.counts, stream.clock.state()
    ahead_ns = stream.clock.ahead_ns()
    figures = {
        "position_packets": float(counts.n_position),
        "bad_packets": float(counts.n_bad),
        "late_packets": float(counts.order.n_late),
        "overflowed_packets": float(reception.n_overflowed),
        "stranger_packets": float(reception.n_strange),
        "clock_steps": float(counts.order.n_steps),
        "receive_buffer_bytes": float(reception.granted_bytes),
        "is_dual": float(stream.mode == velodyne.DUAL),
    }
    problems = _find_problems(settings, stream, reception)
    if recorder is not None:
        figures["recorded_packets"] = float(recorder.n_written)
        figures["unrecorded_packets"] = float(recorder.n_dropped)
        problems += [recorder.failure] if recorder.failure is not None else []
    return SourceStatus(
        sensor,
        n_lost=counts.order.n_lost,
        clock=ClockState(state, stream.clock.is_utc, None if ahead_ns is None else ahead_ns * 1e-9),
        problems=tuple(problems),
        figures=figures,
        device=f"{velodyne.PRODUCTS[velodyne.VLP16]} at {reception.address}" if reception.address else "",
        rates_hz={"scans": stream.rotor_hz} if stream.rotor_hz else {},
        n_packets=counts.n_data,
    )


def _find_problems(settings: LidarSettings, stream: Vlp16Stream, reception: Reception) -> list[Finding]:
    counts, state = stream.counts, stream.clock.state()
    problems = [] if state.severity == "note" else [state]
    buffer_kib = reception.granted_bytes // 2048
    n_lost_on_way = counts.order.n_lost - reception.n_overflowed
    if n_lost_on_way > _MAX_LOST_SHARE * max(counts.n_data, 1):
        share = n_lost_on_way / (counts.n_data + n_lost_on_way)
        problems.append(Finding("stream.packets_lost", "warning", figures={"share": share}))
    if reception.n_overflowed:
        overflow = {"n": reception.n_overflowed, "buffer_kib": buffer_kib}
        problems.append(Finding("stream.computer_too_slow", "warning", figures=overflow))
    packets_per_s = 1e9 / velodyne.packet_ns(stream.mode == velodyne.DUAL)
    buffer_s = reception.granted_bytes / PACKET_COST_BYTES / packets_per_s
    if 0 < buffer_s < _MIN_BUFFER_S:
        figures = {"buffer_s": buffer_s, "buffer_kib": buffer_kib}
        problems.append(Finding("buffer.small", "warning", figures=figures))
    problems += [flaw for flaw in counts.flaws() if flaw.figure("n") > _MAX_LOST_SHARE * counts.n_data]
    if stream.rotor_hz and abs(stream.rotor_hz / settings.rate_hz - 1) > _MAX_OFF_RATE:
        rates = {
            "rotor_hz": stream.rotor_hz,
            "expected_hz": settings.rate_hz,
            "expected_rpm": 60 * settings.rate_hz,
        }
        problems.append(Finding("stream.rotor_rate", "warning", figures=rates))
    return problems
