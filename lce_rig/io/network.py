"""UDP datagrams in recordings of a network (pcap, pcapng), read by dpkt."""

import socket
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import dpkt  # type: ignore[import-untyped]

from lce_rig.core.bounds import BoundedPath
from lce_rig.core.errors import SourceError, reading, reason_of
from lce_rig.core.findings import Losses
from lce_rig.io import findings
from lce_rig.rig import DriverSettings
from lce_rig.timing.clock import NS_PER_S

FRAME_BYTES = 58
"""Bytes of a recorded datagram besides its payload: headers of pcap, Ethernet, IP and UDP."""
# Packets read to find a recording's sensors (1 s or less of one sensor); reasons listed in an error.
_N_SURVEYED, _MAX_SHOWN = 800, 6
# Class of a frame by link type, https://www.tcpdump.org/linktypes.html.
_FRAMES: dict[int, Any] = {
    0: dpkt.loopback.Loopback,
    1: dpkt.ethernet.Ethernet,
    **dict.fromkeys((12, 14, 101, 228), dpkt.ip.IP),
    108: dpkt.loopback.Loopback,
    113: dpkt.sll.SLL,
    276: dpkt.sll2.SLL2,
}
# Minimum fraction of a scan's packets or columns that must arrive.
MIN_COVERAGE = 0.5


@dataclass(frozen=True, eq=False)
class Datagram:
    """One UDP datagram.

    Attributes:
        host_ns: arrival at the host; 0 where unknown.
        source: IP address of the sender.
        port: UDP port it was sent to.
        payload: content of the datagram.
    """

    host_ns: int
    source: str
    port: int
    payload: bytes


class PcapFile:
    """A recording of a network.

    Attributes:
        path: the file.
        losses: incomplete datagrams; grows while the file is read.
        damage: the reason if the file could not be read to its end, else "".
    """

    def __init__(self, path: Path) -> None:
        """Check the format and the type of the recorded link.

        Raises:
            SourceError: not a network recording, or one of an unsupported link type.
        """
        self.path = path
        self.losses = Losses()
        self.damage = ""
        if not path.is_file():
            raise SourceError(f"{path}: not a file")
        hint = "Record the LiDAR's network interface (tcpdump -i eth0 -w FILE); decompress the file first."
        with reading(path, hint=hint), BoundedPath(path).open("rb") as file:
            self._link = dpkt.pcap.UniversalReader(file).datalink()
            if self._link not in _FRAMES:
                raise ValueError(f"recorded from a link of type {self._link}, which is not supported")

    def datagrams(self) -> Iterator[Datagram]:
        """Yield the whole UDP datagrams in the order of recording, up to where the file is damaged."""
        self.losses = Losses()
        self.damage = ""
        with BoundedPath(self.path).open("rb") as file:
            try:
                for stamp_s, raw in dpkt.pcap.UniversalReader(file):
                    # dpkt returns timestamps of ns as exact decimals, others as floats with 1 us resolution.
                    is_exact = isinstance(stamp_s, Decimal)
                    host_ns = int(stamp_s * NS_PER_S) if is_exact else round(stamp_s * 1e6) * 1000
                    datagram = self._read(raw, host_ns)
                    if datagram is not None:
                        yield datagram
            except Exception as error:  # dpkt's own, struct's, and others that damage leads to.
                self.damage = f"{reason_of(error)}; read up to byte {file.tell()}"

    def choose_sender(
        self, explain: Callable[[Datagram], str], what: str, lidar: str, driver: DriverSettings
    ) -> tuple[str, int]:
        """Choose the sensor (address, destination port) at the file's start: the profile's, or the only one.

        Args:
            explain: returns the reason for a datagram that is not from the LiDAR; "" for one that is.
            what: description of the LiDAR, for messages.
            lidar: the LiDAR's name in the profile.
            driver: its `driver` block in the profile.

        Raises:
            SourceError: no sender, or several of which none has the profile's address.
        """
        senders, others = Counter[tuple[str, int]](), Counter[str]()
        for n, datagram in enumerate(self.datagrams()):
            reason = explain(datagram)
            if reason:
                others[reason] += 1
            else:
                senders[datagram.source, datagram.port] += 1
            if senders.total() >= _N_SURVEYED or n >= 50 * _N_SURVEYED:
                break
        wanted = [s for s in senders if driver.address in (None, s[0]) and driver.port in (None, s[1])]
        wanted = wanted or list(senders)
        if len(wanted) == 1:
            return wanted[0]
        if wanted:
            several = ", ".join(f"{address} to port {port}" for address, port in sorted(wanted))
            hint = f"Set driver.address and driver.port of {lidar!r} in the profile to one of them."
            raise SourceError(f"{self.path}: packets of several LiDARs: {several}", hint)
        holds = [f"{n} {reason}" for reason, n in others.most_common(_MAX_SHOWN)] + self.account()
        hint = f"Record whole packets (tcpdump -s 0), or correct the model of {lidar!r} in the profile."
        causes = "; ".join(holds) or "no UDP packets at all"
        raise SourceError(f"{self.path}: holds no packets of {what}: {causes}", hint)

    def account(self) -> list[str]:
        """List the losses in words."""
        return findings.worded(self.losses) + ([self.damage] if self.damage else [])

    def _read(self, raw: bytes, host_ns: int) -> Datagram | None:
        """Extract the UDP datagram from a captured frame; None if incomplete or not UDP."""
        try:
            packet = _FRAMES[self._link](raw)
        except dpkt.Error:
            return None
        ip = packet if isinstance(packet, dpkt.ip.IP) else packet.data
        if not isinstance(ip, dpkt.ip.IP) or ip.p != dpkt.ip.IP_PROTO_UDP:
            return None
        udp = ip.data
        is_whole = isinstance(udp, dpkt.udp.UDP) and not (ip.mf or ip.offset)
        if not is_whole or not 8 <= udp.ulen <= 8 + len(udp.data):
            self.losses.add(findings.CUT_SHORT())
            return None
        return Datagram(host_ns, socket.inet_ntoa(ip.src), udp.dport, bytes(udp.data[: udp.ulen - 8]))
