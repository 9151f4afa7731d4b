"""Compare the beams found in a scan with those of the profile's model."""

import math

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import DATA_SHEETS, DataSheet, find_data_sheet
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import Array
from lce_rig.io.cloud import HEIGHT_PRIOR
from lce_rig.io.findings import BEAMS_OF_OTHER_MODEL, POINTS_SKIPPED, RINGS_SKIPPED
from lce_rig.rig import LidarSettings

# Largest rms deviation of one unit's elevations from its model's, deg: two Ousters have 0.3 and 0.6, other
# models of as many rings at least 2.
_MAX_OF_UNIT_DEG = 1.0
# Largest rms distance of a part of a model's beams from the nearest of them, in spacings between them.
_MAX_OF_PART = 0.15
# Limits of suggested models: rms deviation, deg, and ratio of their undetected beams to detected rings.
_MAX_OF_PART_DEG, _MOST_UNSEEN = 0.1, 0.5
# Sectors per revolution, and minimum number of those with two rings, of rings, and of returns of a ring.
_N_SECTORS, _MIN_SECTORS, _MIN_RINGS, _MIN_RETURNS = 360, 20, 3, 10
# Largest usual ratio of rings with returns in a sector to those between its lowest and highest: nine
# recordings have 0.94 to 1 in the median sector, every fourth point of a VLP-16 has 0.57.
_FULL_RATIO = 0.75
# Largest usual share of sectors with returns of the upper half of the rings only, and of the lower half only:
# one of both is 0.012 at most in ten recordings, and 0.09 to 0.3 in most of them with every second point.
_MAX_HALVES = 0.03
# Smallest ratio of a ring's azimuth step to the model's that is named. It is 1.0 in 11 recordings; profiles
# of a VLP-16 at 20 Hz and an Ouster with 512 columns may state 10 Hz and 1024. Rings show every second point.
_SKIPPED_STEPS = 2.5
# Smallest azimuth step, rad: smaller differences are returns of one firing.
_MIN_STEP_RAD = 1e-4
_MAX_NAMED = 3


def measure_elevations(scan: Scan) -> Array:
    """Measure the elevation of each ring of a scan.

    A laser h above the frame's origin and inclined by alpha draws the line z = rho tan(alpha) + h over the
    distance rho from the axis: z / rho is fitted against 1 / rho for each ring.

    Args:
        scan: scan of at least a few metres around, in the LiDAR's own frame.

    Returns:
        (L,) deg, in the order of the rings' numbers.
    """
    rho = np.hypot(scan.points[:, 0], scan.points[:, 1]).astype(np.float64)
    x, y = 1 / rho, scan.points[:, 2] / rho
    elevations = []
    for ring in np.unique(scan.ring):
        mine = scan.ring == ring
        # Fit twice: returns of foreign rings and of edges are few, but far off.
        for _ in range(2):
            dx, dy = x[mine] - x[mine].mean(), y[mine] - y[mine].mean()
            height_m = float(np.clip((dx @ dy) / (dx @ dx + HEIGHT_PRIOR * mine.sum()), -0.05, 0.05))
            slope = float(np.median(y[mine] - height_m * x[mine]))
            mine = mine & (np.abs(y - height_m * x - slope) < 0.01)
            if not mine.any():
                break
        elevations.append(float(np.degrees(np.arctan(slope))))
    return np.array(elevations)


def compare_beams(scan: Scan, settings: LidarSettings) -> list[Finding]:
    """Compare the rings of a scan with the beams of the profile's model.

    Args:
        scan: scan of one revolution, in the LiDAR's own frame.
        settings: settings of the LiDAR.

    Returns:
        Findings about beams of another model, with those that fit; and regularly missing rings or points.
    """
    rings, n_returns = np.unique(scan.ring, return_counts=True)
    is_seen = n_returns >= _MIN_RETURNS
    if not settings.has_rings or is_seen.sum() < _MIN_RINGS:
        return []
    mine = np.isin(scan.ring, rings[is_seen])
    scan = Scan(scan.sensor, None, scan.points[mine], scan.intensity[mine], scan.ring[mine])
    elevations_deg, sheet = measure_elevations(scan), settings.data_sheet()
    beams_deg = np.sort(elevations_deg if sheet is None else sheet.elevations_deg)
    names = suggest_models(elevations_deg)
    is_other = sheet is not None and not _fits(elevations_deg, sheet)
    if not is_other:
        of_ring = np.argmin(np.abs(elevations_deg[:, None] - beams_deg), axis=1)
        n_seen, is_skipped = _rings_in_sectors(scan, of_ring)
        if not is_skipped:
            return _compare_steps(scan, settings)
        # Every existing ring has returns in every direction: no point is skipped.
        is_other = bool(names) and n_seen > _FULL_RATIO * len(elevations_deg)
        if not is_other:
            return [RINGS_SKIPPED(scan.sensor, n_seen=n_seen, n_rings=len(beams_deg))]
    return [
        BEAMS_OF_OTHER_MODEL(
            scan.sensor,
            action="named" if names else "",
            model=settings.model,
            n_rings=len(elevations_deg),
            n_model=len(beams_deg),
            low_deg=float(elevations_deg.min()),
            high_deg=float(elevations_deg.max()),
            model_low_deg=float(beams_deg[0]),
            model_high_deg=float(beams_deg[-1]),
            names=" or ".join(names[:_MAX_NAMED]),
        )
    ]


def _compare_steps(scan: Scan, settings: LidarSettings) -> list[Finding]:
    """Compare the median azimuth step of a scan's rings with the model's.

    If the number of rings and k have no common factor, every k-th point is from each ring in turn.
    """
    sheet = settings.data_sheet()
    if sheet is None or (find_data_sheet(settings.model) is None and settings.columns is None):
        return []
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(np.float64)
    order = np.lexsort((azimuth, scan.ring))
    turn = np.diff(azimuth[order])[np.diff(scan.ring[order]) == 0]
    steps = turn[turn > _MIN_STEP_RAD]
    step_rad = float(np.median(steps)) if len(steps) else 0.0
    model_rad = sheet.step_rad(settings.rate_hz)
    if step_rad < _SKIPPED_STEPS * model_rad:
        return []
    figures = {"step_deg": math.degrees(step_rad), "model_step_deg": math.degrees(model_rad)}
    key = "rate_hz" if sheet.columns is None else "columns"
    return [POINTS_SKIPPED(scan.sensor, n=round(step_rad / model_rad), key=key, **figures)]


def suggest_models(elevations_deg: Array) -> list[str]:
    """List the models whose beams have these elevations (L,) in deg, the most similar first."""
    n = len(elevations_deg)
    alike = []
    for sheet in DATA_SHEETS:
        n_missing, distance_deg = sheet.n_rings - n, _distance_deg(elevations_deg, sheet)
        limit_deg = _MAX_OF_PART_DEG if n_missing else _MAX_OF_UNIT_DEG
        if sheet.has_rings and 0 <= n_missing <= _MOST_UNSEEN * n and distance_deg <= limit_deg:
            alike.append((n_missing, distance_deg, sheet.name))
    return [name for n_missing, _, name in sorted(alike) if n_missing == min(alike)[0]]


def _fits(elevations_deg: Array, sheet: DataSheet) -> bool:
    """Check whether measured elevations may be those of a model, or of a part of its beams."""
    if len(elevations_deg) >= sheet.n_rings:
        is_whole = len(elevations_deg) == sheet.n_rings
        return is_whole and _distance_deg(elevations_deg, sheet) <= _MAX_OF_UNIT_DEG
    low_deg, high_deg = min(sheet.elevations_deg), max(sheet.elevations_deg)
    reach_deg = max(low_deg - elevations_deg.min(), elevations_deg.max() - high_deg)
    # If beams are closer together than the tolerance of units, the distance proves nothing.
    spacing_deg = float(np.median(np.diff(np.sort(sheet.elevations_deg))))
    is_dense = spacing_deg < _MAX_OF_UNIT_DEG
    is_near = is_dense or _distance_deg(elevations_deg, sheet) <= _MAX_OF_PART * spacing_deg
    return bool(reach_deg <= _MAX_OF_UNIT_DEG) and is_near


def _distance_deg(elevations_deg: Array, sheet: DataSheet) -> float:
    """Return the rms deviation from a model's elevations, or of a subset from the nearest ones."""
    beams_deg, measured_deg = np.sort(sheet.elevations_deg), np.sort(elevations_deg)
    if not len(beams_deg):
        return np.inf
    if len(measured_deg) == len(beams_deg):
        return float(np.sqrt(np.mean((measured_deg - beams_deg) ** 2)))
    nearest_deg = np.abs(measured_deg[:, None] - beams_deg).min(axis=1)
    return float(np.sqrt(np.mean(nearest_deg**2)))


def _rings_in_sectors(scan: Scan, of_ring: NDArray[np.intp]) -> tuple[int, bool]:
    """Return the median number of rings per sector, and whether rings in between are missing.

    Lasers fire in the order of the rings, or alternately in the lower and the upper half. With every k-th
    point only, a sector then has every k-th ring, or one half of the rings.

    Args:
        scan: one revolution.
        of_ring: (L,) beam of each ring, from the lowest.
    """
    beam = of_ring[np.unique(scan.ring, return_inverse=True)[1]]
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    sector = ((azimuth / (2 * np.pi) + 0.5) * _N_SECTORS).astype(np.intp)
    seen = [np.unique(beam[sector == k]) for k in np.unique(sector)]
    seen = [beams for beams in seen if len(beams) > 1]
    if len(seen) < _MIN_SECTORS:
        return 0, False
    half = (of_ring.min() + of_ring.max()) / 2
    n_halves = min(sum(beams[0] > half for beams in seen), sum(beams[-1] < half for beams in seen))
    ratio = float(np.median([len(beams) / (beams[-1] - beams[0] + 1) for beams in seen]))
    is_skipped = ratio <= _FULL_RATIO or bool(n_halves > _MAX_HALVES * len(seen))
    return int(np.median([len(beams) for beams in seen])), is_skipped
