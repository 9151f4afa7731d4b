"""What a reader accepted must be something that a sensor can have seen."""

from typing import Any

import numpy as np

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.limits import MAX_EVENTS, MAX_PIXELS, MAX_POINTS


class InsaneError(Exception):
    """A reader accepted what no sensor delivers."""


def check_sample(sample: Any) -> None:
    """Check an image, a scan or events.

    Raises:
        InsaneError: it is not what its class promises.
    """
    checks = {Image: _check_image, Scan: check_scan, Events: check_events}
    require(type(sample) in checks, f"a {type(sample).__name__} is no sample")
    checks[type(sample)](sample)  # type: ignore[operator]


def _check_image(image: Image) -> None:
    check_pixels(image.pixels)
    _check_stamps(image.stamp_ns, image.host_ns)


def check_pixels(pixels: Any) -> None:
    """Check (H, W) or (H, W, 3) uint8."""
    require(isinstance(pixels, np.ndarray) and pixels.dtype == np.uint8, "pixels are no array of uint8")
    is_shaped = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    require(is_shaped and 0 < pixels.shape[0] * pixels.shape[1] <= MAX_PIXELS, f"pixels {pixels.shape}")


def check_scan(scan: Scan) -> None:
    """Check the arrays of a scan against each other."""
    n = len(scan.points)
    require(0 < n <= MAX_POINTS, f"a scan of {n} points")
    require(scan.points.shape == (n, 3) and scan.points.dtype == np.float32, f"points {scan.points.shape}")
    require(bool(np.isfinite(scan.points).all()), "a point is not finite")
    require(scan.intensity.shape == (n,) and scan.ring.shape == (n,), "columns of unequal length")
    require(bool((scan.ring >= 0).all()), "a negative ring")
    require(scan.offset_ns is None or scan.offset_ns.shape == (n,), "times of another length")
    _check_stamps(scan.stamp_ns, scan.host_ns)


def check_events(events: Events) -> None:
    """Check the columns of events against each other and the resolution."""
    n = len(events.t_ns)
    require(n <= MAX_EVENTS, f"{n} events")
    for column in (events.t_ns, events.x, events.y, events.polarity):
        require(column.shape == (n,), "columns of unequal length")
    require(events.t_ns.dtype == np.int64, f"times are {events.t_ns.dtype}")
    require(not np.any(events.t_ns[1:] < events.t_ns[:-1]), "times fall")
    width, height = events.width_px, events.height_px
    require(0 <= width * height <= MAX_PIXELS and width >= 0, f"a sensor of {width}x{height} pixels")
    require(n == 0 or bool(events.x.max() < width and events.y.max() < height), "events off the sensor")
    _check_stamps(events.host_ns)


def check_pose(T: Any) -> None:
    """Check a rigid transform (4, 4)."""
    T = np.asarray(T)
    require(T.shape == (4, 4) and bool(np.isfinite(T).all()), "a pose that is no finite 4x4 matrix")
    require(bool(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-2), "a pose that is not rigid")


def _check_stamps(*stamps: Any) -> None:
    for stamp in stamps:
        is_whole = stamp is None or (isinstance(stamp, int) and not isinstance(stamp, bool))
        require(is_whole, f"a time of {stamp!r}")


def require(is_so: bool, otherwise: str) -> None:
    """Raise InsaneError where something is not so."""
    if not is_so:
        raise InsaneError(f"accepted: {otherwise}")
