"""A LiDAR's constant errors, estimated from several sessions that share it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.fit import JointEstimate, maximise_likelihood
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.options import EstimateSettings, KnownLidar
from lce_rig.core.board import Board
from lce_rig.core.geometry import Array
from lce_rig.core.results import Observation

WIDENED = np.array([1.30, 1.68, 1.0])
"""By what factor the deviations of ranges, azimuths and elevations exceed those of the joint estimate.

Errors found on two recorded sessions of one LiDAR (rlfs01, rlfs02) apart differ by so many of its deviations
(rms; elevations by 0.72). Over 20 simulated LiDARs, errors of ranges are 0.86 of them.
"""


# Prior standard deviation of an unknown offset of all ranges, m: first-generation OS1 reach 0.11.
_FREE_OFFSET_M = 0.2
# Error of the estimated offset not covered by the likelihood, m: scatter between sessions of one VLP-16
# (rlfs01 to 03).
_OFFSET_SCATTER_M = 0.003
# Significance threshold of that offset, in its standard deviations.
_SIGNIFICANT = 3.0


@dataclass(frozen=True, eq=False)
class LidarErrors:
    """A LiDAR's constant errors from sessions.

    Attributes:
        found: its constant errors; a laser's deviations are about the mean of all lasers.
        prior_sigma: (3,) deviations of a laser's errors about their mean without these sessions.
        n_captures: number of captures of each session.
        n_points: (K,) returns of each laser on boards.
        offset_m: constant error of all ranges, positive if too long; None if not significant.
            It is not part of the lasers' errors in `found`.
        offset_sigma_m: standard deviation of `offset_m`.
        has_lasers: whether the sessions determine the errors of single lasers, not only that offset.
    """

    found: KnownLidar
    prior_sigma: Array
    n_captures: tuple[int, ...]
    n_points: Array
    offset_m: float | None = None
    offset_sigma_m: float | None = None
    has_lasers: bool = True

    @property
    def gain(self) -> Array:
        """Ratio (3,) by which the sessions lower the median deviation of range, azimuth and elevation."""
        return np.asarray(self.prior_sigma / np.median(self.found.lasers_sigma, axis=1))


def estimate_lidar(
    sessions: Sequence[Sequence[Observation]],
    board: Board,
    T_cam_lidar: Sequence[Array],
    options: EstimateSettings,
    scale_sigma: float | None = None,
    subtracted_m: float = 0.0,
) -> LidarErrors:
    """Estimate a LiDAR's constant errors from several sessions, each with extrinsics of its own.

    Sessions are like cameras of one session: they share the LiDAR.

    Args:
        sessions: observations of each session, with boards that stood still.
        board: the board.
        T_cam_lidar: (4, 4) of each, from Algorithm 1.
        options: priors of the LiDAR's range errors; its known errors are not used.
        scale_sigma: relative standard deviation of the cameras' distances, against which a range offset is
            tested; that of the usual prior by default.
        subtracted_m: offset already subtracted from all ranges.
    """
    apart = [
        [replace(o, capture=f"{k}/{o.capture}") for o in observations]
        for k, observations in enumerate(sessions)
    ]
    priors, usual = what_is_known(replace(options, known=None))
    # Test for an offset larger than the profile's with an almost flat prior.
    free = replace(priors, offset_m=_FREE_OFFSET_M, squares=scale_sigma or priors.squares)
    joint = maximise_likelihood(apart, board, T_cam_lidar, free, usual)
    offset_m, offset_sigma_m = _common_offset(joint)
    is_significant = abs(offset_m) > _SIGNIFICANT * offset_sigma_m
    if not is_significant:
        joint, offset_m = maximise_likelihood(apart, board, T_cam_lidar, priors, usual), 0.0
    layout, rings = joint.state.layout, joint.terms.scans.rings.astype(np.intp)
    L = layout.n_rings
    cov, about_mean = joint.cost.covariance(), np.eye(L) - 1 / L
    sigma = np.sqrt([np.diag(about_mean @ cov[at[:, None], at] @ about_mean) for at in layout.lasers])
    # Lasers that hit few boards keep the uncertainty of their prior.
    prior = np.array([joint.levels.laser_m, joint.priors.azimuth_rad, joint.priors.elevation_rad])
    sigma = np.minimum(sigma * WIDENED[:, None], np.maximum(sigma, prior[:, None]))
    lens = layout.z["lens"]
    lasers = joint.state.lasers - np.array([[offset_m], [0.0], [0.0]])
    known = KnownLidar(rings, lasers, sigma, joint.state.z[lens], np.sqrt(np.diag(joint.cov_z))[lens])
    seen = np.concatenate([o.lidar.ring for session in sessions for o in session])
    n_points = np.array([np.count_nonzero(seen == ring) for ring in rings])
    errors = LidarErrors(known, prior, tuple(len(session) for session in sessions), n_points)
    if not is_significant:
        return errors
    return replace(errors, offset_m=subtracted_m + offset_m, offset_sigma_m=offset_sigma_m)


def _common_offset(joint: JointEstimate) -> tuple[float, float]:
    """Return the mean error of all ranges, m, and its standard deviation."""
    at = joint.state.layout.lasers[0]
    variance = float(joint.cost.covariance()[at[:, None], at].mean())
    sigma_m = float(np.hypot(WIDENED[0] * np.sqrt(variance), _OFFSET_SCATTER_M))
    return float(joint.state.lasers[0].mean()), sigma_m
