"""A network recording as a stream of scans of a Velodyne, with the live decoder."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from lce_rig.core import velodyne
from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Finding
from lce_rig.io.fingerprint import fingerprint
from lce_rig.io.network import Datagram, PcapFile
from lce_rig.io.protocol import SourceOptions, Span
from lce_rig.io.sensor_choice import choose_lidar
from lce_rig.io.velodyne.packet import BadPacketError, OtherModelError, read_data_packet
from lce_rig.io.velodyne.points import DUAL_NOTE, OFFSETS_NOTE
from lce_rig.io.velodyne.stream import Vlp16Stream
from lce_rig.rig import LidarSettings, Rig
from lce_rig.words import describe

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
