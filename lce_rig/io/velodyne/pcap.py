"""A network recording as a stream of VLP-16 scans, with the live decoder."""

import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from lce_rig.core import limits, velodyne
from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.findings import Finding
from lce_rig.io.fingerprint import fingerprint
from lce_rig.io.protocol import SourceOptions, Span
from lce_rig.io.sensor_choice import choose_lidar
from lce_rig.io.velodyne.datagrams import LINKS, OTHER_LINKS, Datagram, read_datagram
from lce_rig.io.velodyne.packet import BadPacketError, OtherModelError, read_data_packet
from lce_rig.io.velodyne.points import DUAL_NOTE, OFFSETS_NOTE
from lce_rig.io.velodyne.stream import Vlp16Stream
from lce_rig.rig import LidarSettings, Rig
from lce_rig.words import describe

# Files of network recorders: pcap (tcpdump, VeloView) and pcapng (Wireshark), complete or truncated.
#
# References:
#     https://www.ietf.org/archive/id/draft-ietf-opsawg-pcap-05.html
#     https://www.ietf.org/archive/id/draft-ietf-opsawg-pcapng-03.html

# Recorders keep no frame longer than 256 KiB: what claims to be is damage.
_MAX_FRAME_BYTES = 1 << 18
_MAX_BLOCK_BYTES = 1 << 24
_NS_PER_S = 1_000_000_000
_US_MAGIC, _NS_MAGIC, _SECTION = 0xA1B2C3D4, 0xA1B23C4D, 0x0A0D0D0A
_INTERFACE, _OLD_PACKET, _SIMPLE_PACKET, _PACKET = 1, 2, 3, 6
_RESOLUTION_OPTION, _OFFSET_OPTION = 9, 14


class _TornError(Exception):
    """The file ends, or becomes invalid, within a record."""


@dataclass(frozen=True)
class _Interface:
    """What a pcapng file says of the network card that frames came from."""

    link: int
    ticks_per_s: int = 1_000_000
    offset_s: int = 0


class PcapFile:
    """One recording of a network.

    Attributes:
        path: the file.
        flaws: datagrams that could not be read, by the code of what is wrong; grows while it is read.
        damage: where the file ends before its end, in words; "" before that is known, or where it is whole.
        n_bytes_read: how far the last reading has come.
    """

    def __init__(self, path: Path) -> None:
        """Look at the beginning.

        Raises:
            SourceError: it is not a recording of a network, or of a kind of network that is not read.
        """
        self.path = path
        self.flaws: Counter[str] = Counter()
        self.damage = ""
        self.n_bytes_read = 0
        with reading(path, SourceError), limits.open_regular(path) as file:
            head = file.read(24)
        self._order, self._ns_per_tick, self._link = _read_head(path, head)
        if self._link is not None:
            self._check_link(self._link)

    def datagrams(self) -> Iterator[Datagram]:
        """Yield the UDP datagrams, whole ones only, in the order they were recorded.

        A file that is torn is read as far as it goes; `damage` says so then.

        Raises:
            SourceError: a card of a kind that is not read.
        """
        self.flaws.clear()
        self.damage = ""
        with limits.open_regular(self.path) as file:
            frames = self._blocks(file) if self._link is None else self._records(file, self._link)
            try:
                for link, host_ns, frame in frames:
                    self.n_bytes_read = file.tell()
                    datagram = read_datagram(link, host_ns, frame, self.flaws)
                    if datagram is not None:
                        yield datagram
            except _TornError as error:
                self.damage = f"{error}; read up to byte {self.n_bytes_read}"

    def _records(self, file: BinaryIO, link: int) -> Iterator[tuple[int, int, bytes]]:
        """Yield link type, arrival and content of a pcap file's frames."""
        file.seek(24)
        header = struct.Struct(f"{self._order}IIII")
        while head := file.read(header.size):
            seconds, fraction, length, _ = header.unpack(_whole(head, header.size))
            if length > _MAX_FRAME_BYTES or fraction * self._ns_per_tick >= 2 * _NS_PER_S:
                raise _TornError("a frame's header is invalid")
            frame = _whole(file.read(length), length)
            yield link, seconds * _NS_PER_S + fraction * self._ns_per_tick, frame

    def _blocks(self, file: BinaryIO) -> Iterator[tuple[int, int, bytes]]:
        """Yield link type, arrival and content of a pcapng file's frames."""
        file.seek(0)
        order, interfaces = "<", list[_Interface]()
        while head := file.read(8):
            kind, length = struct.unpack(f"{order}II", _whole(head, 8))
            if kind == _SECTION:
                order = _section_order(_whole(file.read(4), 4))
                file.seek(-4, 1)
                length, interfaces = struct.unpack(f"{order}I", head[4:])[0], []
            if length < 12 or length % 4 or length > _MAX_BLOCK_BYTES:
                raise _TornError("a block's header is invalid")
            body = _whole(file.read(length - 8), length - 8)[:-4]
            if kind == _INTERFACE:
                interfaces.append(_read_interface(order, body))
                self._check_link(interfaces[-1].link)
            elif kind in (_PACKET, _OLD_PACKET, _SIMPLE_PACKET):
                yield _read_packet(order, kind, body, interfaces)

    def _check_link(self, link: int) -> None:
        if link not in LINKS:
            name = OTHER_LINKS.get(link, "unknown")
            what = f"{self.path}: recorded from a link of type {link} ({name}), which is not read"
            raise SourceError(what, "Record the Ethernet card that the LiDAR is on: tcpdump -i eth0 -w FILE")


def _whole(data: bytes, n_bytes: int) -> bytes:
    if len(data) < n_bytes:
        raise _TornError("it ends within a frame, as if the recorder was killed")
    return data


def _read_head(path: Path, head: bytes) -> tuple[str, int, int | None]:
    """Return byte order, ns per tick and link type; None for pcapng, where each card has its own."""
    magic = head[:4]
    for order in "<>":
        for value, ns_per_tick in ((_US_MAGIC, 1000), (_NS_MAGIC, 1)):
            if magic == struct.pack(f"{order}I", value):
                if len(head) < 24:
                    raise SourceError(f"{path}: ends within its header, nothing was recorded")
                return order, ns_per_tick, struct.unpack_from(f"{order}I", head, 20)[0] & 0x0FFFFFFF
    if magic == struct.pack("<I", _SECTION):
        return "<", 1, None
    if not head:
        raise SourceError(f"{path} is empty", "Record the network card that the LiDAR is on.")
    hint = "Unpack it with gunzip first." if magic[:2] == b"\x1f\x8b" else ""
    raise SourceError(f"{path} is not a pcap or pcapng file", hint)


def _section_order(magic: bytes) -> str:
    for order in "<>":
        if magic == struct.pack(f"{order}I", 0x1A2B3C4D):
            return order
    raise _TornError("a section has no byte order")


def _read_interface(order: str, body: bytes) -> _Interface:
    if len(body) < 8:
        raise _TornError("a card's description is too short")
    (link,) = struct.unpack_from(f"{order}H", body)
    ticks_per_s, offset_s, at = 1_000_000, 0, 8
    while at + 4 <= len(body):
        code, length = struct.unpack_from(f"{order}HH", body, at)
        value = body[at + 4 : at + 4 + length]
        if code == _RESOLUTION_OPTION and len(value) == 1:
            ticks_per_s = 2 ** (value[0] & 0x7F) if value[0] & 0x80 else 10 ** value[0]
        elif code == _OFFSET_OPTION and len(value) == 8:
            (offset_s,) = struct.unpack(f"{order}q", value)
        at += 4 + length + -length % 4
    return _Interface(link, ticks_per_s, offset_s)


def _read_packet(order: str, kind: int, body: bytes, interfaces: list[_Interface]) -> tuple[int, int, bytes]:
    if kind == _SIMPLE_PACKET:
        if len(body) < 4 or not interfaces:
            raise _TornError("a frame has no card")
        (length,) = struct.unpack_from(f"{order}I", body)
        return interfaces[0].link, 0, body[4 : 4 + length]
    if len(body) < 20:
        raise _TornError("a frame's block is too short")
    card, high, low, length, _ = struct.unpack_from(f"{order}IIIII", body)
    if kind == _OLD_PACKET:
        (card,) = struct.unpack_from(f"{order}H", body)
    if card >= len(interfaces) or length > len(body) - 20:
        raise _TornError("a frame has no card, or is longer than its block")
    interface = interfaces[card]
    seconds, ticks = divmod(high << 32 | low, interface.ticks_per_s)
    host_ns = (seconds + interface.offset_s) * _NS_PER_S + ticks * _NS_PER_S // interface.ticks_per_s
    return interface.link, host_ns, body[20 : 20 + length]


# So many data packets, per second or less of one sensor, show which sensors were recorded.
_SURVEY_PACKETS = 800
_MAX_SHOWN = 6


@dataclass
class _Survey:
    """The contents of a recording's start.

    Attributes:
        senders: data packets of the LiDAR by IP address.
        others: data packets of other models by name.
        refused: packets of the right length that are not data packets, by the code of what is wrong.
        ports: all UDP packets by the port they were sent to.
        n_bytes: how much of the file this is.
    """

    senders: Counter[str] = field(default_factory=Counter)
    others: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    ports: Counter[int] = field(default_factory=Counter)
    n_bytes: int = 0


class PcapRecording:
    """The scans of one Velodyne in a pcap or pcapng file.

    Attributes:
        path: the file.
        notes: which sensor was taken, and after reading what was skipped and why.
        key: fingerprint of the file.
        n_samples: number of scans to come, estimated from the file's size.
        streams: the LiDAR's scans; their span, by arrival, is found only where they are part of a recording.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the sensor's packets.

        Raises:
            SourceError: it is not a recording of the network, holds no packets of a VLP-16, or those of
                several of which none has the profile's address; velodyne-decoder is not installed.
        """
        self.path = path
        self.notes: list[str] = []
        self._file = PcapFile(path)
        self._lidar = choose_lidar(rig, options, self.notes)
        self._settings: LidarSettings = rig.lidars[self._lidar]
        self._product = Vlp16Stream(self._lidar, self._settings).product
        survey = self._survey()
        self._address = self._choose(survey)
        self.key = fingerprint([path])
        self.streams: Mapping[Stream, Span | None] = {
            Stream(self._lidar, "", "scans"): self._span_ns() if options.is_part else None
        }
        n_packets = survey.senders[self._address] * path.stat().st_size / max(survey.n_bytes, 1)
        sweep_s = n_packets * self._product.packet_ns(is_dual=False) * 1e-9
        self.n_samples = max(1, round(sweep_s * self._settings.rate_hz))

    def samples(self) -> Iterator[Scan]:
        """Yield the scans, in order of time.

        Packets that are damaged, late or lost are counted in `notes`.

        Raises:
            SourceError: not one whole revolution was recorded; velodyne-decoder is not installed.
        """
        stream = Vlp16Stream(self._lidar, self._settings)
        try:
            for datagram in self._file.datagrams():
                scan = _push(stream, datagram) if datagram.source == self._address else None
                if scan is not None:
                    yield scan
            scan = stream.finish()
            if scan is not None:
                yield scan
        finally:
            self._summarise(stream)
        if stream.n_scans == 0:
            said = "; ".join(stream.account()) or f"{stream.n_data} packets are less than a revolution"
            raise SourceError(f"{self.path}: no whole revolution in it: {said}", "Record at least 1 s.")

    def _survey(self) -> _Survey:
        survey = _Survey()
        for datagram in self._file.datagrams():
            survey.ports[datagram.port] += 1
            if len(datagram.payload) == velodyne.DATA_BYTES:
                try:
                    read_data_packet(datagram.payload, datagram.host_ns, self._product)
                    survey.senders[datagram.source] += 1
                except OtherModelError as error:
                    survey.others[error.model] += 1
                except BadPacketError as error:
                    survey.refused[error.code] += 1
            n_found = survey.senders.total() + survey.others.total()
            if n_found >= _SURVEY_PACKETS or (n_found and survey.ports.total() >= 50 * _SURVEY_PACKETS):
                break
        survey.n_bytes = self._file.n_bytes_read
        return survey

    def _span_ns(self) -> Span | None:
        arrivals_ns = [
            datagram.host_ns
            for datagram in self._file.datagrams()
            if datagram.source == self._address and len(datagram.payload) == velodyne.DATA_BYTES
        ]
        return (min(arrivals_ns), max(arrivals_ns)) if any(arrivals_ns) else None

    def _choose(self, survey: _Survey) -> str:
        """Choose the sender whose packets are taken."""
        wanted = self._settings.driver.address
        if wanted in survey.senders:
            return str(wanted)
        if len(survey.senders) == 1:
            address = next(iter(survey.senders))
            self.notes.append(f"{self.path.name}: packets of {address}, the only {self._product.name} in it")
            return address
        if survey.senders:
            there = ", ".join(sorted(survey.senders))
            hint = f"Set driver.address of {self._lidar!r} in the profile to one of them."
            raise SourceError(f"{self.path}: packets of several LiDARs, none of them {wanted}: {there}", hint)
        if survey.others:
            models = ", ".join(f"{n} of {model}" for model, n in survey.others.most_common())
            read = ", ".join(each.name for each in velodyne.READ)
            raise SourceError(
                f"{self.path}: holds packets of another LiDAR ({models}), not of a {self._product.name}",
                f"Set model of {self._lidar!r} in the profile; read are {read}. Record others in a bag.",
            )
        raise SourceError(
            f"{self.path}: holds no packets of a {self._product.name}: {self._what_is_there(survey)}"
        )

    def _what_is_there(self, survey: _Survey) -> str:
        wrong = survey.refused + self._file.flaws
        if wrong:
            cut = " (record with tcpdump -s 0)" if "datagram.cut_short" in wrong else ""
            return ", ".join(describe(_flaw(code, n)) for code, n in wrong.most_common(_MAX_SHOWN)) + cut
        ports = ", ".join(f"{n} to {port}" for port, n in survey.ports.most_common(_MAX_SHOWN))
        there = f"UDP packets by port: {ports}" if ports else "no UDP packets at all"
        return f"{there}; {self._file.damage}" if self._file.damage else there

    def _summarise(self, stream: Vlp16Stream) -> None:
        lines = [OFFSETS_NOTE, *([DUAL_NOTE] if stream.mode == velodyne.DUAL else [])]
        lines.append(describe(stream.clock.state()))
        lines += stream.account()
        lines += [describe(_flaw(code, n)) for code, n in sorted(self._file.flaws.items())]
        lines += [self._file.damage] if self._file.damage else []
        notes = [f"{self.path.name}: {line}" for line in lines]
        self.notes += [note for note in notes if note not in self.notes]


def _push(stream: Vlp16Stream, datagram: Datagram) -> Scan | None:
    if len(datagram.payload) == velodyne.POSITION_BYTES:
        stream.push_position(datagram.payload, datagram.host_ns)
        return None
    if len(datagram.payload) == velodyne.DATA_BYTES:
        return stream.push_data(datagram.payload, datagram.host_ns)
    return None


def _flaw(code: str, n: int) -> Finding:
    return Finding(code, "warning", figures={"n": n, "of": "data"})
