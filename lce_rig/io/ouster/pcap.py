"""The scans of one Ouster in a pcap or pcapng file, with the sensor's metadata beside it."""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError
from lce_rig.core.losses import Losses
from lce_rig.io import findings
from lce_rig.io.fingerprint import fingerprint
from lce_rig.io.network import PcapFile
from lce_rig.io.ouster.packets import PROFILES, OusterMetadata, read_metadata
from lce_rig.io.protocol import SourceOptions, Span
from lce_rig.io.sensor_choice import choose_lidar
from lce_rig.rig import LidarSettings, Rig

# A scan with more of its columns lost is not worth looking at.
_MIN_COVERAGE = 0.5
_N_SURVEYED, _MAX_SHOWN = 5000, 6


class OusterStream:
    """Assembles the packets of one sensor into scans, one a frame.

    Attributes:
        losses: frames that lack more than half of their columns.
        n_scans: scans handed on.
    """

    def __init__(self, sensor: str, settings: LidarSettings, metadata: OusterMetadata) -> None:
        self.losses = Losses()
        self.n_scans = 0
        self._sensor, self._settings, self._metadata = sensor, settings, metadata
        self._layout = metadata.packet
        self._rings = np.argsort(np.argsort(metadata.altitude_rad)).astype(np.int16)
        # A frame that never ends is damage.
        self._most = 2 * -(-metadata.n_columns // metadata.columns_per_packet)
        self._frame: int | None = None
        self._packets: list[bytes] = []
        self._first_host_ns = 0

    def push(self, payload: bytes | memoryview, host_ns: int) -> Scan | None:
        """Take a packet of the layout's size; returns the frame before where it begins another."""
        fields = np.frombuffer(payload, self._layout)[0]
        is_headed = PROFILES[self._metadata.name].has_heads
        frame = int(fields["frame"]) if is_headed else int(fields["columns"]["frame"][0])
        is_next = frame != self._frame or len(self._packets) >= self._most
        scan = self.finish() if self._packets and is_next else None
        if not self._packets:
            self._first_host_ns = host_ns
        self._frame = frame
        self._packets.append(bytes(payload))
        return scan

    def finish(self) -> Scan | None:
        """End the frame; None where too little of it came."""
        profile, metadata = PROFILES[self._metadata.name], self._metadata
        packets = np.frombuffer(b"".join(self._packets), self._layout)
        self._packets = []
        columns = packets["columns"].reshape(-1)
        number = columns["column"].astype(np.int64)
        columns = columns[(columns["status"] & 1 == 1) & (number < metadata.n_columns)]
        if len(columns) < _MIN_COVERAGE * metadata.n_columns:
            self.losses.add(findings.SCAN_THIN())
            return None
        pixels = columns["pixels"]
        range_m = (pixels["range"].astype(np.int64) & profile.range_mask) * profile.unit_m
        kept = (range_m >= self._settings.min_range_m) & (range_m <= self._settings.max_range_m)
        kept &= range_m > 0
        points = metadata.to_points(columns["column"].astype(np.int64), range_m)[kept]
        ns = columns["ns"].astype(np.int64)
        offset_ns = np.broadcast_to((ns - ns[0])[:, None], range_m.shape)[kept]
        ring = np.broadcast_to(self._rings, range_m.shape)[kept]
        period_ns = 1e9 / self._settings.rate_hz
        # A packet is sent when its last column is measured.
        sent_ns = round(period_ns * metadata.columns_per_packet / metadata.n_columns)
        is_host = self._settings.timestamps.clock == "host" and self._first_host_ns
        stamp_ns = self._first_host_ns - sent_ns if is_host else int(ns[0])
        self.n_scans += 1
        intensity = pixels["reflectivity"].astype(np.float32)[kept]
        return Scan(self._sensor, stamp_ns, points, intensity, ring, offset_ns, self._first_host_ns or None)


class OusterRecording:
    """The scans of one Ouster in a recording of the network.

    Attributes:
        path: the file.
        notes: what was taken, and after reading what was skipped and why.
        key: fingerprint of the file and its metadata.
        n_samples: number of scans to come, estimated from the file's size.
        streams: the LiDAR's scans; their span is not known beforehand.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the metadata and the sensor's packets.

        Raises:
            SourceError: there are no metadata, of a profile that is not read, or no packets that fit them.
        """
        self.path = path
        self.notes: list[str] = []
        self._file = PcapFile(path)
        self._lidar = choose_lidar(rig, options, self.notes)
        self._settings = rig.lidars[self._lidar]
        beside = _metadata_beside(path)
        self._metadata = read_metadata(beside)
        self._n_bytes = self._metadata.packet.itemsize
        self.notes.append(f"{path.name}: metadata of {beside.name}, profile {self._metadata.name}")
        self._sender = self._choose_sender()
        self.key = fingerprint([path, beside])
        self.streams: Mapping[Stream, Span | None] = {Stream(self._lidar, "", "scans"): None}
        n_packets = -(-self._metadata.n_columns // self._metadata.columns_per_packet)
        self.n_samples = max(1, path.stat().st_size // (n_packets * self._n_bytes))

    def samples(self) -> Iterator[Scan]:
        """Yield the scans, in order of time.

        Raises:
            SourceError: not half a revolution was recorded.
        """
        stream = OusterStream(self._lidar, self._settings, self._metadata)
        for datagram in self._file.datagrams():
            is_ours = (datagram.source, datagram.port) == self._sender
            if is_ours and len(datagram.payload) == self._n_bytes:
                scan = stream.push(datagram.payload, datagram.host_ns)
                if scan is not None:
                    yield scan
        last = stream.finish()
        if last is not None:
            yield last
        lines = [loss.text for loss in stream.losses.findings()] + self._file.account()
        self.notes += [f"{self.path.name}: {line}" for line in lines]
        if stream.n_scans == 0:
            raise SourceError(f"{self.path}: no whole revolution in it", "Record at least 1 s.")

    def _choose_sender(self) -> tuple[str, int]:
        """Choose whose packets have the layout's size, by address and port: the profile's, else the only one.

        Raises:
            SourceError: there is none, or there are several.
        """
        senders, sizes = Counter[tuple[str, int]](), Counter[int]()
        for n, datagram in enumerate(self._file.datagrams()):
            sizes[len(datagram.payload)] += 1
            if len(datagram.payload) == self._n_bytes:
                senders[datagram.source, datagram.port] += 1
            if n >= _N_SURVEYED:
                break
        if not senders:
            there = ", ".join(f"{n} of {size} bytes" for size, n in sizes.most_common(_MAX_SHOWN)) or "none"
            what = f"{self.path}: no packets of {self._n_bytes} bytes, as the metadata say; there are {there}"
            raise SourceError(what, "Give the metadata of this recording.")
        driver = self._settings.driver
        wanted = [s for s in senders if driver.address in (None, s[0]) and driver.port in (None, s[1])]
        found = wanted or list(senders)
        if len(found) > 1:
            there = ", ".join(f"{address} to port {port}" for address, port in sorted(found))
            hint = f"Set driver.address and driver.port of {self._lidar!r} in the profile to one of them."
            raise SourceError(f"{self.path}: packets of several sensors: {there}", hint)
        return found[0]


def _metadata_beside(path: Path) -> Path:
    """Find the metadata of a recording: of its name, else the only JSON file in its folder.

    Raises:
        SourceError: there are none, or several.
    """
    named = path.with_suffix(".json")
    if named.is_file():
        return named
    others = sorted(path.parent.glob("*.json"))
    if len(others) == 1:
        return others[0]
    raise SourceError(
        f"{path}: the sensor's metadata are missing",
        f"Put the JSON file that was recorded with it beside it, as {named.name}.",
    )
