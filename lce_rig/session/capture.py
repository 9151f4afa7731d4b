"""One capture of a session: a folder of plain files and a manifest with their checksums."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SessionError, reading
from lce_rig.core.files import decode_events, decode_pixels, encode_events
from lce_rig.core.pcd import decode_pcd, encode_pcd
from lce_rig.rig import Rig
from lce_rig.rig.settings import Name
from lce_rig.session.durable import flush_folder, write_new_file

MANIFEST = "meta.json"
PLAIN_VERSION, EVENTS_VERSION = 1, 2
"""Versions of manifests without and with events; older programs read those without."""
SERIALS = "serials"
"""The key of `meta` with the serial numbers of the sensors."""
SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_Stamp = Annotated[int, Field(ge=-(1 << 62), le=1 << 62)] | None


class _Record(BaseModel):
    # Keys of later versions are ignored.
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class Entry(_Record):
    """The file of an image, a scan or a range of events; fields of other kinds are empty."""

    kind: Literal["image", "scan", "events"]
    camera: Name = ""
    channel: Name = ""
    lidar: Name = ""
    # Manifests must not name files outside their folder.
    file: Annotated[str, Field(pattern=f"^{SAFE_NAME.pattern}$")]
    bytes: int
    sha256: str
    host_ns: _Stamp
    stamp_ns: _Stamp = None
    first_ns: _Stamp = None
    last_ns: _Stamp = None

    @model_validator(mode="after")
    def _has_the_fields_of_its_kind(self) -> "Entry":
        sensor = ("lidar",) if self.kind == "scan" else ("camera", "channel")
        stamps = ("first_ns", "last_ns") if self.kind == "events" else ("stamp_ns",)
        for field in (*sensor, *stamps):
            if field not in self.model_fields_set:
                raise ValueError(f"{self.kind} without {field}")
        return self

    @property
    def source(self) -> str:
        """Contents of the file, such as "image of cam.frames"."""
        sensor = f"{self.camera}.{self.channel}" if self.kind == "image" else self.camera or self.lidar
        return f"{self.kind} of {sensor}"


class Manifest(_Record):
    """The manifest; `meta` holds any JSON of the collector."""

    format_version: Annotated[int, Field(ge=1)]
    content_sha256: str
    files: list[Entry]
    meta: dict[str, Any]

    @model_validator(mode="after")
    def _sensors_are_named_once(self) -> "Manifest":
        sources = [entry.source for entry in self.files]
        for source in sources:
            if sources.count(source) > 1:
                raise ValueError(f"{source} is named twice")
        return self


@dataclass(frozen=True)
class Capture:
    """One board placement as recorded by the sensors.

    Attributes:
        path: the capture's folder; its name is the capture's.
    """

    path: Path

    @property
    def name(self) -> str:
        """The capture's name: six digits."""
        return self.path.name

    @property
    def meta(self) -> dict[str, Any]:
        """The collector's notes on this capture (source, duplicates, board poses)."""
        return dict(self._manifest.meta)

    @property
    def content_sha256(self) -> str:
        """The fingerprint `content_hash` gave when the capture was written."""
        return self._manifest.content_sha256

    @property
    def file_hashes(self) -> frozenset[str]:
        """SHA-256 of every image, scan and range of events in it."""
        return frozenset(entry.sha256 for entry in self._manifest.files)

    @property
    def contents(self) -> list[dict[str, Any]]:
        """Sensor, timestamps and SHA-256 of each file, in a fixed order."""
        files = sorted(self._manifest.files, key=lambda entry: entry.sha256)
        return [entry.model_dump(exclude={"file", "bytes"}, exclude_unset=True) for entry in files]

    @property
    def times_ns(self) -> list[int]:
        """Times of arrival of its samples, on this computer's clock; their timestamps if unknown."""
        files = self._manifest.files
        arrivals = [entry.host_ns for entry in files if entry.host_ns is not None]
        stamps = [entry.last_ns if entry.kind == "events" else entry.stamp_ns for entry in files]
        return arrivals or [stamp for stamp in stamps if stamp is not None]

    @property
    def serials(self) -> dict[str, str]:
        """Serial numbers by sensor, if the devices reported them."""
        serials = self._manifest.meta.get(SERIALS)
        items = serials.items() if isinstance(serials, dict) else ()
        return {name: serial for name, serial in items if isinstance(serial, str) and serial}

    @property
    def manifest_sha256(self) -> str:
        """The manifest's fingerprint: of samples and timestamps.

        Raises:
            SessionError: there is none.
        """
        with self._reading(MANIFEST):
            return hashlib.sha256((self.path / MANIFEST).read_bytes()).hexdigest()

    @property
    def sources(self) -> list[str]:
        """Contents of each file, such as "image of cam.frames"."""
        return [entry.source for entry in self._manifest.files]

    @property
    def image_keys(self) -> list[tuple[str, str]]:
        """(camera, channel) of every image, sorted."""
        return sorted((e.camera, e.channel) for e in self._manifest.files if e.kind == "image")

    @property
    def lidars(self) -> list[str]:
        """Names of the LiDARs with a scan, sorted."""
        return sorted(entry.lidar for entry in self._manifest.files if entry.kind == "scan")

    @property
    def event_cameras(self) -> list[str]:
        """Names of the cameras with events, sorted."""
        return sorted(entry.camera for entry in self._manifest.files if entry.kind == "events")

    def has_image(self, camera: str, channel: str) -> bool:
        """Check whether this capture has an image of the camera and channel."""
        return (camera, channel) in self.image_keys

    def image(self, camera: str, channel: str) -> Image:
        """Read an image exactly as it was captured.

        Raises:
            SessionError: the image is missing or damaged.
        """
        import cv2

        entry, data = self._load(f"image of {camera}.{channel}")
        with self._reading(entry.file):
            pixels = decode_pixels(data, cv2.IMREAD_UNCHANGED)
            return Image(camera, channel, entry.stamp_ns, pixels, entry.host_ns)

    def scan(self, lidar: str) -> Scan:
        """Read a scan exactly as it was captured.

        Raises:
            SessionError: the scan is missing or damaged.
        """
        entry, data = self._load(f"scan of {lidar}")
        with self._reading(entry.file):
            cloud = decode_pcd(data)
            return Scan(
                lidar,
                entry.stamp_ns,
                np.stack([cloud[axis] for axis in "xyz"], axis=1).astype(np.float32),
                cloud["intensity"].astype(np.float32),
                cloud["ring"].astype(np.int16),
                cloud["time"].astype(np.int64) if "time" in (cloud.dtype.names or ()) else None,
                entry.host_ns,
            )

    def events(self, camera: str) -> Events:
        """Read the events around this capture exactly as recorded, timestamps to the microsecond.

        Raises:
            SessionError: the events are missing or damaged.
        """
        entry, data = self._load(f"events of {camera}")
        with self._reading(entry.file):
            return decode_events(data, camera)

    def check(self) -> None:
        """Read every file once.

        Raises:
            SessionError: the first fault found.
        """
        for entry in self._manifest.files:
            self._read(entry)

    @cached_property
    def _manifest(self) -> Manifest:
        with self._reading(MANIFEST):
            document = json.loads((self.path / MANIFEST).read_bytes())
            version = document.get("format_version")
            if isinstance(version, int) and version > EVENTS_VERSION:
                raise SessionError(f"capture {self.name} was written by a newer lce-rig", "Update lce-rig.")
            try:
                return Manifest.model_validate(document)
            except ValidationError as error:
                first = error.errors(include_url=False)[0]
                raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None

    def _load(self, source: str) -> tuple[Entry, bytes]:
        """Return the entry of a source with its file's content."""
        for entry in self._manifest.files:
            if entry.source == source:
                return entry, self._read(entry)
        have = ", ".join(self.sources) or "nothing"
        raise SessionError(f"capture {self.name} has no {source}; it has {have}")

    def _read(self, entry: Entry) -> bytes:
        with self._reading(entry.file):
            data = (self.path / entry.file).read_bytes()
            if len(data) != entry.bytes:
                raise ValueError(f"it has {len(data)} of {entry.bytes} bytes")
            if hashlib.sha256(data).hexdigest() != entry.sha256:
                raise ValueError("it has changed since it was captured (checksum)")
        return data

    def _reading(self, name: str) -> AbstractContextManager[None]:
        hint = f"Remove {self.path} and collect again; the other captures are not affected."
        return reading(f"capture {self.name} is damaged: {name}", SessionError, hint)


def check_samples(rig: Rig, images: Sequence[Image], scans: Sequence[Scan], events: Sequence[Events]) -> None:
    """Check that samples can be one capture of a rig.

    Raises:
        SessionError: there are no samples, two of one sensor, one of a sensor not in the rig, or events of
            another resolution than the camera's.
    """
    sources = [f"image of {i.sensor}.{i.channel}" for i in images]
    sources += [f"scan of {s.sensor}" for s in scans] + [f"events of {e.sensor}" for e in events]
    if len(set(sources)) < len(sources) or not sources:
        raise SessionError(
            "a capture holds at least one sample, and at most one image per camera channel, one scan per "
            "LiDAR and one stretch of events per camera"
        )
    if foreign := _foreign(sources, rig):
        raise SessionError(f"rig {rig.name!r} has no {foreign}", "Add it to the profile, or omit it.")
    for stretch in events:
        size, wanted = (stretch.width_px, stretch.height_px), rig.cameras[stretch.sensor].resolution_px
        if size != wanted:
            raise SessionError(
                f"events of {stretch.sensor} are {size[0]}x{size[1]} px; "
                f"rig {rig.name!r} gives it {wanted[0]}x{wanted[1]}",
                "Use this camera's recording, or correct resolution_px in the profile.",
            )


def check_capture(rig: Rig, capture: Capture) -> None:
    """Check that all sensors in a capture belong to its rig.

    Raises:
        SessionError: the capture names another sensor, or its manifest is damaged.
    """
    if foreign := _foreign(capture.sources, rig):
        raise SessionError(
            f"capture {capture.name} belongs to another rig: rig {rig.name!r} has no {foreign}",
            f"Remove {capture.path} and collect again; the other captures are not affected.",
        )


def _foreign(sources: Sequence[str], rig: Rig) -> str | None:
    """Return the first source missing in a rig; None if it has all."""
    known = {f"scan of {name}" for name in rig.lidars}
    for name, camera in rig.cameras.items():
        known |= {f"image of {name}.{channel}" for channel in camera.channels}
        known |= {f"events of {name}"} if camera.first_channel("events") else set()
    return next((source for source in sources if source not in known), None)


def content_hash(images: Iterable[Image], scans: Iterable[Scan], events: Iterable[Events] = ()) -> str:
    """Fingerprint samples without their timestamps, independently of the files they came from.

    Events count with their time differences.

    Returns:
        SHA-256 as hex digits.
    """
    digest = hashlib.sha256()
    for image in sorted(images, key=lambda i: (i.sensor, i.channel)):
        digest.update(f"image {image.sensor} {image.channel} {image.pixels.shape}".encode())
        digest.update(np.ascontiguousarray(image.pixels).tobytes())
    for scan in sorted(scans, key=lambda s: s.sensor):
        digest.update(f"scan {scan.sensor} {len(scan.points)}".encode())
        digest.update(np.ascontiguousarray(scan.points).tobytes())
        digest.update(np.ascontiguousarray(scan.intensity).tobytes())
    for stretch in sorted(events, key=lambda e: e.sensor):
        digest.update(f"events {stretch.sensor} {len(stretch)}".encode())
        digest.update((stretch.t_ns - stretch.t_ns[:1]).tobytes())
        for column in (stretch.x, stretch.y, stretch.polarity):
            digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()


def write_capture(
    folder: Path,
    images: Iterable[Image],
    scans: Iterable[Scan],
    meta: Mapping[str, Any],
    events: Iterable[tuple[str, Events]] = (),
) -> None:
    """Fill an empty folder with one capture, every file flushed to the disk.

    Args:
        events: events with their channel.

    Raises:
        OSError: a full disk, no permission.
        ValueError: an image that is not 8-bit grey or BGR, events out of order or off their sensor, or
            `meta` that is not JSON.
    """
    images, scans, events = list(images), list(scans), list(events)
    # Encoding, hashing and flushing release the interpreter lock, so a capture takes as long as its slowest
    # file.
    with ThreadPoolExecutor(thread_name_prefix="write capture") as pool:
        content = pool.submit(content_hash, images, scans, [stretch for _, stretch in events])
        stored_events = [pool.submit(_store_events, folder, *each) for each in events]  # the longest first
        entries = [pool.submit(_store_image, folder, image) for image in images]
        entries += [pool.submit(_store_scan, folder, scan) for scan in scans] + stored_events
    manifest = {
        "format_version": EVENTS_VERSION if events else PLAIN_VERSION,
        "content_sha256": content.result(),
        "files": [entry.result() for entry in entries],
        "meta": dict(meta),
    }
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_new_file(folder / MANIFEST, text.encode())
    flush_folder(folder)


def _store_image(folder: Path, image: Image) -> dict[str, Any]:
    import cv2

    pixels = image.pixels
    if pixels.dtype != np.uint8 or not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)):
        raise ValueError(
            f"an image of {image.sensor} is {pixels.dtype} {pixels.shape}, not 8-bit grey or BGR"
        )
    data = image.png
    if data is None:
        # OpenCV's PNG compression 1 is five times faster than its 9 and 10 % larger.
        is_done, encoded = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        if not is_done:
            raise ValueError(f"an image of {image.sensor} could not be encoded as PNG")
        data = bytes(encoded)
    entry = {"kind": "image", "camera": image.sensor, "channel": image.channel}
    stored = _store(folder, f"{image.sensor}.{image.channel}.png", data)
    return {**entry, **stored, "stamp_ns": image.stamp_ns, "host_ns": image.host_ns}


def _store_events(folder: Path, channel: str, stretch: Events) -> dict[str, Any]:
    if np.any(np.diff(stretch.t_ns) < 0):
        raise ValueError(f"events of {stretch.sensor} are not in order of time")
    if np.any(stretch.x >= stretch.width_px) or np.any(stretch.y >= stretch.height_px):
        size = f"{stretch.width_px}x{stretch.height_px}"
        raise ValueError(f"events of {stretch.sensor} lie outside its {size} pixels")
    first_ns, last_ns = (int(stretch.t_ns[0]), int(stretch.t_ns[-1])) if len(stretch) else (None, None)
    entry = {"kind": "events", "camera": stretch.sensor, "channel": channel}
    stored = _store(folder, f"{stretch.sensor}.events.npz", encode_events(stretch))
    return {**entry, **stored, "first_ns": first_ns, "last_ns": last_ns, "host_ns": stretch.host_ns}


def _store(folder: Path, name: str, data: bytes) -> dict[str, Any]:
    write_new_file(folder / name, data)
    return {"file": name, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def _store_scan(folder: Path, scan: Scan) -> dict[str, Any]:
    columns: dict[str, tuple[str, Any]] = {
        "x": ("f4", scan.points[:, 0]),
        "y": ("f4", scan.points[:, 1]),
        "z": ("f4", scan.points[:, 2]),
        "intensity": ("f4", scan.intensity),
        "ring": ("i2", scan.ring),
    }
    comments = ["frame of the lidar: x forward, y left, z up; m; ring 0 is the lowest"]
    if scan.offset_ns is not None:
        # 32 bits hold 4.3 s, and many viewers read no other type; a longer scan needs 64.
        fits = len(scan.offset_ns) == 0 or (scan.offset_ns.min() >= 0 and scan.offset_ns.max() < 2**32)
        columns["time"] = ("u4" if fits else "i8", scan.offset_ns)
        comments.append("time: ns after the first firing")
    cloud = np.empty(len(scan.points), dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        cloud[name] = values
    stored = _store(folder, f"{scan.sensor}.pcd", encode_pcd(cloud, comments))
    stamps = {"stamp_ns": scan.stamp_ns, "host_ns": scan.host_ns}
    return {"kind": "scan", "lidar": scan.sensor, **stored, **stamps}
