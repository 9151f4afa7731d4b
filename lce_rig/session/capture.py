"""One capture of a session: a folder of plain files and the manifest that vouches for them."""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.event_file import decode_events
from lce_rig.core.pcd import decode_pcd
from lce_rig.session.writing import EVENTS_VERSION, MANIFEST, check_events, stamps_of

SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")
# What an entry of each kind names besides its file: sensors, and stamps in ns or null.
_SENSORS = {"image": ("camera", "channel"), "scan": ("lidar",), "events": ("camera", "channel")}
_STAMPS = {
    "image": ("stamp_ns", "host_ns"),
    "scan": ("stamp_ns", "host_ns"),
    "events": ("first_ns", "last_ns", "host_ns"),
}


@dataclass(frozen=True)
class Capture:
    """One board placement as the sensors saw it.

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
        """What the collector wrote about this capture (source, duplicates, board poses)."""
        return dict(self._manifest["meta"])

    @property
    def content_sha256(self) -> str:
        """The fingerprint `content_hash` gave when the capture was written."""
        return str(self._manifest["content_sha256"])

    @property
    def file_hashes(self) -> frozenset[str]:
        """SHA-256 of every picture, scan and stretch of events in it."""
        return frozenset(str(entry["sha256"]) for entry in self._manifest["files"])

    @property
    def manifest_sha256(self) -> str:
        """A fingerprint of the manifest: of what the sensors saw, and when.

        Raises:
            SessionError: there is none.
        """
        try:
            return hashlib.sha256((self.path / MANIFEST).read_bytes()).hexdigest()
        except OSError as error:
            raise self._damaged(f"{MANIFEST} cannot be read: {error.strerror}") from None

    @property
    def image_keys(self) -> list[tuple[str, str]]:
        """(camera, channel) of every picture, sorted."""
        return sorted((e["camera"], e["channel"]) for e in self._manifest["files"] if e["kind"] == "image")

    @property
    def lidars(self) -> list[str]:
        """Names of the LiDARs with a scan, sorted."""
        return sorted(e["lidar"] for e in self._manifest["files"] if e["kind"] == "scan")

    @property
    def event_cameras(self) -> list[str]:
        """Names of the cameras with events, sorted."""
        return sorted(e["camera"] for e in self._manifest["files"] if e["kind"] == "events")

    def has_image(self, camera: str, channel: str) -> bool:
        """Tell whether this capture has a picture of that camera and channel."""
        return (camera, channel) in self.image_keys

    def image(self, camera: str, channel: str) -> Image:
        """Read a picture exactly as it was captured.

        Raises:
            SessionError: there is none, or it is damaged.
        """
        import cv2

        entry = self._entry(kind="image", camera=camera, channel=channel)
        data = np.frombuffer(self._read(entry), dtype=np.uint8)
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        if pixels is None:
            raise self._damaged(f"{entry['file']} is no picture")
        return Image(camera, channel, entry["stamp_ns"], np.asarray(pixels, dtype=np.uint8), entry["host_ns"])

    def scan(self, lidar: str) -> Scan:
        """Read a scan exactly as it was captured.

        Raises:
            SessionError: there is none, or it is damaged.
        """
        entry = self._entry(kind="scan", lidar=lidar)
        try:
            cloud = decode_pcd(self._read(entry))
            points = np.stack([cloud["x"], cloud["y"], cloud["z"]], axis=1)
            has_time = "time" in (cloud.dtype.names or ())
            offset_ns = cloud["time"].astype(np.int64) if has_time else None
            return Scan(
                lidar,
                entry["stamp_ns"],
                points,
                np.ascontiguousarray(cloud["intensity"]),
                np.ascontiguousarray(cloud["ring"]),
                offset_ns,
                entry["host_ns"],
            )
        except ValueError as error:
            raise self._damaged(f"{entry['file']}: {error}") from None

    def events(self, camera: str) -> Events:
        """Read the events about this capture exactly as they were recorded, stamps to the microsecond.

        Raises:
            SessionError: there are none, or they are damaged.
        """
        entry = self._entry(kind="events", camera=camera)
        try:
            events = decode_events(self._read(entry), camera)
            check_events(events)
        except ValueError as error:
            raise self._damaged(f"{entry['file']}: {error}") from None
        if any(entry[name] != stamp for name, stamp in stamps_of(events).items()):
            raise self._damaged(f"{entry['file']} holds other stamps than {MANIFEST} says")
        return events

    def check(self) -> None:
        """Read every file once.

        Raises:
            SessionError: the first thing found wrong.
        """
        for entry in self._manifest["files"]:
            self._read(entry)

    @cached_property
    def _manifest(self) -> dict[str, Any]:
        try:
            manifest = json.loads((self.path / MANIFEST).read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise self._damaged(f"it has no {MANIFEST}") from None
        except (OSError, ValueError, RecursionError) as error:
            raise self._damaged(f"{MANIFEST} cannot be read: {error}") from None
        try:
            if manifest["format_version"] > EVENTS_VERSION:
                raise SessionError(f"capture {self.name} was written by a newer lce-rig", "Update lce-rig.")
            if not isinstance(manifest["meta"], dict) or not isinstance(manifest["content_sha256"], str):
                raise TypeError
            for entry in manifest["files"]:
                self._check_entry(entry)
        except (KeyError, TypeError):
            raise self._damaged(f"{MANIFEST} lacks what a manifest needs") from None
        return dict(manifest)

    def _check_entry(self, entry: Mapping[str, Any]) -> None:
        name = str(entry["file"])
        # The manifest is input like any other: it must not make us read, or show, files elsewhere.
        if not SAFE_NAME.fullmatch(name) or (self.path / name).resolve().parent != self.path.resolve():
            raise SessionError(
                f"capture {self.name}: {MANIFEST} names the file {name!r} outside the capture's folder",
                f"Nothing outside {self.path} is read. Remove this capture if you did not make it yourself.",
            )
        sensors = [entry[key] for key in _SENSORS[entry["kind"]]]
        stamps = [entry[key] for key in _STAMPS[entry["kind"]]]
        if not all(isinstance(sensor, str) for sensor in [*sensors, entry["sha256"]]):
            raise TypeError
        if not all(stamp is None or isinstance(stamp, int) for stamp in [*stamps, entry["bytes"]]):
            raise TypeError

    def _entry(self, **wanted: str) -> dict[str, Any]:
        for entry in self._manifest["files"]:
            if all(entry.get(key) == value for key, value in wanted.items()):
                return dict(entry)
        sensor = ".".join(value for key, value in wanted.items() if key != "kind")
        what = "no events" if wanted["kind"] == "events" else "nothing"
        have = [".".join(key) for key in self.image_keys] + self.lidars
        have += [f"events of {camera}" for camera in self.event_cameras]
        raise SessionError(
            f"capture {self.name} has {what} from {sensor}; it has {', '.join(have) or 'nothing'}"
        )

    def _read(self, entry: Mapping[str, Any]) -> bytes:
        try:
            data = (self.path / entry["file"]).read_bytes()
        except OSError as error:
            raise self._damaged(f"{entry['file']}: {error.strerror}") from None
        if len(data) != entry["bytes"]:
            raise self._damaged(f"{entry['file']} has {len(data)} of {entry['bytes']} bytes")
        if hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise self._damaged(f"{entry['file']} is not what was captured (checksum)")
        return bytes(data)

    def _damaged(self, what: str) -> SessionError:
        hint = f"Remove {self.path} and collect again; the other captures are not affected."
        return SessionError(f"capture {self.name} is damaged: {what}", hint)
