"""Which motions of the extrinsics the captures determine, and which they do not."""

from collections.abc import Sequence

import numpy as np

from lce_rig.calibrate.algorithm_1.moments import Problem, Weights
from lce_rig.calibrate.algorithm_1.registration import vec_rotation, with_one
from lce_rig.calibrate.findings import UNDETERMINED
from lce_rig.calibrate.plane_and_ends import PLANE_FREEDOMS, CaptureFeatures
from lce_rig.core.calibration import MOTIONS, Motion, WeakestMotion
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array

# Standard deviation of one capture's board plane between camera and LiDAR.
_PLANE_SIGMA_M = 0.005
# A motion that moves the board by more than this without changing the planes counts as undetermined.
_MAX_WEAK_SIGMA_M = 0.1


def require_observable(features: Sequence[CaptureFeatures], problem: Problem, T_cam_lidar: Array) -> None:
    """Check that the boards' planes alone determine all six directions.

    Edges could replace planes, but a set that requires this is fragile, as edge errors are systematic.

    Args:
        features: of the captures in `problem`.
        problem: their moments.
        T_cam_lidar: (4, 4) estimate.

    Raises:
        NotEnoughDataError: a direction is undetermined; it is named.
    """
    x = with_one(np.concatenate([vec_rotation(T_cam_lidar[:3, :3]), T_cam_lidar[:3, 3], np.zeros(1)]))
    planes = Weights(PLANE_FREEDOMS / _PLANE_SIGMA_M**2, 0.0)
    hessians = problem.quadratics(x, problem.associate(x[None])[0], weights=planes).hessians
    lever_m = float(np.sqrt(np.mean([f.centre @ f.centre for f in features])))
    scale = np.r_[np.ones(3), np.full(3, lever_m)]
    information = hessians.sum(axis=0)[:6, :6] / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(information)
    weak = values < 1 / _MAX_WEAK_SIGMA_M**2
    if not weak.any():
        return
    # Unit vectors about one direction do not vary along it: the smaller of the two lateral spreads counts.
    spread = np.linalg.eigvalsh(np.cov(np.array([f.normal for f in features]).T, bias=True))[1]
    finding = UNDETERMINED(
        motions=tuple(dict.fromkeys(main_motion(vector) for vector in vectors[:, weak].T)),
        n_captures=len(features),
        spread_deg=float(np.degrees(np.sqrt(max(spread, 0.0)))),
    )
    raise NotEnoughDataError.of(finding)


def main_motion(direction: Array) -> Motion:
    """Name the main component of a motion (6,), translations and rotations in comparable units."""
    return MOTIONS[int(np.argmax(np.abs(direction)))]


def find_weakest(cov: Array, lever_m: float) -> WeakestMotion:
    """Find the least determined motion and its standard deviation.

    Args:
        cov: (6, 6) of the tangent.
        lever_m: rms distance of the boards from the camera, by which rotations count as displacements.
    """
    scale = np.r_[np.ones(3), np.full(3, lever_m)]
    _, vectors = np.linalg.eigh(cov * np.outer(scale, scale))
    motion = main_motion(vectors[:, -1])
    main = MOTIONS.index(motion)
    return WeakestMotion(motion, float(np.sqrt(cov[main, main])))
