"""UDP datagrams in the frames of network recordings: unpacking and packing.

References:
    https://www.tcpdump.org/linktypes.html; RFC 791 (IPv4), RFC 768 (UDP); IEEE 802.1Q (VLAN tags)
"""

import socket
import struct
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import BinaryIO

_UDP = 17
_IPV4 = 0x0800
_VLANS = (0x8100, 0x88A8, 0x9100)
# The sensor's own maker; what the sensor broadcasts goes to every card.
_SENSOR_CARD, _EVERY_CARD = bytes.fromhex("607688000000"), b"\xff" * 6


@dataclass(frozen=True, eq=False)
class Datagram:
    """One UDP datagram.

    Attributes:
        host_ns: arrival at the host; 0 where unknown.
        source: IP address of the sender.
        source_port, port: UDP ports it was sent from and to.
        payload: what it carries.
    """

    host_ns: int
    source: str
    source_port: int
    port: int
    payload: bytes


def _skip_ethernet(frame: bytes) -> int | None:
    at = 12
    while len(frame) >= at + 2 and int.from_bytes(frame[at : at + 2], "big") in _VLANS:
        at += 4
    return at + 2 if int.from_bytes(frame[at : at + 2], "big") == _IPV4 else None


def _skip_sll(frame: bytes) -> int | None:
    return 16 if int.from_bytes(frame[14:16], "big") == _IPV4 else None


def _skip_sll2(frame: bytes) -> int | None:
    return 20 if int.from_bytes(frame[0:2], "big") == _IPV4 else None


def _skip_nothing(_frame: bytes) -> int | None:
    return 0


def _skip_family(frame: bytes) -> int | None:
    """Skip an address family, in the byte order of the machine that recorded."""
    family = socket.AF_INET.value
    return 4 if frame[:4] in (struct.pack("<I", family), struct.pack(">I", family)) else None


#: Where IPv4 begins in a frame, by link type; None where the frame carries something else.
LINKS: dict[int, Callable[[bytes], int | None]] = {
    0: _skip_family,
    1: _skip_ethernet,
    12: _skip_nothing,
    14: _skip_nothing,
    101: _skip_nothing,
    108: _skip_family,
    113: _skip_sll,
    228: _skip_nothing,
    276: _skip_sll2,
}
#: Link types that are met now and then, and not read.
OTHER_LINKS = {
    9: "PPP",
    105: "802.11 wireless",
    119: "Prism wireless",
    127: "802.11 radiotap",
    147: "user-defined",
    192: "PPI",
    220: "USB (Linux)",
    229: "raw IPv6",
    249: "USB (Windows)",
    253: "netlink",
}
ETHERNET = 1


def read_datagram(link: int, host_ns: int, frame: bytes, flaws: Counter[str]) -> Datagram | None:
    """Take the UDP datagram out of a frame; None where there is no whole one.

    Args:
        link: link type, of LINKS.
        host_ns: arrival at the host.
        frame: as recorded, maybe cut short.
        flaws: counts datagrams that are not whole, by the code of what is wrong with them.
    """
    ip = LINKS[link](frame)
    if ip is None or len(frame) < ip + 20 or frame[ip] >> 4 != 4 or frame[ip + 9] != _UDP:
        return None
    udp = ip + 4 * (frame[ip] & 0x0F)
    if int.from_bytes(frame[ip + 6 : ip + 8], "big") & 0x3FFF:
        flaws["datagram.fragmented"] += 1
        return None
    if len(frame) < udp + 8:
        flaws["datagram.cut_short"] += 1
        return None
    source_port, port, length = struct.unpack_from(">HHH", frame, udp)
    if length < 8 or udp + length > len(frame):
        flaws["datagram.cut_short"] += 1
        return None
    source = socket.inet_ntoa(frame[ip + 12 : ip + 16])
    return Datagram(host_ns, source, source_port, port, frame[udp + 8 : udp + length])


def build_frame(datagram: Datagram) -> bytes:
    """Build the Ethernet frame of a datagram that was broadcast, as the sensor sends it when new."""
    length = 8 + len(datagram.payload)
    udp = struct.pack(">HHHH", datagram.source_port, datagram.port, length, 0)
    addresses = socket.inet_aton(datagram.source) + b"\xff" * 4
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + length, 0, 0x4000, 64, _UDP, 0) + addresses
    ip = ip[:10] + struct.pack(">H", _checksum(ip)) + ip[12:]
    ethernet = _EVERY_CARD + _SENSOR_CARD + struct.pack(">H", _IPV4)
    return ethernet + ip + udp + datagram.payload


def _checksum(header: bytes) -> int:
    total: int = sum(struct.unpack(f">{len(header) // 2}H", header))
    total = (total & 0xFFFF) + (total >> 16)
    return ~(total + (total >> 16)) & 0xFFFF


_NS_MAGIC = 0xA1B23C4D
_MAX_FRAME_BYTES = 65535
_NS_PER_S = 1_000_000_000


class PcapWriter:
    """A pcap file that tcpdump, Wireshark and VeloView open, with arrivals in ns; a context manager.

    Every second it is handed to the operating system. Torn off anywhere, it is read up to there.

    Raises:
        FileExistsError: the file is there already.
        OSError: it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("xb")
        self._file.write(struct.pack("<IHHiIII", _NS_MAGIC, 2, 4, 0, 0, _MAX_FRAME_BYTES, ETHERNET))
        self._flushed_ns = 0

    def write(self, datagram: Datagram) -> None:
        """Append a datagram.

        Raises:
            OSError: it cannot be written; the disk may be full.
        """
        frame = build_frame(datagram)
        seconds, ns = divmod(datagram.host_ns, _NS_PER_S)
        self._file.write(struct.pack("<IIII", seconds, ns, len(frame), len(frame)) + frame)
        if datagram.host_ns - self._flushed_ns > _NS_PER_S:
            self._file.flush()
            self._flushed_ns = datagram.host_ns

    def close(self) -> None:
        """Write what waits, and close the file.

        Raises:
            OSError: it cannot be written; the disk may be full.
        """
        self._file.close()

    def __enter__(self) -> "PcapWriter":
        """Write within a `with` block."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the file."""
        self.close()
