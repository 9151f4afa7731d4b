"""Check whether the extrinsics of two sensors that saw the same boards agree, or are exchanged.

Each still board that two cameras see gives T_second_first = T_second_board T_first_board^-1 without any
LiDAR. The extrinsics of both cameras with one LiDAR give the same pose independently.

LiDARs: their pose to each other closes a loop with a camera, and has checks beyond those that a camera and a
LiDAR have as well.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate.likelihood.images import stack_images
from lce_rig.calibrate.likelihood.levels import Levels
from lce_rig.calibrate.observations import group_placements, scan_key
from lce_rig.calibrate.quadratics import Quadratics, symmetric_inverse
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.core.findings import Finding, Refusal
from lce_rig.core.geometry import (
    Array,
    PoseDifference,
    composition_slopes,
    difference,
    invert,
    mean_pose,
    relative_covariance,
    relative_pose,
    student_weights,
    tangent_sizes,
)
from lce_rig.core.results import Observation
from lce_rig.detect.detection import LidarDetection
from lce_rig.judge.findings import (
    CAMERAS_DIFFER,
    EXCHANGED,
    FAIL_FACTOR,
    LIDARS_DIFFER,
    LIDARS_UNNAMED,
    OTHER_MODEL,
    failing,
)
from lce_rig.judge.intrinsics_check import IntrinsicsCheck, check_intrinsics
from lce_rig.lens.lens_estimate import BoardView
from lce_rig.rig import CalibrationSettings, LidarSettings, NominalExtrinsic, Rig

# Minimum number of placements to determine the scatter.
_MIN_PLACEMENTS = 4
# Fewer placements do not determine the shape of the scatter; that of typical errors is used.
_MIN_JACKKNIFE = 10
# Exchanged cameras fit the nominal poses better by at least this, a likelihood ratio of 400.
_EXCHANGED_CHI2 = 12.0


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose of two cameras from their images.

    Attributes:
        T_second_first: (4, 4), p_second = R p_first + t.
        cov: (6, 6) of it, tangent (translation m, rotation rad), axes of the second camera: from the scatter
            between placements.
        board_rms_m: rms distance between both cameras' positions of a board's middle.
    """

    T_second_first: Array
    cov: Array
    board_rms_m: float


@dataclass(frozen=True, eq=False)
class CameraPair:
    """Two cameras calibrated to one LiDAR.

    Attributes:
        captures: that both used, as the first names them.
        from_images: the relative pose from their images; None if both saw too few boards.
        apart: from the extrinsics' pose to the images'; None likewise.
        board_rms_m: rms distance between positions of a board's middle under the extrinsics' pose.
    """

    captures: tuple[str, ...]
    from_images: RelativePose | None
    apart: PoseDifference | None
    board_rms_m: float


def shared_boards(
    first: Mapping[str, Observation], second: Mapping[str, Observation]
) -> list[tuple[Observation, Observation]]:
    """Pair observations of two cameras of the same board in the same scan, in any captures.

    Args:
        first: observations by capture, of one camera.
        second: name of the other sensor.
    """
    there = {scan_key(observation): observation for observation in second.values()}
    found = [(observation, there.get(scan_key(observation))) for observation in first.values()]
    return [(one, other) for one, other in found if other is not None]


def relate(first: CalibrationEstimate, second: CalibrationEstimate) -> CameraPair | None:
    """Compare the extrinsics of two cameras with their images of still boards.

    Returns:
        None if the cameras share no capture.
    """
    shared = shared_boards(first.observations, second.observations)
    if not shared:
        return None
    T = second.T_cam_lidar @ invert(first.T_cam_lidar)
    from_images = pose_from_images(shared)
    captures = tuple(one.capture for one, _ in shared)
    board_rms_m = _board_rms_m(shared, T)
    if from_images is None:
        return CameraPair(captures, None, None, board_rms_m)
    # Errors of the images enter both poses and are counted twice, which is conservative.
    apart = _close_loop(
        (from_images.T_second_first, from_images.cov),
        (first.T_cam_lidar, first.cov),
        (second.T_cam_lidar, second.cov),
    )
    return CameraPair(captures, from_images, apart, board_rms_m)


def pose_from_images(shared: Sequence[tuple[Observation, Observation]]) -> RelativePose | None:
    """Estimate T_second_first from both cameras' images of the same boards.

    An image's pose has the errors of its corners' noise and errors that corners share (`likelihood.images`).

    Returns:
        None for fewer than four placements.
    """
    firsts, seconds = ([pair[k] for pair in shared] for k in (0, 1))
    placement = group_placements(firsts)
    if placement.max() + 1 < _MIN_PLACEMENTS:
        return None
    T_first, cov_first = _poses(firsts)
    T_second, cov_second = _poses(seconds)
    T, J = relative_pose(T_second, T_first)
    information = symmetric_inverse(relative_covariance(J, cov_second, cov_first))

    def weigh(chi2: Array) -> Array:
        """Weight poses by their squared distances (F,) from the mean, in units of the typical value."""
        return student_weights(chi2 / max(float(np.median(chi2)) / 6, 1.0))

    mean, weight = mean_pose(T, information, weigh=weigh)
    apart = difference(T, mean)
    hessians, none = weight[:, None, None] * information, np.zeros((6, 6))
    expansion = Quadratics(-(hessians @ apart[..., None])[..., 0], hessians, none, none[0], placement)
    if len(expansion.groups) < _MIN_JACKKNIFE:
        scatter = float(np.einsum("ki,kij,kj->", apart, information, apart)) / (6 * (len(T) - 1))
        cov = max(scatter, 1.0) * expansion.covariance()
    else:
        cov = expansion.jackknife_covariance()
    return RelativePose(mean, cov, _board_rms_m(shared, mean))


def _poses(observations: Sequence[Observation]) -> tuple[Array, Array]:
    """List T_cam_board (F, 4, 4) and their covariances (F, 6, 6)."""
    images = [observation.image for observation in observations]
    every = np.arange(len(images), dtype=np.intp)
    stacked = stack_images(every, images)
    return stacked.T_cam_board, stacked.total_cov(Levels())


def _board_rms_m(shared: Sequence[tuple[Observation, Observation]], T_second_first: Array) -> float:
    middles = [(T_second_first @ one.pose.T_cam_board[:, 3])[:3] for one, _ in shared]
    seen = [other.pose.T_cam_board[:3, 3] for _, other in shared]
    return float(np.sqrt(np.mean(np.sum((np.array(middles) - seen) ** 2, axis=1))))


class CameraEvidence(NamedTuple):
    """A calibrated camera, with the figures to detect exchanged names.

    Attributes:
        name: name of the camera.
        T_cam_lidar, cov: its extrinsics, (4, 4) and (6, 6).
        views: views of the board in its images.
        lens: the profile's lens compared with them.
    """

    name: str
    T_cam_lidar: Array
    cov: Array
    views: Sequence[BoardView]
    lens: IntrinsicsCheck | None


def find_exchanged_cameras(
    rig: Rig, lidar: str, first: CameraEvidence, second: CameraEvidence
) -> list[Finding]:
    """Find two cameras whose images are exchanged.

    Exchanged, they fit the profile better: the nominal poses by more than chance allows, tolerances taken as
    three standard deviations; or the lenses, where boards contradict both profiles.

    Args:
        rig: the profile, with both cameras.
        lidar: name of the common LiDAR.
        first, second: the cameras.
    """
    reasons = []
    if _mounting_gain(rig, lidar, first, second) > _EXCHANGED_CHI2:
        reasons.append("mounting")
    sizes = [rig.cameras[each.name].resolution_px for each in (first, second)]
    misfits = [each.lens is not None and each.lens.is_contradicted for each in (first, second)]
    if all(misfits) and sizes[0] == sizes[1]:
        board = rig.board.to_board()
        lenses = [rig.cameras[each.name].to_intrinsics() for each in (second, first)]
        checks = [
            check_intrinsics(each.views, lens, board)
            for each, lens in zip((first, second), lenses, strict=True)
        ]
        if all(check is not None and check.fits() for check in checks):
            reasons.append("lenses")
    return [EXCHANGED(f"{first.name} and {second.name}", fits=tuple(reasons))] if reasons else []


def _mounting_gain(rig: Rig, lidar: str, first: CameraEvidence, second: CameraEvidence) -> float:
    """Compute how much chi-squared about the nominal poses decreases if two cameras are exchanged."""
    nominal = [rig.nominal(each.name, lidar) for each in (first, second)]
    if None in nominal:
        return 0.0

    def chi2(camera: CameraEvidence, expected: NominalExtrinsic | None) -> float:
        assert expected is not None
        tolerances = np.repeat([expected.tolerance_m, np.radians(expected.tolerance_deg)], 3) / 3
        x = difference(camera.T_cam_lidar, expected.to_matrix())
        return PoseDifference(x, camera.cov + np.diag(tolerances**2)).chi2

    named = chi2(first, nominal[0]) + chi2(second, nominal[1])
    return named - chi2(first, nominal[1]) - chi2(second, nominal[0])


def camera_findings(pair: CameraPair, names: tuple[str, str], target: CalibrationSettings) -> list[Finding]:
    """Find contradictions between the extrinsics of two cameras and their images.

    Args:
        pair: the cameras.
        names: names of the first and the second.
        target: standard deviations to reach.
    """
    if pair.from_images is None or pair.apart is None:
        return []
    excess = target.excess(pair.apart)
    if excess <= 1:
        return []
    return [
        CAMERAS_DIFFER(
            " to ".join(names),
            severity=failing(excess > FAIL_FACTOR),
            rms_m=pair.board_rms_m,
            images_rms_m=pair.from_images.board_rms_m,
            **pair.apart.sizes,
        )
    ]


def find_other_model(name: str, lidar: LidarSettings, scans: Iterable[LidarDetection]) -> list[Finding]:
    """Find a LiDAR with rings that its model lacks, for example because two LiDARs are exchanged.

    Args:
        name: name of the LiDAR.
        lidar: the LiDAR's settings.
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


def find_exchanged_lidars(
    T_first_second: Array, nominal: NominalExtrinsic | None, names: str, lidars: Sequence[LidarSettings]
) -> list[Finding]:
    """Find two LiDARs whose scans are exchanged.

    Exchanged, the estimate is the inverse, and boards fit as well. Without a nominal pose only the scans of a
    LiDAR with more rings show it; otherwise the result cannot pass.

    Args:
        T_first_second: (4, 4) the estimate.
        nominal: nominal extrinsics of the profile.
        names: names of both sensors.
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
    return [EXCHANGED(names, fits=("mounting",))] if is_exchanged else []


class Loop(NamedTuple):
    """A sensor calibrated to two LiDARs, and these to each other.

    Attributes:
        names: names of the sensor and both LiDARs.
        first, between, second: pose (4, 4) of the first LiDAR in the sensor's frame, of the second in the
            first one's, and of the second in the sensor's, each with its covariance (6, 6).
    """

    names: tuple[str, str, str]
    first: tuple[Array, Array]
    between: tuple[Array, Array]
    second: tuple[Array, Array]

    @property
    def pairs(self) -> tuple[tuple[str, str], tuple[str, str], tuple[str, str]]:
        """The sensors of each pose."""
        a, b, c = self.names
        return (a, b), (b, c), (a, c)


def loop_findings(loop: Loop, target: CalibrationSettings) -> list[Finding]:
    """Compare the pose of two LiDARs with that via a sensor calibrated to both.

    All three results have seen the same boards: their errors are counted as independent.
    """
    apart = _close_loop(loop.first, loop.between, loop.second)
    excess = target.excess(apart)
    if excess <= 1:
        return []
    camera, *lidars = loop.names
    return [
        LIDARS_DIFFER(
            " and ".join(lidars), severity=failing(excess > FAIL_FACTOR), camera=camera, **apart.sizes
        )
    ]


def _close_loop(
    first: tuple[Array, Array], between: tuple[Array, Array], second: tuple[Array, Array]
) -> PoseDifference:
    """Compare the pose `first @ between` (4, 4) with `second`, each with its covariance (6, 6)."""
    by_first, by_between = composition_slopes(first[0], between[0])
    cov = by_first @ first[1] @ by_first.T + by_between @ between[1] @ by_between.T + second[1]
    return PoseDifference(difference(first[0] @ between[0], second[0]), cov)
