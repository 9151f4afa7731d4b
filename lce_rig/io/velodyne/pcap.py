"""A network recording as a stream of scans of a Velodyne, with the live decoder."""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from lce_rig.core import velodyne
from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.io.network import PcapFile
from lce_rig.io.protocol import SourceOptions, Span, choose_lidar, fingerprint
from lce_rig.io.velodyne.packet import BadPacketError, read_data_packet
from lce_rig.io.velodyne.stream import DUAL_NOTE, OFFSETS_NOTE, Vlp16Stream
from lce_rig.rig import LidarSettings, Rig

# So many data packets, per second or less of one sensor, show which sensors were recorded.
_SURVEY_PACKETS = 800
_MAX_SHOWN = 6


class PcapRecording:
    """The scans of one Velodyne in a pcap or pcapng file.

    Attributes:
        path: the file.
        notes: the sensor whose packets are taken, and after reading the losses.
        key: fingerprint of the file.
        n_samples: number of scans to come, estimated from the file's size.
        streams: the LiDAR's scans; their span, by arrival, is found only where they are part of a recording.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the sensor's packets.

        Raises:
            SourceError: it is not a recording of the network, holds no packets of the profile's model, or
                those of several sensors of which none has the profile's address.
        """
        self.path = path
        self.notes: list[str] = []
        self._file = PcapFile(path)
        self._lidar = choose_lidar(rig, options, self.notes)
        self._settings: LidarSettings = rig.lidars[self._lidar]
        self._product = Vlp16Stream(self._lidar, self._settings).product
        self._address, n_packets = self._choose_sender()
        self.key = fingerprint([path])
        span_ns: Span | None = None
        if options.is_part:
            arrivals_ns = [d.host_ns for d in self._file.datagrams() if d.source == self._address]
            span_ns = (min(arrivals_ns), max(arrivals_ns)) if any(arrivals_ns) else None
        self.streams: Mapping[Stream, Span | None] = {Stream(self._lidar, "", "scans"): span_ns}
        sweep_s = n_packets * self._product.packet_ns(is_dual=False) * 1e-9
        self.n_samples = max(1, round(sweep_s * self._settings.rate_hz))

    def samples(self) -> Iterator[Scan]:
        """Yield the scans, in order of time; packets that are damaged, late or lost are counted in `notes`.

        Raises:
            SourceError: not one whole revolution was recorded.
        """
        stream = Vlp16Stream(self._lidar, self._settings)
        try:
            for datagram in self._file.datagrams():
                if datagram.source != self._address:
                    continue
                if len(datagram.payload) == velodyne.POSITION_BYTES:
                    stream.push_position(datagram.payload)
                elif len(datagram.payload) == velodyne.DATA_BYTES:
                    scan = stream.push_data(datagram.payload, datagram.host_ns)
                    if scan is not None:
                        yield scan
            last = stream.finish()
            if last is not None:
                yield last
        finally:
            lines = [OFFSETS_NOTE, *([DUAL_NOTE] if stream.mode == velodyne.DUAL else [])]
            lines += [stream.clock.state().text, *stream.account(), *self._file.account()]
            notes = [f"{self.path.name}: {line}" for line in lines]
            self.notes += [note for note in notes if note not in self.notes]
        if stream.n_scans == 0:
            causes = "; ".join(stream.account()) or f"{stream.n_data} packets are less than a revolution"
            raise SourceError(f"{self.path}: no whole revolution in it: {causes}", "Record at least 1 s.")

    def _choose_sender(self) -> tuple[str, float]:
        """Choose the sensor whose packets are taken by the start of the file.

        Returns:
            Its IP address, and the number of its data packets in the whole file, about.

        Raises:
            SourceError: there is none of the profile's model, or several of which none has its address.
        """
        senders, others, ports = Counter[str](), Counter[str](), Counter[int]()
        for datagram in self._file.datagrams():
            ports[datagram.port] += 1
            try:
                read_data_packet(datagram.payload, datagram.host_ns, self._product)
                senders[datagram.source] += 1
            except BadPacketError as error:
                others.update([error.model] if error.model else [])
            n_sound = senders.total() + others.total()
            if n_sound >= _SURVEY_PACKETS or (n_sound and ports.total() >= 50 * _SURVEY_PACKETS):
                break
        name, wanted = self._product.name, self._settings.driver.address
        if wanted not in senders and len(senders) == 1:
            wanted = next(iter(senders))
            self.notes.append(f"{self.path.name}: packets of {wanted}, the only {name} in it")
        if wanted in senders:
            share = self._file.n_bytes_read / self.path.stat().st_size
            return str(wanted), senders[str(wanted)] / share
        if senders:
            addresses = ", ".join(sorted(senders))
            hint = f"Set driver.address of {self._lidar!r} in the profile to one of them."
            what = f"{self.path}: packets of several LiDARs, none of them {wanted}: {addresses}"
            raise SourceError(what, hint)
        by_port = [f"{n} to port {port}" for port, n in ports.most_common(_MAX_SHOWN)]
        holds = [f"{n} packets of {model}" for model, n in others.most_common()] or by_port
        causes = "; ".join([*holds, *self._file.account()]) or "no UDP packets at all"
        what = f"{self.path}: holds no packets of a {name}: {causes}"
        read = ", ".join(product.name for product in velodyne.READ)
        hint = f"Record whole packets (tcpdump -s 0), or set the model of {self._lidar!r}; read are {read}."
        raise SourceError(what, hint)
