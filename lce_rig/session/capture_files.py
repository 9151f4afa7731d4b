"""Write a capture: samples as plain files, and a manifest with their checksums."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.files import encode_events, encode_pcd
from lce_rig.session.durable import flush_folder, write_new_file

MANIFEST = "meta.json"
PLAIN_VERSION, EVENTS_VERSION = 1, 2
"""Versions of manifests without and with events; older programs read those without."""


def content_hash(images: Iterable[Image], scans: Iterable[Scan], events: Iterable[Events] = ()) -> str:
    """Fingerprint samples without their timestamps, independently of the files they came from.

    Of events, the time differences count.

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
        events: with the channel that they come from.

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
    # OpenCV's PNG compression 1 is five times faster than its 9 and 10 % larger.
    is_done, data = cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not is_done:
        raise ValueError(f"an image of {image.sensor} could not be encoded as PNG")
    entry = {"kind": "image", "camera": image.sensor, "channel": image.channel}
    stored = _store(folder, f"{image.sensor}.{image.channel}.png", bytes(data))
    return {**entry, **stored, "stamp_ns": image.stamp_ns, "host_ns": image.host_ns}


def _store_scan(folder: Path, scan: Scan) -> dict[str, Any]:
    stored = _store(folder, f"{scan.sensor}.pcd", _encode_scan(scan))
    stamps = {"stamp_ns": scan.stamp_ns, "host_ns": scan.host_ns}
    return {"kind": "scan", "lidar": scan.sensor, **stored, **stamps}


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
        # 32 bits hold 4.3 s, and many viewers read no other type; a longer scan needs 64.
        fits = len(scan.offset_ns) == 0 or (scan.offset_ns.min() >= 0 and scan.offset_ns.max() < 2**32)
        columns["time"] = ("u4" if fits else "i8", scan.offset_ns)
        comments.append("time: ns after the first firing")
    cloud = np.empty(len(scan.points), dtype=[(name, kind) for name, (kind, _) in columns.items()])
    for name, (_, values) in columns.items():
        cloud[name] = values
    return encode_pcd(cloud, comments)
