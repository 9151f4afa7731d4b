"""Checks of two LiDARs' pose to each other, beyond those that a camera and a LiDAR have as well."""

from collections.abc import Iterable, Sequence

from lce_rig.core.calibration import Calibration
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import Array, PoseDifference, composition_slopes, difference, invert, tangent_sizes
from lce_rig.detect.detection import LidarDetection
from lce_rig.judge.findings import (
    LIDARS_DIFFER,
    LIDARS_EXCHANGED,
    LIDARS_UNNAMED,
    OTHER_MODEL,
    failing,
)
from lce_rig.rig import LidarSettings, NominalExtrinsic, Rig


def find_other_model(name: str, lidar: LidarSettings, scans: Iterable[LidarDetection]) -> list[Finding]:
    """Find a LiDAR whose scans have rings that its model lacks, as when two came under each other's name.

    Args:
        name: of the LiDAR.
        lidar: its settings.
        scans: its detections.
    """
    sheet = lidar.data_sheet()
    if sheet is None or not sheet.has_rings:
        return []
    n_lasers = len(sheet.elevations_deg)
    rings = [int(scan[0].ring.max(initial=0)) for scan in scans if not isinstance(scan, Refusal)]
    highest = max(rings, default=0)
    if highest < n_lasers:
        return []
    return [OTHER_MODEL(name, model=lidar.model, n_lasers=n_lasers, ring=highest)]


def find_exchanged(
    T_first_second: Array, nominal: NominalExtrinsic | None, names: str, lidars: Sequence[LidarSettings]
) -> list[Finding]:
    """Find two LiDARs whose scans came under each other's name.

    Exchanged, the estimate is the inverse, and boards fit as well. Without a nominal pose only the scans of a
    LiDAR with more rings show it; otherwise the result cannot pass.

    Args:
        T_first_second: (4, 4) the estimate.
        nominal: of the profile.
        names: of both.
        lidars: their settings.
    """
    if nominal is None:
        sheets = [lidar.data_sheet() for lidar in lidars]
        rings = {len(sheet.elevations_deg) for sheet in sheets if sheet is not None and sheet.has_rings}
        return [] if len(rings) == len(sheets) else [LIDARS_UNNAMED(names)]

    def excess(T: Array) -> float:
        rotation_deg, translation_m = tangent_sizes(difference(T, nominal.to_matrix()))
        return max(rotation_deg / nominal.tolerance_deg, translation_m / nominal.tolerance_m)

    is_exchanged = excess(T_first_second) > 1 >= excess(invert(T_first_second))
    return [LIDARS_EXCHANGED(names)] if is_exchanged else []


def loop_findings(between: Calibration, first: Calibration, second: Calibration, rig: Rig) -> list[Finding]:
    """Compare two LiDARs' pose with that by a camera calibrated to both.

    All three results have seen the same boards: their errors are counted as independent.

    Args:
        between: of the two LiDARs.
        first, second: of the camera and each of them.
        rig: targets and limits.
    """
    by_first, by_between = composition_slopes(first.T_cam_lidar, between.T_cam_lidar)
    cov = by_first @ first.cov @ by_first.T + by_between @ between.cov @ by_between.T + second.cov
    tangent = difference(first.T_cam_lidar @ between.T_cam_lidar, second.T_cam_lidar)
    apart = PoseDifference(tangent, cov)
    excess = rig.calibration.excess(apart) / rig.verdict.max_camera_difference
    if excess <= 1:
        return []
    severity = failing(excess > rig.verdict.fail_factor)
    return [
        LIDARS_DIFFER(
            f"{between.camera} and {between.lidar}", severity=severity, camera=first.camera, **apart.sizes
        )
    ]
