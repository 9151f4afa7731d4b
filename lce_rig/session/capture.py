"""One capture of a session: a folder of plain files and a manifest with their checksums."""

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.documents import read_json
from lce_rig.core.errors import LceRigError, SessionError, reason_of
from lce_rig.core.event_file import decode_events
from lce_rig.core.image_codec import decode_pixels
from lce_rig.core.limits import MAX_DOCUMENT_BYTES, MAX_FILE_BYTES, MAX_TIME_NS, describe, read_file
from lce_rig.core.pcd import decode_pcd
from lce_rig.rig.settings import Name
from lce_rig.session.capture_files import EVENTS_VERSION, MANIFEST, check_events, stamps_of

# The schema of a capture's manifest. Reading is strict, as a session may come from another source.

_Stamp = Annotated[int, Field(ge=-MAX_TIME_NS, le=MAX_TIME_NS)] | None
_Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class _Record(BaseModel):
    # Keys of later versions are ignored.
    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", allow_inf_nan=False)


class _FileEntry(_Record):
    file: Annotated[str, Field(max_length=255)]
    bytes: Annotated[int, Field(ge=0, le=MAX_FILE_BYTES)]
    sha256: _Sha256
    host_ns: _Stamp


class ImageEntry(_FileEntry):
    """An image's file."""

    kind: Literal["image"]
    camera: Name
    channel: Name
    stamp_ns: _Stamp


class ScanEntry(_FileEntry):
    """A scan's file."""

    kind: Literal["scan"]
    lidar: Name
    stamp_ns: _Stamp


class EventsEntry(_FileEntry):
    """The file of a range of events."""

    kind: Literal["events"]
    camera: Name
    channel: Name
    first_ns: _Stamp
    last_ns: _Stamp


Entry = ImageEntry | ScanEntry | EventsEntry


class Manifest(_Record):
    """The manifest; `meta` holds any JSON of the collector."""

    format_version: Annotated[int, Field(ge=1)]
    content_sha256: str
    files: Annotated[list[Annotated[Entry, Field(discriminator="kind")]], Field(max_length=1000)]
    meta: dict[str, Any]

    @property
    def images(self) -> list[ImageEntry]:
        """Entries of images."""
        return [entry for entry in self.files if isinstance(entry, ImageEntry)]

    @property
    def scans(self) -> list[ScanEntry]:
        """Entries of scans."""
        return [entry for entry in self.files if isinstance(entry, ScanEntry)]

    @property
    def events(self) -> list[EventsEntry]:
        """Entries of stretches of events."""
        return [entry for entry in self.files if isinstance(entry, EventsEntry)]

    @model_validator(mode="after")
    def _sensors_are_named_once(self) -> "Manifest":
        names = list(self._sensors())
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"{name} is named twice")
        return self

    def _sensors(self) -> Iterator[str]:
        yield from (f"image of {entry.camera}.{entry.channel}" for entry in self.images)
        yield from (f"scan of {entry.lidar}" for entry in self.scans)
        yield from (f"events of {entry.camera}" for entry in self.events)


def parse_manifest(document: Any) -> Manifest:
    """Validate a manifest.

    Raises:
        ValueError: the first thing found wrong, with its key.
    """
    try:
        return Manifest.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        given = "" if first["type"] in ("missing", "value_error") else f"; {describe(first['input'])} given"
        what = first["msg"].removeprefix("Value error, ").replace("Input should", "must")
        raise ValueError(f"{describe(key)[1:-1] + ': ' if key else ''}{what}{given}") from None


SERIALS = "serials"
"""The key of `meta` with the serial numbers of the sensors."""
SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
_SOME_ENTRY = TypeVar("_SOME_ENTRY", bound=Entry)
# Maximum time of a firing after the scan's first.
_MAX_OFFSET_NS = 3600 * 10**9


@dataclass(frozen=True)
class Capture:
    """One board placement as the sensors recorded it.

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
        """SHA-256 of every image, scan and stretch of events in it."""
        return frozenset(entry.sha256 for entry in self._manifest.files)

    @property
    def contents(self) -> list[dict[str, Any]]:
        """What samples it holds: sensor, timestamps and SHA-256 of each file, in a fixed order."""
        return sorted(
            (entry.model_dump(exclude={"file", "bytes"}) for entry in self._manifest.files),
            key=lambda entry: str(entry["sha256"]),
        )

    @property
    def times_ns(self) -> list[int]:
        """When its samples arrived, on this computer's clock; their own timestamps where that is unknown."""
        files = self._manifest.files
        arrivals = [entry.host_ns for entry in files if entry.host_ns is not None]
        stamps = [e.last_ns if isinstance(e, EventsEntry) else e.stamp_ns for e in files]
        return arrivals or [stamp for stamp in stamps if stamp is not None]

    @property
    def serials(self) -> dict[str, str]:
        """Serial numbers by sensor, as far as the devices told them when it was taken."""
        told = self._manifest.meta.get(SERIALS)
        found = told.items() if isinstance(told, dict) else ()
        return {name: serial for name, serial in found if isinstance(serial, str) and serial}

    @property
    def manifest_sha256(self) -> str:
        """The manifest's fingerprint: of samples and timestamps.

        Raises:
            SessionError: there is none.
        """
        with self._reading(MANIFEST):
            return hashlib.sha256(read_file(self.path / MANIFEST, MAX_DOCUMENT_BYTES)).hexdigest()

    @property
    def image_keys(self) -> list[tuple[str, str]]:
        """(camera, channel) of every image, sorted."""
        return sorted((entry.camera, entry.channel) for entry in self._manifest.images)

    @property
    def lidars(self) -> list[str]:
        """Names of the LiDARs with a scan, sorted."""
        return sorted(entry.lidar for entry in self._manifest.scans)

    @property
    def event_cameras(self) -> list[str]:
        """Names of the cameras with events, sorted."""
        return sorted(entry.camera for entry in self._manifest.events)

    def has_image(self, camera: str, channel: str) -> bool:
        """Return whether this capture has an image of that camera and channel."""
        return (camera, channel) in self.image_keys

    def image(self, camera: str, channel: str) -> Image:
        """Read an image exactly as it was captured.

        Raises:
            SessionError: there is none, or it is damaged.
        """
        import cv2

        entries = [e for e in self._manifest.images if (e.camera, e.channel) == (camera, channel)]
        entry: ImageEntry = self._only(entries, f"nothing from {camera}.{channel}")
        with self._reading(entry.file):
            pixels = decode_pixels(self._read(entry), cv2.IMREAD_UNCHANGED)
        if pixels.dtype != np.uint8 or not (pixels.ndim == 2 or pixels.shape[2:] == (3,)):
            raise self._damaged(f"{entry.file} is {pixels.dtype} {pixels.shape}, not 8-bit grey or BGR")
        return Image(camera, channel, entry.stamp_ns, pixels, entry.host_ns)

    def scan(self, lidar: str) -> Scan:
        """Read a scan exactly as it was captured.

        Raises:
            SessionError: there is none, or it is damaged.
        """
        entries = [e for e in self._manifest.scans if e.lidar == lidar]
        entry: ScanEntry = self._only(entries, f"nothing from {lidar}")
        with self._reading(entry.file):
            cloud = decode_pcd(self._read(entry))
            has_time = "time" in (cloud.dtype.names or ())
            return Scan(
                lidar,
                entry.stamp_ns,
                np.stack([_lengths(cloud, axis) for axis in "xyz"], axis=1),
                _lengths(cloud, "intensity"),
                _whole(cloud, "ring", 0, np.iinfo(np.int16).max).astype(np.int16),
                _whole(cloud, "time", -_MAX_OFFSET_NS, _MAX_OFFSET_NS) if has_time else None,
                entry.host_ns,
            )

    def events(self, camera: str) -> Events:
        """Read the events about this capture exactly as they were recorded, timestamps to the microsecond.

        Raises:
            SessionError: there are none, or they are damaged.
        """
        entries = [e for e in self._manifest.events if e.camera == camera]
        entry: EventsEntry = self._only(entries, f"no events from {camera}")
        with self._reading(entry.file):
            events = decode_events(self._read(entry), camera)
            check_events(events)
        if stamps_of(events) != {"first_ns": entry.first_ns, "last_ns": entry.last_ns}:
            raise self._damaged(f"{entry.file} holds other timestamps than {MANIFEST} says")
        return events

    def check(self) -> None:
        """Read every file once.

        Raises:
            SessionError: the first thing found wrong.
        """
        for entry in self._manifest.files:
            self._read(entry)

    @cached_property
    def _manifest(self) -> Manifest:
        with self._reading(MANIFEST):
            document = read_json(self.path / MANIFEST)
            version = document.get("format_version") if isinstance(document, dict) else None
            if isinstance(version, int) and version > EVENTS_VERSION:
                raise SessionError(f"capture {self.name} was written by a newer lce-rig", "Update lce-rig.")
            manifest = parse_manifest(document)
        for entry in manifest.files:
            self._require_here(entry.file)
        return manifest

    def _require_here(self, name: str) -> None:
        # The manifest is untrusted input: it must not make us read or show files elsewhere.
        # Unlike Path.resolve, realpath accepts circular links; it raises on a NUL.
        is_here = SAFE_NAME.fullmatch(name) is not None and (
            Path(os.path.realpath(self.path / name)).parent == Path(os.path.realpath(self.path))
        )
        if not is_here:
            raise SessionError(
                f"capture {self.name}: {MANIFEST} names the file {name!r} outside the capture's folder",
                f"Files outside {self.path} are not read. Remove this capture if you did not make it "
                "yourself.",
            )

    def _only(self, entries: Sequence[_SOME_ENTRY], lacking: str) -> _SOME_ENTRY:
        """Return the entry of a sensor, at most one."""
        if entries:
            return entries[0]
        have = [".".join(key) for key in self.image_keys] + self.lidars
        have += [f"events of {camera}" for camera in self.event_cameras]
        raise SessionError(f"capture {self.name} has {lacking}; it has {', '.join(have) or 'nothing'}")

    def _read(self, entry: Entry) -> bytes:
        with self._reading(entry.file):
            data = read_file(self.path / entry.file)
        if len(data) != entry.bytes:
            raise self._damaged(f"{entry.file} has {len(data)} of {entry.bytes} bytes")
        if hashlib.sha256(data).hexdigest() != entry.sha256:
            raise self._damaged(f"{entry.file} has changed since it was captured (checksum)")
        return data

    @contextmanager
    def _reading(self, name: str) -> Iterator[None]:
        """Report what is wrong with a file of the capture as damage."""
        try:
            yield
        except LceRigError:
            raise
        except Exception as error:  # of a library, about a damaged file
            raise self._damaged(f"{name}: {reason_of(error)}") from None

    def _damaged(self, what: str) -> SessionError:
        hint = f"Remove {self.path} and collect again; the other captures are not affected."
        return SessionError(f"capture {self.name} is damaged: {what}", hint)


def _lengths(cloud: NDArray[Any], name: str) -> NDArray[np.float32]:
    """Take a field of finite values from a scan's point cloud; raise a ValueError if one is not."""
    values = _field(cloud, name, "f")
    if not np.isfinite(values).all() or np.abs(values).max(initial=0) > np.finfo(np.float32).max:
        raise ValueError(f"its field {name} is not finite everywhere")
    return values.astype(np.float32)


def _whole(cloud: NDArray[Any], name: str, lowest: int, highest: int) -> NDArray[np.int64]:
    """Take a field of whole numbers from a scan's point cloud; raise a ValueError if one is not."""
    values = _field(cloud, name, "iu")
    if len(values) and (int(values.min()) < lowest or int(values.max()) > highest):
        raise ValueError(f"its field {name} runs from {values.min()} to {values.max()} (limit {highest})")
    return values.astype(np.int64)


def _field(cloud: NDArray[Any], name: str, kinds: str) -> NDArray[Any]:
    if name not in (cloud.dtype.names or ()):
        raise ValueError(f"it has no field {name}; it has {', '.join(cloud.dtype.names or ())}")
    if cloud[name].ndim != 1 or cloud[name].dtype.kind not in kinds:
        raise ValueError(f"its field {name} is of type {cloud.dtype[name]}")
    return cloud[name]
