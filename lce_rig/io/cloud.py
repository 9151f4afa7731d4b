"""Convert a point cloud with any fields to a `Scan`: names, units and conventions."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import NO_RING, Scan
from lce_rig.core.errors import SourceError
from lce_rig.core.geometry import Array
from lce_rig.core.ring_apex import MAX_APEX_M, find_apex
from lce_rig.rig import LidarSettings

# Inferred rings: bin of elevation, maximum number, maximum height of a laser above the origin.
BIN_RAD = np.radians(0.02)
MAX_RINGS = 256
MAX_OFFSET_M = 0.015
# Prior of a ring's height, which one distance does not determine: 0.1 mrad against 15 mm.
HEIGHT_PRIOR = (1e-4 / MAX_OFFSET_M) ** 2

INTENSITY_FIELDS = ("intensity", "reflectivity", "intensities", "i", "signal")
RING_FIELDS = ("ring", "channel", "laser_id", "laserid", "line")
TIME_FIELDS = ("time", "t", "timestamp", "offset", "offset_time", "time_offset", "timeoffset")
# Half of the returns in a room or street are well within a LiDAR's range, unless the unit is mm.
_FARTHEST_MEDIAN = 3.0
# A scan lasts 0.02 to 1.5 s for any spinning LiDAR; the same figure in another unit is far outside.
SWEEP_S = (0.02, 1.5)
_MOST_RINGS = 1024
# A spinning laser stays within this, even seen from a frame that is tilted by 10 deg; a rosette does not.
_MOST_THICKNESS_DEG, _N_DIRECTIONS = 1.0, 36
_NO_RINGS_HINT = (
    "For a LiDAR without rings (Livox, solid state), name the model in the profile, or set `model: "
    "unstructured`. For a spinning one, give the point cloud with its ring field, in the LiDAR's own frame."
)
NS_PER_UNIT = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


def rings_from_elevation(points_lidar: NDArray[Any]) -> NDArray[np.int16]:
    """Number the lasers of a point cloud without a ring field, 0 = lowest elevation.

    A laser mounted h above the origin of the frame and inclined by alpha draws the line
    z = rho tan(alpha) + h over the distance rho from the vertical axis. The lines are found as peaks of
    elevation among the far points, where h (11 mm at most on a VLP-16) hardly bends them, and refitted with
    all points. The points left over are searched again, for lasers with few points or near points only.

    Args:
        points_lidar: (N, 3) m, frame lidar (z along the axis of rotation); NaN for a missing return.

    Returns:
        (N,) int16; -1 for a point that is not finite or at the origin.

    Raises:
        SourceError: the elevations form no rings, as with a solid-state LiDAR or a point cloud that was
            moved.
    """
    points = np.asarray(points_lidar, dtype=np.float64)
    rho = np.hypot(points[:, 0], points[:, 1])
    is_valid = np.isfinite(points).all(axis=1) & (rho > 1e-3)
    ring = np.full(len(points), -1, dtype=np.int16)
    if is_valid.any():
        ring[is_valid] = _assign(rho[is_valid], points[is_valid, 2])
    return ring


def _assign(rho: Array, z: Array) -> NDArray[np.int16]:
    """Find the lines, and the nearest line to each point (rho, z)."""
    slope = z / rho
    lines = np.zeros((0, 2))
    is_left = rho >= min(3.0, float(np.median(rho)))
    for _ in range(3):
        peaks = np.tan(_elevation_peaks(np.arctan(slope[is_left])))
        lines = np.concatenate([lines, np.stack([peaks, np.zeros_like(peaks)], axis=1)])
        if not len(lines):
            raise SourceError(f"no rings: its {len(rho)} points are too few or too scattered")
        lines = _refine_lines(rho, z, lines[np.argsort(lines[:, 0])])
        ring, miss = _nearest_line(rho, z, lines)
        is_left = (miss > MAX_OFFSET_M) & (miss > 5 * BIN_RAD * rho)
        if is_left.sum() < max(3, 1e-4 * len(rho)):
            break
    seen, ring_of_seen = np.unique(ring, return_inverse=True)
    if len(seen) > MAX_RINGS or np.mean(is_left) > 0.1:
        raise SourceError(
            f"no rings: {100 * np.mean(is_left):.0f} % of its points lie on none of the {len(seen)} "
            "elevations found"
        )
    return ring_of_seen.astype(np.int16)


def _elevation_peaks(elevation: Array) -> Array:
    """Find elevations in rad shared by many points: peaks of a histogram above its background."""
    low = elevation.min() - 2 * BIN_RAD
    bins = ((elevation - low) / BIN_RAD).astype(np.intp)
    counts = np.bincount(bins, minlength=int(bins.max()) + 3).astype(np.float64)
    smooth = np.convolve(counts, np.ones(3), mode="same")
    level = max(2.5, 0.05 * float(np.quantile(smooth[smooth > 0], 0.9)))
    step = np.diff(np.concatenate([[0], smooth > level, [0]]).astype(np.int8))
    bounds = np.stack([np.flatnonzero(step > 0), np.flatnonzero(step < 0)], axis=1).ravel()
    if len(bounds) == 0:
        return np.zeros(0)
    centres = low + (np.arange(len(counts)) + 0.5) * BIN_RAD
    weight = np.add.reduceat(np.append(counts, 0.0), bounds)[::2]
    moment = np.add.reduceat(np.append(counts * centres, 0.0), bounds)[::2]
    return np.asarray(moment[weight > 0] / weight[weight > 0])


def _nearest_line(rho: Array, z: Array, lines: Array) -> tuple[NDArray[np.intp], Array]:
    """Find the line (slope, offset) nearest in z to each point, and the distance in m; lines ascend."""
    # Limit an offset's shift of a point to the distance between neighbouring lines.
    guess = np.searchsorted((lines[1:, 0] + lines[:-1, 0]) / 2, z / rho)
    nearest, miss = guess, np.abs(z - rho * lines[guess, 0] - lines[guess, 1])
    for shift in (-1, 1):
        other = np.clip(guess + shift, 0, len(lines) - 1)
        other_miss = np.abs(z - rho * lines[other, 0] - lines[other, 1])
        is_better = other_miss < miss
        nearest, miss = np.where(is_better, other, nearest), np.where(is_better, other_miss, miss)
    return nearest, miss


def _refine_lines(rho: Array, z: Array, lines: Array) -> Array:
    """Fit z / rho = slope + offset / rho to the points of each line, least squares in elevation."""
    n = len(lines)
    if n < 2:
        return lines
    x, y = 1.0 / rho, z / rho
    for _ in range(3):
        ring, _ = _nearest_line(rho, z, lines)
        count = np.maximum(np.bincount(ring, minlength=n), 1)
        mean_x, mean_y = np.bincount(ring, x, n) / count, np.bincount(ring, y, n) / count
        dx, dy = x - mean_x[ring], y - mean_y[ring]
        offset = np.bincount(ring, dx * dy, n) / (np.bincount(ring, dx * dx, n) + HEIGHT_PRIOR * count)
        offset = np.clip(offset, -MAX_OFFSET_M, MAX_OFFSET_M)
        refined = np.stack([mean_y - offset * mean_x, offset], axis=1)
        is_seen = np.bincount(ring, minlength=n) > 0
        lines = np.where(is_seen[:, None], refined, lines)
        lines = lines[np.argsort(lines[:, 0], kind="stable")]
    return lines


# NaN and values beyond a type's range are checked when used.
@np.errstate(over="ignore", invalid="ignore")
def to_scan(
    cloud: NDArray[Any],
    lidar: str,
    settings: LidarSettings,
    where: str,
    stamp_ns: int | None = None,
    host_ns: int | None = None,
    notes: set[str] | None = None,
) -> Scan:
    """Build a scan from a point cloud with any fields.

    Args:
        cloud: structured (N,) with at least x, y, z in m, frame lidar.
        lidar: the LiDAR's name in the profile.
        settings: its settings; `timestamps.reference` names the firing that `stamp_ns` marks.
        where: file or topic, for messages.
        stamp_ns: the point cloud's timestamp as recorded, or None.
        host_ns: arrival at the host.
        notes: receives the missing fields and the assumptions made, in words.

    Returns:
        The points with a return: finite, neither at the origin nor above or below it, and not nearer than
        `min_range_m`.

    Raises:
        SourceError: no coordinates, no valid point, coordinates that are not metres, or no rings and none
            that could be inferred from elevation angles.
    """
    fields = {
        name.lower(): name for name in reversed(cloud.dtype.names or ()) if _is_scalar(cloud.dtype[name])
    }
    missing = [axis for axis in "xyz" if axis not in fields]
    if missing:
        have = ", ".join(
            name if _is_scalar(cloud.dtype[name]) else f"{name} (not one number per point)"
            for name in cloud.dtype.names or ()
        )
        raise SourceError(
            f"{where}: the point cloud has no field {missing[0]!r}; its fields are {have or 'none'}"
        )
    points = np.stack([cloud[fields[axis]].astype(np.float32) for axis in "xyz"], axis=1)
    x, y, z = points.T.astype(np.float64)
    flat_m = np.hypot(x, y)
    # No laser of a spinning LiDAR looks along its axis: such a point has no ring.
    is_kept = np.isfinite(x) & np.isfinite(y) & np.isfinite(z) & (flat_m > 1e-3)
    if not is_kept.any():
        raise SourceError(f"{where}: the point cloud has no valid point ({len(points)} in all)")
    # Returns from the LiDAR's housing and mount are on no ring and are not used.
    is_far = is_kept & (np.hypot(flat_m, z) >= settings.min_range_m)
    if not is_far.any():
        raise SourceError(
            f"{where}: all {is_kept.sum()} returns are nearer than min_range_m {settings.min_range_m:g} m",
            "Correct the LiDAR's model or min_range_m in the profile.",
        )
    is_kept = is_far
    median_m = float(np.median(np.hypot(flat_m, z)[is_kept]))
    if median_m > _FARTHEST_MEDIAN * settings.max_range_m:
        raise SourceError(
            f"{where}: median range {round(median_m):.9g} m, the LiDAR reaches "
            f"{settings.max_range_m:g} m: points in millimetres must be converted to metres"
        )
    notes = set() if notes is None else notes
    if not settings.has_rings and "tag" in fields:
        is_noise = is_kept & _is_noise(cloud[fields["tag"]], settings)
        if is_noise.any():
            notes.add("returns whose tag says noise, rain or bleeding are dropped")
            is_kept &= ~is_noise
    if not is_kept.all():
        points, cloud = points[is_kept], cloud[is_kept]
    if settings.has_rings:
        ring = _ring(cloud, fields, points, where, notes)
    else:
        ring = np.full(len(points), NO_RING, dtype=np.int16)
    offset_ns, stamp_ns = _times(cloud, fields, settings, stamp_ns, notes)
    name = _find(fields, INTENSITY_FIELDS)
    if name is None:
        notes.add("no intensity")
        intensity = np.zeros(len(cloud), dtype=np.float32)
    else:
        intensity = np.nan_to_num(cloud[name].astype(np.float32), posinf=0.0, neginf=0.0)
    return Scan(lidar, stamp_ns, points, intensity, ring, offset_ns, host_ns)


def _is_noise(tag: NDArray[Any], settings: LidarSettings) -> NDArray[np.bool_]:
    """Check which Livox tags (N,) mark a return as noise with high or moderate confidence.

    Bits 0-1 classify by place, 2-3 by intensity (rain, fog, dust). Bits 4-5 number the return, from the
    Mid-360 and the HAP on they mark returns between near objects: points that bleed over an edge.

    References:
        Livox Wiki, point cloud characteristics: tag information.
    """
    bits = tag.astype(np.uint8)
    groups = (0, 2, 4) if getattr(settings.data_sheet(), "name", "") in ("Mid-360", "HAP") else (0, 2)
    levels = np.stack([(bits >> shift) & 3 for shift in groups])
    return np.asarray(((levels == 1) | (levels == 2)).any(axis=0))


def _is_scalar(field: np.dtype[Any]) -> bool:
    """Check whether a field is one number per point."""
    return field.shape == () and field.kind in "biuf"


def _find(fields: dict[str, str], candidates: tuple[str, ...]) -> str | None:
    return next((fields[name] for name in candidates if name in fields), None)


def _ring(
    cloud: NDArray[Any], fields: dict[str, str], points: NDArray[np.float32], where: str, notes: set[str]
) -> NDArray[np.int16]:
    name = _find(fields, RING_FIELDS)
    values = np.zeros(len(cloud)) if name is None else cloud[name].astype(np.float64)
    ids, ring_of_point = np.unique(values, return_inverse=True)
    is_constant = len(cloud) > 100 and len(ids) == 1
    if name is None or is_constant or not np.isfinite(values).all() or len(ids) > _MOST_RINGS:
        return _inferred(points, where, "no ring field", notes)
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0].astype(np.float64), points[:, 1]))
    thickness_deg = _ring_thickness_deg(ring_of_point, elevation, points)
    if thickness_deg > _MOST_THICKNESS_DEG:
        _refuse_other_frame(points, ring_of_point.astype(np.int16), where)
        cause = f"field {name!r} numbers no rings: its points scatter by {thickness_deg:.1f} deg in elevation"
        return _inferred(points, where, cause, notes)
    mean = np.bincount(ring_of_point, elevation) / np.bincount(ring_of_point)
    rank = np.argsort(np.argsort(mean, kind="stable"), kind="stable")
    is_whole = ids[0] >= 0 and ids[-1] < 2**15 and bool((ids == np.rint(ids)).all())
    # Some drivers count lasers from the top (Ouster) or by firing order. Neighbouring rings with few near
    # points may swap their mean elevations; they keep their numbers if Spearman's correlation is high.
    rises = bool((np.diff(rank) > 0).all())
    if len(rank) >= 3:
        rises = bool(np.corrcoef(np.arange(len(rank)), rank)[0, 1] > 0.98)
    if is_whole and rises:
        return values.astype(np.int16)
    notes.add(f"field {name!r} does not count rings from the lowest: renumbered by elevation")
    return rank[ring_of_point].astype(np.int16)


def _refuse_other_frame(points: NDArray[np.float32], ring: NDArray[np.int16], where: str) -> None:
    """Raise SourceError if rings scatter in elevation because the points are in another frame."""
    apex = find_apex(points, ring)
    if apex is not None and apex.is_beyond(MAX_APEX_M) and apex.rms_rad < np.radians(_MOST_THICKNESS_DEG):
        x, y, z = np.round(apex.position_m, 2) + 0.0  # no -0.00
        meet = f"the rings meet at ({x:.2f}, {y:.2f}, {z:.2f}) m"
        raise SourceError(
            f"{where}: {meet}, not at the origin of the points' frame",
            "Record the points in the LiDAR's own frame, not in the robot's.",
        )


def _inferred(points: NDArray[np.float32], where: str, cause: str, notes: set[str]) -> NDArray[np.int16]:
    """Number the rings by elevation; without rings, raise a SourceError with the cause."""
    try:
        ring = rings_from_elevation(points)
    except SourceError as error:
        raise SourceError(f"{where}: {cause}, {error.what}", _NO_RINGS_HINT) from None
    notes.add(f"{cause}: rings inferred from elevation angles")
    return ring


def _ring_thickness_deg(
    ring: NDArray[np.intp], elevation: NDArray[np.float64], points: NDArray[np.float32]
) -> float:
    """Compute the median standard deviation of the elevation of one ring in one direction, deg.

    Each direction counts separately because a point cloud in another frame may be tilted. The median is used
    because near returns are shifted by the beam's offset inside the sensor.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    cell = ring * _N_DIRECTIONS + ((azimuth / (2 * np.pi) + 0.5) * (_N_DIRECTIONS - 1)).astype(np.intp)
    count = np.bincount(cell)
    is_full = count >= 5
    if not is_full.any():
        return 0.0
    n = count[is_full]
    mean = np.bincount(cell, elevation)[is_full] / n
    square = np.bincount(cell, elevation * elevation)[is_full] / n
    return float(np.degrees(np.median(np.sqrt(np.maximum(square - mean * mean, 0.0)))))


def _times(
    cloud: NDArray[Any],
    fields: dict[str, str],
    settings: LidarSettings,
    stamp_ns: int | None,
    notes: set[str],
) -> tuple[NDArray[np.int64] | None, int | None]:
    """Find each point's time after the first firing, and the timestamp of the first firing."""
    is_last = settings.timestamps.reference == "last_firing"
    name = _find(fields, TIME_FIELDS)
    ticks = None if name is None else _ticks(cloud[name])
    unit = None if ticks is None else _unit(ticks)
    if ticks is None or unit is None:
        notes.add("points without times" if name is None else f"field {name!r} has no times of points")
        sweep_ns = round(1e9 / settings.rate_hz) if is_last else 0
        return None, None if stamp_ns is None else stamp_ns - sweep_ns
    first = ticks.min()
    if unit != _usual_unit(ticks):
        notes.add(f"field {name!r} taken as {unit}")
    scale = NS_PER_UNIT[unit]
    offset_ns = np.rint((ticks - first) * scale).astype(np.int64)
    if stamp_ns is None:
        return offset_ns, None
    first_ns, last_ns = round(float(first) * scale), round(float(ticks.max()) * scale)
    if abs(first_ns) > 10**12 or first_ns > 10**9 > abs(first_ns - stamp_ns):
        # Times since an epoch, or since the LiDAR's start: only the timestamp's own clock is shared with the
        # cameras.
        return offset_ns, stamp_ns - (last_ns - first_ns if is_last else 0)
    if is_last and first_ns >= 0:
        return offset_ns, stamp_ns - last_ns + first_ns
    # velodyne_pointcloud gives times relative to the timestamp: negative if it marks the last packet.
    return offset_ns, stamp_ns + first_ns


def _ticks(values: NDArray[Any]) -> NDArray[Any] | None:
    """Convert a time field to integers or float64; None if it is constant, not finite or rounded away."""
    if values.dtype.kind in "iu":
        ticks: NDArray[Any] = values.astype(np.int64)
        return ticks if np.ptp(ticks) > 0 else None
    ticks = values.astype(np.float64)
    # More than a century in nanoseconds is not a time in any unit.
    if not np.isfinite(ticks).all() or np.abs(ticks).max() > np.iinfo(np.int64).max or np.ptp(ticks) == 0:
        return None
    # The resolution of a float32 of Unix time is two minutes.
    step = float(np.spacing(np.abs(values).max()))
    return ticks if np.ptp(ticks) > 1000 * step else None


def _unit(ticks: NDArray[Any]) -> str | None:
    """Return the unit that fits the scan's duration; None if the duration is too long in every unit."""
    span = float(ticks.max()) - float(ticks.min())
    for unit, scale in NS_PER_UNIT.items():
        if SWEEP_S[0] <= span * scale * 1e-9 <= SWEEP_S[1]:
            return unit
    # A sector of a scan may be shorter than any scan; it has the usual unit of its type.
    usual = _usual_unit(ticks)
    return usual if span * NS_PER_UNIT[usual] * 1e-9 < SWEEP_S[0] else None


def _usual_unit(ticks: NDArray[Any]) -> str:
    return "ns" if ticks.dtype.kind == "i" else "s"
