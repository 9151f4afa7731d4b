"""One capture of a session: a folder of plain files and the manifest that vouches for them."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError
from lce_rig.core.pcd import decode_pcd, encode_pcd
from lce_rig.session.durable import flush_folder, write_new_file

MANIFEST = "meta.json"
FORMAT_VERSION = 1
SAFE_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*")


def content_hash(images: Iterable[Image], scans: Iterable[Scan]) -> str:
    """Fingerprint what the sensors saw, stamps left aside, whatever files it came from.

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
    return digest.hexdigest()


def write_capture(
    folder: Path, images: Iterable[Image], scans: Iterable[Scan], meta: Mapping[str, Any]
) -> None:
    """Fill an empty folder with one capture, every file flushed to the disk.

    Raises:
        OSError: a full disk, no permission.
        ValueError: a picture that is not 8-bit grey or BGR, or `meta` that is not JSON.
    """
    images, scans = list(images), list(scans)
    files: list[dict[str, Any]] = []
    for image in images:
        entry = {"kind": "image", "camera": image.sensor, "channel": image.channel}
        data = _encode_png(image)
        files.append({**entry, **_record(folder, f"{image.sensor}.{image.channel}.png", data, image)})
    for scan in scans:
        data = _encode_scan(scan)
        files.append(
            {"kind": "scan", "lidar": scan.sensor, **_record(folder, f"{scan.sensor}.pcd", data, scan)}
        )
    manifest = {
        "format_version": FORMAT_VERSION,
        "content_sha256": content_hash(images, scans),
        "files": files,
        "meta": dict(meta),
    }
    text = json.dumps(manifest, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_new_file(folder / MANIFEST, text.encode())
    flush_folder(folder)


def _record(folder: Path, name: str, data: bytes, sample: Image | Scan) -> dict[str, Any]:
    write_new_file(folder / name, data)
    return {
        "file": name,
        "bytes": len(data),
        "sha256": hashlib.sha256(data).hexdigest(),
        "stamp_ns": sample.stamp_ns,
        "host_ns": sample.host_ns,
    }


def _encode_png(image: Image) -> bytes:
    import cv2

    pixels = image.pixels
    if pixels.dtype != np.uint8 or not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)):
        raise ValueError(
            f"a picture of {image.sensor} is {pixels.dtype} {pixels.shape}, not 8-bit grey or BGR"
        )
    # OpenCV's PNG compression 1 is five times faster than its 9 and 10 % larger.
    is_done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not is_done:
        raise ValueError(f"a picture of {image.sensor} could not be encoded as PNG")
    return bytes(data)


def _encode_scan(scan: Scan) -> bytes:
    columns: dict[str, tuple[str, Any]] = {
        "x": ("f4", scan.points[:, 0]),
        "y": ("f4", scan.points[:, 1]),
        "z": ("f4", scan.points[:, 2]),
        "intensity": ("f4", scan.intensity),
        "ring": ("i2", scan.ring),
    }
    comments = ["frame of the lidar: x forward, y left, z up; m; ring 0 is the lowest"]
    if scan.offset_ns is not None:
        # 32 bits hold 4.3 s and are all that many viewers know; a longer sweep needs 64.
        fits = len(scan.offset_ns) == 0 or (scan.offset_ns.min() >= 0 and scan.offset_ns.max() < 2**32)
        columns["time"] = ("u4" if fits else "i8", scan.offset_ns)
        comments.append("time: ns after the first firing")
    cloud = np.empty(len(scan.points), dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        cloud[name] = values
    return encode_pcd(cloud, comments)


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
    def image_keys(self) -> list[tuple[str, str]]:
        """(camera, channel) of every picture, sorted."""
        return sorted((e["camera"], e["channel"]) for e in self._manifest["files"] if e["kind"] == "image")

    @property
    def lidars(self) -> list[str]:
        """Names of the LiDARs with a scan, sorted."""
        return sorted(e["lidar"] for e in self._manifest["files"] if e["kind"] == "scan")

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
        except (OSError, ValueError) as error:
            raise self._damaged(f"{MANIFEST} cannot be read: {error}") from None
        try:
            if manifest["format_version"] > FORMAT_VERSION:
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
        sensors = [entry["camera"], entry["channel"]] if entry["kind"] == "image" else [entry["lidar"]]
        stamps = [entry["stamp_ns"], entry["host_ns"]]
        if not all(isinstance(sensor, str) for sensor in [*sensors, entry["sha256"]]):
            raise TypeError
        if not all(stamp is None or isinstance(stamp, int) for stamp in [*stamps, entry["bytes"]]):
            raise TypeError

    def _entry(self, **wanted: str) -> dict[str, Any]:
        for entry in self._manifest["files"]:
            if all(entry.get(key) == value for key, value in wanted.items()):
                return dict(entry)
        sensor = ".".join(value for key, value in wanted.items() if key != "kind")
        have = [".".join(key) for key in self.image_keys] + self.lidars
        raise SessionError(
            f"capture {self.name} has nothing from {sensor}; it has {', '.join(have) or 'nothing'}"
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
