"""The scans of one Ouster in a pcap or pcapng file, with the sensor's metadata beside it.

References:
    Ouster Sensor Docs, "Lidar Data Packet Format" and "Coordinate Frames and XYZ Calculation",
    https://static.ouster.dev/sensor-docs.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan, Stream
from lce_rig.core.errors import SourceError, reading
from lce_rig.core.files import read_json
from lce_rig.core.findings import Losses
from lce_rig.core.geometry import Array
from lce_rig.io import findings
from lce_rig.io.network import FRAME_BYTES, MIN_COVERAGE, PcapFile
from lce_rig.io.recording import SourceOptions, choose_lidar, fingerprint
from lce_rig.rig import LidarSettings, Rig


class Profile(NamedTuple):
    """Packet layout of a profile.

    Attributes:
        pixel: one return.
        unit_m: unit of its range.
        range_mask: mask of the bits that hold the range.
        has_heads: whether packets have a head and a foot, and a column's status is in its head.
    """

    pixel: np.dtype[Any]
    unit_m: float
    range_mask: int
    has_heads: bool = True


def _pixel(reflectivity_at: int, reflectivity: str, size: int, range_type: str = "<u4") -> np.dtype[Any]:
    return np.dtype(
        {
            "names": ["range", "reflectivity"],
            "formats": [range_type, reflectivity],
            "offsets": [0, reflectivity_at],
            "itemsize": size,
        }
    )


PROFILES = {
    "LEGACY": Profile(_pixel(4, "<u2", 12), 1e-3, (1 << 20) - 1, has_heads=False),
    "RNG19_RFL8_SIG16_NIR16": Profile(_pixel(4, "u1", 12), 1e-3, (1 << 19) - 1),
    "RNG15_RFL8_NIR8": Profile(_pixel(2, "u1", 4, "<u2"), 8e-3, (1 << 15) - 1),
}
"""Supported profiles of single returns."""


@dataclass(frozen=True, eq=False)
class OusterMetadata:
    """The sensor's metadata needed to decode its packets.

    Attributes:
        name: name of its profile.
        n_columns: columns of a revolution.
        columns_per_packet: columns of one packet.
        altitude_rad, azimuth_rad: (L,) angles of each beam, from the top.
        origin_m: (2,) distance of the beams' origins from the axis, and their height.
        T_sensor_lidar: (4, 4), m.
    """

    name: str
    n_columns: int
    columns_per_packet: int
    altitude_rad: Array
    azimuth_rad: Array
    origin_m: tuple[float, float]
    T_sensor_lidar: Array

    @property
    def profile(self) -> Profile:
        """The layout of a return."""
        return PROFILES[self.name]

    @property
    def packet(self) -> np.dtype[Any]:
        """The layout of a packet."""
        n, has_heads = len(self.altitude_rad), self.profile.has_heads
        head: list[Any] = [("ns", "<u8"), ("column", "<u2")]
        head += [("status", "<u2")] if has_heads else [("frame", "<u2"), ("encoder", "<u4")]
        tail: list[Any] = [] if has_heads else [("status", "<u4")]
        columns = np.dtype([*head, ("pixels", self.profile.pixel, (n,)), *tail])
        fields: list[Any] = [("columns", columns, (self.columns_per_packet,))]
        if has_heads:
            fields = [("type", "<u2"), ("frame", "<u2"), ("head", "V28"), *fields, ("foot", "V32")]
        return np.dtype(fields)

    def to_points(self, column: NDArray[np.int64], range_m: Array) -> NDArray[np.float32]:
        """Compute points (C, L, 3), m, of columns (C,) with ranges (C, L), in the sensor's frame.

        The beams' origins rotate with the rotor.
        """
        encoder = 2 * np.pi * (1 - column / self.n_columns)[:, None]
        azimuth = encoder - self.azimuth_rad
        radius_m, height_m = self.origin_m
        # Ranges count from the axis, through the origin of the beam.
        along_m = np.where(range_m > 0, range_m - np.hypot(radius_m, height_m), 0.0)
        level_m = along_m * np.cos(self.altitude_rad)
        lidar = np.stack(
            [
                level_m * np.cos(azimuth) + radius_m * np.cos(encoder),
                level_m * np.sin(azimuth) + radius_m * np.sin(encoder),
                along_m * np.sin(self.altitude_rad) + height_m,
            ],
            axis=-1,
        )
        return np.asarray(lidar @ self.T_sensor_lidar[:3, :3].T + self.T_sensor_lidar[:3, 3], np.float32)


def read_metadata(path: Path) -> OusterMetadata:
    """Read the JSON metadata file that Ouster's tools write beside a recording.

    Raises:
        SourceError: the file cannot be read, is not such a file, or its packet profile is not supported.
    """
    with reading(path, hint="Give the JSON file that the sensor or ouster-cli wrote."):
        document = read_json(path)
        # Newer metadata have groups.
        for key in ("beam_intrinsics", "lidar_intrinsics", "config_params"):
            document = {**document.get(key, {}), **document}
        layout = document["data_format"] if "data_format" in document else document["lidar_data_format"]
        name = str(layout.get("udp_profile_lidar", "LEGACY"))
        n, n_columns = int(layout["pixels_per_column"]), int(layout["columns_per_frame"])
        columns_per_packet = int(layout["columns_per_packet"])
        altitude, azimuth = (
            np.radians(np.array(document[key], np.float64))
            for key in ("beam_altitude_angles", "beam_azimuth_angles")
        )
        if not altitude.shape == azimuth.shape == (n,) or n < 1:
            raise ValueError(f"angles of {altitude.shape} beams for {n} pixels of a column")
        T_sensor_lidar = _matrix(document.get("lidar_to_sensor_transform", np.diag([-1, -1, 1, 1])))
        if "beam_to_lidar_transform" in document:
            T = _matrix(document["beam_to_lidar_transform"])
            origin_m = float(T[0, 3]), float(T[2, 3])
        else:
            origin_m = 1e-3 * float(document.get("lidar_origin_to_beam_origin_mm", 0.0)), 0.0
    if name not in PROFILES:
        hint = f"Supported are {', '.join(PROFILES)}; convert others to point clouds with Ouster's own tools."
        raise SourceError(f"{path}: packets of profile {name} are not supported", hint)
    return OusterMetadata(name, n_columns, columns_per_packet, altitude, azimuth, origin_m, T_sensor_lidar)


def _matrix(values: Any) -> Array:
    """Read a transform (4, 4) with its translation in mm."""
    T = np.array(values, np.float64).reshape(4, 4)
    T[:3, 3] *= 1e-3
    return T


class OusterRecording:
    """The scans of one Ouster in a recording of the network, one per frame.

    Attributes:
        path: the file.
        notes: the metadata's file and profile, and after reading the losses.
        key: fingerprint of the file and its metadata.
        n_samples: number of scans to come, estimated from the file's size.
        streams: the LiDAR's scans.
    """

    def __init__(self, path: Path, rig: Rig, options: SourceOptions) -> None:
        """Find the metadata and the sensor's packets.

        Raises:
            SourceError: the metadata are missing or of an unsupported profile, or no packet fits them.
        """
        self.path = path
        self.notes: list[str] = []
        self._file = PcapFile(path)
        self._lidar = choose_lidar(rig, options, self.notes)
        self._settings: LidarSettings = rig.lidars[self._lidar]
        # Metadata: the file with the recording's name, else the only JSON file beside it.
        beside = path.with_suffix(".json")
        others = sorted(path.parent.glob("*.json"))
        if not beside.is_file() and len(others) != 1:
            hint = f"Put the JSON file that was recorded with it beside it, as {beside.name}."
            raise SourceError(f"{path}: the sensor's metadata are missing", hint)
        beside = beside if beside.is_file() else others[0]
        self._metadata = read_metadata(beside)
        self._layout = self._metadata.packet
        self.notes.append(f"{path.name}: metadata of {beside.name}, profile {self._metadata.name}")
        what = f"{self._layout.itemsize} bytes, as in {beside.name}"
        driver = self._settings.driver
        n_bytes = self._layout.itemsize
        self._sender = self._file.choose_sender(
            lambda d: "" if len(d.payload) == n_bytes else f"of {len(d.payload)} bytes",
            what,
            self._lidar,
            driver,
        )
        self.key = fingerprint([path, beside])
        self.streams = frozenset([Stream(self._lidar, "", "scans")])
        n_packets = -(-self._metadata.n_columns // self._metadata.columns_per_packet)
        self.n_samples = max(1, path.stat().st_size // (n_packets * (self._layout.itemsize + FRAME_BYTES)))

    def samples(self) -> Iterator[Scan]:
        """Yield the scans, in order of time.

        Raises:
            SourceError: not half a revolution was recorded.
        """
        losses, n_scans = Losses(), 0
        for packets, host_ns in self._frames():
            scan = self._to_scan(np.frombuffer(b"".join(packets), self._layout), host_ns)
            if scan is None:
                losses.add(findings.SCAN_THIN())
            else:
                n_scans += 1
                yield scan
        lines = findings.worded(losses) + self._file.account()
        self.notes += [f"{self.path.name}: {line}" for line in lines]
        if n_scans == 0:
            raise SourceError(f"{self.path}: no whole revolution in it", "Record at least 1 s.")

    def _frames(self) -> Iterator[tuple[list[bytes], int]]:
        """Yield the packets of each frame, and the arrival of the first."""
        packets: list[bytes] = []
        frame, first_host_ns = -1, 0
        # A frame without an end is damaged.
        most = 2 * -(-self._metadata.n_columns // self._metadata.columns_per_packet)
        for datagram in self._file.datagrams():
            is_ours = (datagram.source, datagram.port) == self._sender
            if not is_ours or len(datagram.payload) != self._layout.itemsize:
                continue
            fields = np.frombuffer(datagram.payload, self._layout)[0]
            has_heads = self._metadata.profile.has_heads
            number = int(fields["frame"] if has_heads else fields["columns"]["frame"][0])
            if packets and (number != frame or len(packets) >= most):
                yield packets, first_host_ns
                packets = []
            if not packets:
                frame, first_host_ns = number, datagram.host_ns
            packets.append(datagram.payload)
        if packets:
            yield packets, first_host_ns

    def _to_scan(self, packets: NDArray[np.void], first_host_ns: int) -> Scan | None:
        """Build the scan of a frame's packets (P,); None if too few of its columns arrived."""
        metadata, settings = self._metadata, self._settings
        columns = packets["columns"].reshape(-1)
        number = columns["column"].astype(np.int64)
        columns = columns[(columns["status"] & 1 == 1) & (number < metadata.n_columns)]
        if len(columns) < MIN_COVERAGE * metadata.n_columns:
            return None
        pixels = columns["pixels"]
        range_m = (pixels["range"].astype(np.int64) & metadata.profile.range_mask) * metadata.profile.unit_m
        kept = (range_m >= settings.min_range_m) & (range_m <= settings.max_range_m) & (range_m > 0)
        points = metadata.to_points(columns["column"].astype(np.int64), range_m)[kept]
        ns = columns["ns"].astype(np.int64)
        offset_ns = np.broadcast_to((ns - ns[0])[:, None], range_m.shape)[kept]
        rings = np.argsort(np.argsort(metadata.altitude_rad)).astype(np.int16)
        ring = np.broadcast_to(rings, range_m.shape)[kept]
        # A packet is sent when its last column is measured.
        sent_ns = round(1e9 / settings.rate_hz * metadata.columns_per_packet / metadata.n_columns)
        is_host = settings.timestamps.clock == "host" and first_host_ns
        stamp_ns = first_host_ns - sent_ns if is_host else int(ns[0])
        intensity = pixels["reflectivity"].astype(np.float32)[kept]
        return Scan(self._lidar, stamp_ns, points, intensity, ring, offset_ns, first_host_ns or None)
