"""A VLP-16 on the network: UDP packets in, scans of one revolution each out."""

import select
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.core.phrasing import as_line
from lce_rig.devices import findings
from lce_rig.devices.disk_writer import DiskWriter, Sink
from lce_rig.devices.protocol import ClockState, SourceStatus
from lce_rig.devices.reading import LiveSource
from lce_rig.devices.udp_port import PACKET_COST_BYTES, UdpPort
from lce_rig.devices.velodyne_web import VelodyneWeb, find_problems
from lce_rig.io.network import Datagram, PcapWriter
from lce_rig.io.velodyne.stream import Vlp16Stream, read_controls
from lce_rig.rig import LidarSettings

SILENCE_S = 2.0
# Half a second of scans: a slower taker wants the newest.
N_SLOTS = 5

# A computer that is busy elsewhere for longer than this is too slow anyhow.
_MIN_BUFFER_S = 0.25
_MAX_LOST_SHARE = 0.01
_MAX_OFF_RATE = 0.05
_N_STRANGERS = 8
_WAIT_S = 0.1
_GATHER_S = 0.005
_WEB_TIMEOUT_S = 1.0
_EVERYBODY = "255.255.255.255"
_MAX_SHOWN = 3


@dataclass
class Reception:
    """Figures of the packets' reception by the host.

    Attributes:
        address: whose packets are taken; "" before the first.
        serial: the sensor's serial number, by its web page; "" until that has answered.
        n_overflowed: datagrams that the kernel dropped because they were not taken in time.
        granted_bytes: receive buffer of a port.
        strangers: datagrams of other senders, by IP address; the first few.
        n_strange: datagrams of other senders.
    """

    address: str = ""
    serial: str = ""
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
    recorder: Sink[Datagram] | None,
) -> SourceStatus:
    """Gather everything as figures and findings."""
    if stream is None:
        return SourceStatus(sensor)
    losses, state = stream.losses, stream.clock.state()
    ahead_ns = stream.clock.ahead_ns()
    figures = {
        "position_packets": float(stream.n_position),
        "bad_packets": float(sum(flaw.figure("n") for flaw in stream.flaws())),
        "late_packets": float(losses.n("packet.late")),
        "overflowed_packets": float(reception.n_overflowed),
        "stranger_packets": float(reception.n_strange),
        "clock_steps": float(losses.n("packet.clock_set")),
        "receive_buffer_bytes": float(reception.granted_bytes),
        "is_dual": float(stream.mode == velodyne.DUAL),
    }
    problems = [] if state.severity == "note" else [state]
    buffer_kib = reception.granted_bytes // 2048
    n_lost_on_way = losses.n("packet.lost") - reception.n_overflowed
    if n_lost_on_way > _MAX_LOST_SHARE * max(stream.n_data, 1):
        share = n_lost_on_way / (stream.n_data + n_lost_on_way)
        problems.append(findings.PACKETS_LOST(share=share))
    if reception.n_overflowed:
        problems.append(findings.COMPUTER_TOO_SLOW(n=reception.n_overflowed, buffer_kib=buffer_kib))
    packet_s = 1e-9 * stream.product.packet_ns(stream.mode == velodyne.DUAL)
    buffer_s = reception.granted_bytes / PACKET_COST_BYTES * packet_s
    if 0 < buffer_s < _MIN_BUFFER_S:
        problems.append(findings.BUFFER_SMALL(buffer_s=buffer_s, buffer_kib=buffer_kib))
    problems += [flaw for flaw in stream.flaws() if flaw.figure("n") > _MAX_LOST_SHARE * stream.n_data]
    rotor_hz, rate_hz = stream.rotor_hz, settings.rate_hz
    if rotor_hz and abs(rotor_hz / rate_hz - 1) > _MAX_OFF_RATE:
        rotor = findings.ROTOR_RATE(rotor_hz=rotor_hz, expected_hz=rate_hz, expected_rpm=60 * rate_hz)
        problems.append(rotor)
    if recorder is not None:
        figures["recorded_packets"] = float(recorder.n_written)
        figures["unrecorded_packets"] = float(recorder.n_dropped)
        problems += recorder.findings()
    return SourceStatus(
        sensor,
        n_lost=losses.n("packet.lost"),
        clock=ClockState(state, stream.clock.is_utc, None if ahead_ns is None else ahead_ns * 1e-9),
        problems=tuple(problems),
        figures=figures,
        device=f"{stream.product.name} at {reception.address}" if reception.address else "",
        serial=reception.serial,
        rates_hz={"scans": stream.rotor_hz} if stream.rotor_hz else {},
        n_packets=stream.n_data,
    )


def explain_silence(
    sensor: str,
    settings: LidarSettings,
    stream: Vlp16Stream,
    reception: Reception,
    silence_s: float,
    web_port: int,
) -> SourceError:
    """Find the likeliest reason; the sensor's web page is asked."""
    port, address = settings.driver.port or velodyne.DATA_PORT, settings.driver.address
    whose = f" from {address}" if address else ""
    began = "have stopped" if stream.n_data else "come"
    none = "" if stream.n_data else "no "
    what = f"{sensor}: {none}data packets{whose} on UDP port {port} {began} (for {silence_s:g} s)"
    others = stream.other_models.most_common(1)
    if others:
        wanted = stream.product.name
        return SourceError(
            f"{sensor}: the packets on UDP port {port} come from a {others[0][0]}, not a {wanted}",
            f"Set the model of {sensor!r} in the profile, or check driver.address.",
        )
    flaws = stream.flaws()
    if flaws:
        bad = ", ".join(flaw.text for flaw in flaws[:_MAX_SHOWN])
        return SourceError(f"{what}: only {bad}", "Check which program sends to this port.")
    if reception.strangers:
        there = ", ".join(sorted(reception.strangers))
        return SourceError(what, f"Packets come from {there}: set driver.address in the profile.")
    address = address or velodyne.FACTORY_ADDRESS
    try:
        report = VelodyneWeb(address, web_port, _WEB_TIMEOUT_S).read()
    except SourceError:
        return SourceError(
            what,
            f"Its web page http://{address} does not answer either. Check its power and cable; that this "
            "computer has an address in its network (192.168.1.x, mask 255.255.255.0); and driver.address.",
        )
    advice = [as_line(problem.sentence) for problem in find_problems(report, settings)]
    if report.host and report.host != _EVERYBODY:
        advice.append(f"Data go to {report.host} only: check that this is this computer.")
    firewall = f"Open UDP port {port} in this computer's firewall (sudo ufw allow {port}/udp)."
    return SourceError(what, " ".join([f"Its web page http://{address} answers.", *(advice or [firewall])]))


class Vlp16Source(LiveSource):
    """The scans of an attached VLP-16; open while its `with` block lasts.

    `driver.address` is whose packets are taken, those of the VLP-16 heard first where it is not set;
    `driver.port` is the port of data packets (2368); `driver.controls` as `read_controls` reads them.

    Attributes:
        sensor: its name in the profile.
    """

    def __init__(
        self,
        sensor: str,
        settings: LidarSettings,
        *,
        silence_s: float = SILENCE_S,
        n_slots: int = N_SLOTS,
        web_port: int = 80,
    ) -> None:
        """Take the settings; nothing is opened yet.

        Args:
            sensor: its name in the profile.
            settings: its block of the profile.
            silence_s: without packets for so long, it is taken to be gone.
            n_slots: scans that wait for a slow taker; the oldest are dropped.
            web_port: of the sensor's web server, which is asked when no packets come.
        """
        super().__init__(sensor, sensor, n_slots, silence_s)
        self._settings = settings
        self._web_port = web_port
        self._lock = threading.Lock()
        self._reception = Reception()
        self._stream: Vlp16Stream | None = None
        self._recorder: Sink[Datagram] | None = None
        self._ports: tuple[UdpPort, ...] = ()
        self._early: list[Scan] = []
        self._n_lost_before = 0

    def record_packets(self, folder: Path, disk: DiskWriter) -> bool:
        """Have all packets written to SENSOR.pcap.

        Raises:
            SourceError: the file exists already, or cannot be made.
        """
        path = folder / f"{self.sensor}.pcap"
        try:
            writer = PcapWriter(path)
        except FileExistsError:
            raise SourceError(f"{path} exists already", "Move it away, or record elsewhere.") from None
        except OSError as error:
            raise SourceError(f"{path} cannot be written: {error.strerror}") from None
        self._recorder = disk.add(path, writer.write, writer.close)
        return True

    def open(self) -> None:
        """Open the ports and wait for the first packet.

        Raises:
            SourceError: no packets come, or those of another model; a port is held by another program;
                velodyne-decoder is not installed.
        """
        with self._lock:
            self._n_lost_before += self._stream.losses.n("packet.lost") if self._stream is not None else 0
            self._stream, self._reception = Vlp16Stream(self.sensor, self._settings), Reception()
        position_port, _ = read_controls(self.sensor, self._settings)
        data = UdpPort(self._settings.driver.port or velodyne.DATA_PORT, f"{self.sensor}: data packets")
        self._ports = (data,)
        self._ports = data, UdpPort(position_port, f"{self.sensor}: position packets")
        self._early = []
        until_s = time.monotonic() + self._silence_s
        while not self._stream.n_data and not self.is_stopping:
            self._early = self.read()
            if not self._stream.n_data and time.monotonic() > until_s:
                raise self.explain_silence(has_sent=False)
        # Packets hold no serial number, and must not wait until a web page has answered.
        reception = self._reception
        address = self._settings.driver.address or reception.address

        def ask_serial() -> None:
            with suppress(SourceError):
                reception.serial = VelodyneWeb(address, self._web_port, _WEB_TIMEOUT_S).read_serial()

        if address:
            threading.Thread(target=ask_serial, daemon=True).start()

    def read(self) -> list[Scan]:
        """Take the packets that came, and give the scans that they complete.

        Raises:
            SourceError: the network failed.
        """
        assert self._stream is not None  # it is open
        scans, self._early = self._early, []
        ready, _, _ = select.select(self._ports, (), (), _WAIT_S)
        n_before = self._stream.n_data
        try:
            for port in ready:
                for datagram in port.receive_many():
                    scan = self._take(datagram, self._stream, is_data=port is self._ports[0])
                    scans += [] if scan is None else [scan]
        except OSError as error:
            what = f"{self.sensor}: the network failed: {error.strerror}"
            raise SourceError(what, "Check the cable.") from None
        if self._stream.n_data > n_before:
            self.note_heard()
            # The kernel has stamped what comes meanwhile: several packets cost hardly more than one.
            time.sleep(_GATHER_S)
        return scans

    def close(self) -> None:
        """Close the ports."""
        for port in self._ports:
            port.close()
        self._ports = ()

    def explain_silence(self, *, has_sent: bool) -> SourceError:
        """Find the likeliest reason; the sensor's web page is asked."""
        assert self._stream is not None  # it was open
        return explain_silence(
            self.sensor, self._settings, self._stream, self._reception, self._silence_s, self._web_port
        )

    def describe(self) -> SourceStatus:
        """Report the state of the sensor; may be called from any thread."""
        with self._lock:
            reception, ports = self._reception, self._ports
            reception.n_overflowed = sum(port.n_overflowed for port in ports)
            reception.granted_bytes = min((port.granted_bytes for port in ports), default=0)
            status = to_status(self.sensor, self._settings, self._stream, reception, self._recorder)
            return replace(status, n_lost=status.n_lost + self._n_lost_before)

    def _take(self, datagram: Datagram, stream: Vlp16Stream, *, is_data: bool) -> Scan | None:
        address = self._settings.driver.address or self._reception.address
        if address and datagram.source != address:
            self._reception.see_stranger(datagram.source)
            return None
        if self._recorder is not None:
            self._recorder.put(datagram, len(datagram.payload))
        with self._lock:
            if not is_data:
                stream.push_position(datagram.payload)
                return None
            scan = stream.push_data(datagram.payload, datagram.host_ns)
            if stream.n_data and not self._reception.address:
                self._reception.address = datagram.source
            return scan
