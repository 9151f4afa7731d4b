"""A VLP-16 on the network: UDP packets in, scans of one revolution each out.

The kernel timestamps the arrival of datagrams and counts those that it drops.
"""

import contextlib
import errno
import select
import socket
import struct
import threading
import time
from collections import Counter

from lce_rig.core import velodyne
from lce_rig.core.data import Scan
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.devices import findings
from lce_rig.devices.reading import MAX_LOST_SHARE, MAX_OFF_RATE, READ_WAIT_S, LiveSource, SourceStatus
from lce_rig.io.network import Datagram
from lce_rig.io.velodyne_scans import Vlp16Stream, read_controls
from lce_rig.rig import LidarSettings
from lce_rig.timing.clock import NS_PER_S

SILENCE_S = 2.0
"""Longest silence before a LiDAR is lost: 1,500 packets."""
# Minimum duration of packets that the buffer must hold, s: the longest pause of a fast enough computer.
_MIN_BUFFER_S = 0.25
_GATHER_S = 0.005

# Two seconds of data packets, as the kernel accounts for them.
_WANTED_BUFFER_BYTES = 4 << 20
# Buffer space per data packet: its bytes, and the kernel's overhead.
_PACKET_COST_BYTES = 2304
# Datagrams read before other threads may run: 85 ms of data packets.
_MOST_AT_ONCE = 64
# Socket options of asm-generic/socket.h that Python does not define.
_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40
_MAX_PAYLOAD_BYTES, _ANCILLARY_BYTES = 2048, 256
_TIMESPEC = struct.Struct("@ll")


class Vlp16Source(LiveSource):
    """The scans of an attached VLP-16; open while its `with` block lasts.

    `driver.address` is the LiDAR's address, by default that of the first VLP-16 received; `driver.port` is
    the port of data packets (2368); `driver.controls`: see `read_controls`.

    Args:
        sensor: the sensor's name in the profile.
        settings: its block of the profile.
        silence_s: time without packets after which the sensor counts as lost.
    """

    def __init__(self, sensor: str, settings: LidarSettings, silence_s: float = SILENCE_S) -> None:
        super().__init__(sensor, sensor, silence_s)
        self._settings = settings
        self._port = settings.driver.port or velodyne.DATA_PORT
        self._lock = threading.Lock()
        self._stream: Vlp16Stream | None = None
        self._ports: tuple[UdpPort, ...] = ()
        self._early: list[Scan] = []
        self._address = ""
        self._strangers: Counter[str] = Counter()
        self._n_lost_before = 0

    def open(self) -> None:
        """Open the ports and wait for the first packet.

        Raises:
            SourceError: no packets arrive, or those of another model; a port is held by another program;
                velodyne-decoder is not installed.
        """
        stream = Vlp16Stream(self.sensor, self._settings)
        position_port, _ = read_controls(self.sensor, self._settings)
        data = UdpPort(self._port, f"{self.sensor}: data packets")
        self._ports = (data,)
        self._ports = data, UdpPort(position_port, f"{self.sensor}: position packets")
        with self._lock:
            self._n_lost_before += self._stream.losses.n("packet.lost") if self._stream is not None else 0
            self._stream, self._early = stream, []
            self._address, self._strangers = self._settings.driver.address or "", Counter()
        until_s = time.monotonic() + self._silence_s
        while not stream.n_data and not self.is_stopping:
            self._early = self.read()
            if not stream.n_data and time.monotonic() > until_s:
                raise self.explain_silence(has_sent=False)

    def read(self) -> list[Scan]:
        """Read the packets received, and return the scans that they complete.

        Raises:
            SourceError: the network failed.
        """
        assert self._stream is not None  # it is open
        scans, self._early = self._early, []
        ready, _, _ = select.select(self._ports, (), (), READ_WAIT_S)
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
            # Packets that arrive during the pause already have the kernel's timestamps: reading several at
            # once costs hardly more than one.
            time.sleep(_GATHER_S)
        return scans

    def close(self) -> None:
        """Close the ports."""
        for port in self._ports:
            port.close()
        self._ports = ()

    def describe(self) -> SourceStatus:
        """Report the state of the sensor; may be called from any thread."""
        with self._lock:
            stream, ports = self._stream, self._ports
            if stream is None:
                return SourceStatus(self.sensor)
            state = stream.clock.state()
            problems = [] if state.severity == "note" else [state]
            problems += self._find_losses(stream, ports)
            return SourceStatus(
                self.sensor,
                n_lost=stream.losses.n("packet.lost") + self._n_lost_before,
                clock=state,
                problems=tuple(problems),
                device=f"{stream.product.name} at {self._address}" if stream.n_data else "",
                rates_hz={"scans": stream.rotor_hz} if stream.rotor_hz else {},
                n_packets=stream.n_data,
            )

    def explain_silence(self, *, has_sent: bool) -> SourceError:
        """Find the likeliest reason."""
        assert self._stream is not None  # it was open
        sensor, port, address, flaws = self.sensor, self._port, self._address, self._stream.flaws()
        whose = f" from {address}" if address else ""
        began = (
            "data packets{} on UDP port {} have stopped" if has_sent else "no data packets{} on UDP port {}"
        )
        what = f"{sensor}: {began.format(whose, port)} (for {self._silence_s:g} s)"
        for model, _ in self._stream.other_models.most_common(1):
            wanted = self._stream.product.name
            what = f"{sensor}: the packets on UDP port {port} come from a {model}, not a {wanted}"
            return SourceError(what, f"Set the model of {sensor!r} in the profile, or check driver.address.")
        if flaws:
            bad = ", ".join(flaw.text for flaw in flaws)
            return SourceError(f"{what}: only {bad}", "Check which program sends to this port.")
        if self._strangers:
            there = ", ".join(sorted(self._strangers))
            return SourceError(what, f"Packets come from {there}: set driver.address in the profile.")
        hint = (
            "Check its power and cable, that this computer has an address in its network (192.168.1.x, mask "
            f"255.255.255.0), driver.address, and that the firewall lets UDP port {port} in."
        )
        return SourceError(what, hint)

    def _take(self, datagram: Datagram, stream: Vlp16Stream, *, is_data: bool) -> Scan | None:
        if self._address and datagram.source != self._address:
            self._strangers[datagram.source] += 1
            return None
        with self._lock:
            if not is_data:
                stream.push_position(datagram.payload)
                return None
            scan = stream.push_data(datagram.payload, datagram.host_ns)
            if stream.n_data and not self._address:
                self._address = datagram.source
            return scan

    def _find_losses(self, stream: Vlp16Stream, ports: "tuple[UdpPort, ...]") -> list[Finding]:
        """Find losses on the network, in the buffer and in decoding, and a rotor at another rate."""
        problems: list[Finding] = []
        n_overflowed = sum(port.n_overflowed for port in ports)
        granted_bytes = min((port.granted_bytes for port in ports), default=0)
        n_lost_on_way = stream.losses.n("packet.lost") - n_overflowed
        if n_lost_on_way > MAX_LOST_SHARE * max(stream.n_data, 1):
            problems.append(findings.PACKETS_LOST(share=n_lost_on_way / (stream.n_data + n_lost_on_way)))
        if n_overflowed:
            problems.append(findings.COMPUTER_TOO_SLOW(n=n_overflowed, buffer_kib=granted_bytes // 2048))
        packet_s = 1e-9 * stream.product.packet_ns(stream.mode == velodyne.DUAL)
        buffer_s = granted_bytes / _PACKET_COST_BYTES * packet_s
        if 0 < buffer_s < _MIN_BUFFER_S:
            problems.append(findings.BUFFER_SMALL(buffer_s=buffer_s, buffer_kib=granted_bytes // 2048))
        problems += [flaw for flaw in stream.flaws() if flaw.figure("n") > MAX_LOST_SHARE * stream.n_data]
        rotor_hz, rate_hz = stream.rotor_hz, self._settings.rate_hz
        if rotor_hz and abs(rotor_hz / rate_hz - 1) > MAX_OFF_RATE:
            rotor = findings.ROTOR_RATE(rotor_hz=rotor_hz, expected_hz=rate_hz, expected_rpm=60 * rate_hz)
            problems.append(rotor)
        return problems


class UdpPort:
    """An open UDP port; other programs may listen on the same one.

    Attributes:
        port: its number.
        granted_bytes: receive buffer that the kernel granted.
        n_overflowed: datagrams that the kernel dropped because they were not read in time.
    """

    def __init__(self, port: int, what: str) -> None:
        """Open the port.

        Args:
            port: port number.
            what: use of the port, for messages: "lidar: data packets".

        Raises:
            SourceError: another program uses the port exclusively, or permission is missing.
        """
        self.port = port
        self.n_overflowed = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WANTED_BUFFER_BYTES)
            for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
                # Without the first, timestamps are slightly late; without the second, drops look like network
                # losses.
                with contextlib.suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, option, 1)
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            if error.errno == errno.EADDRINUSE:
                hint = f"Stop the other program (ROS driver, VeloView): `ss -ulpn sport = :{port}` names it."
                raise SourceError(f"{what}: UDP port {port} is held by another program", hint) from None
            is_low = port < 1024
            hint = "Ports below 1024 need root; set driver.port as on the LiDAR's web page." if is_low else ""
            raise SourceError(f"{what}: UDP port {port} cannot be opened: {error.strerror}", hint) from None
        # Linux doubles the requested size for its own overhead, and reports the double.
        self.granted_bytes = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def fileno(self) -> int:
        """Return the file descriptor, to wait on."""
        return self._socket.fileno()

    def receive_many(self) -> list[Datagram]:
        """Return the waiting datagrams, at most 64; never waits.

        Raises:
            OSError: the network failed.
        """
        datagrams: list[Datagram] = []
        with contextlib.suppress(BlockingIOError):
            while len(datagrams) < _MOST_AT_ONCE:
                datagrams.append(self._receive())
        return datagrams

    def close(self) -> None:
        """Close the port."""
        self._socket.close()

    def _receive(self) -> Datagram:
        payload, ancillary, _, (address, _) = self._socket.recvmsg(
            _MAX_PAYLOAD_BYTES, _ANCILLARY_BYTES, socket.MSG_DONTWAIT
        )
        host_ns = 0
        for level, kind, data in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, ns = _TIMESPEC.unpack_from(data)
                host_ns = seconds * NS_PER_S + ns
            elif (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                (self.n_overflowed,) = struct.unpack_from("@I", data)
        return Datagram(host_ns or time.time_ns(), address, self.port, payload)
