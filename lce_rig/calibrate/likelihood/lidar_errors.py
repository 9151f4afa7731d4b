"""Constant errors of one LiDAR from sessions whose extrinsics are all free."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.likelihood.fit import maximise_likelihood
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


@dataclass(frozen=True, eq=False)
class LidarErrors:
    """What sessions tell of a LiDAR.

    Attributes:
        found: its constant errors; a laser's deviations are about the mean of all lasers.
        prior_sigma: (3,) deviations of a laser's errors about their mean without these sessions.
        n_captures: by session.
        n_points: (K,) returns of each laser on boards.
    """

    found: KnownLidar
    prior_sigma: Array
    n_captures: tuple[int, ...]
    n_points: Array

    @property
    def gain(self) -> Array:
        """By what factor (3,) the sessions lower the median deviation of range, azimuth and elevation."""
        return np.asarray(self.prior_sigma / np.median(self.found.lasers_sigma, axis=1))


def estimate_lidar(
    sessions: Sequence[Sequence[Observation]],
    board: Board,
    T_cam_lidar: Sequence[Array],
    options: EstimateSettings,
) -> LidarErrors:
    """Estimate a LiDAR's constant errors from several sessions, each with extrinsics of its own.

    The sessions are to `refine` what cameras of one session are: they share the LiDAR.

    Args:
        sessions: observations of each; boards stood still.
        board: the board.
        T_cam_lidar: (4, 4) of each, as Algorithm 1 finds it.
        options: priors of the LiDAR's range errors; what is known of it already is not used.
    """
    apart = [
        [replace(o, capture=f"{k}/{o.capture}") for o in observations]
        for k, observations in enumerate(sessions)
    ]
    priors, usual = what_is_known(replace(options, known=None))
    joint = maximise_likelihood(apart, board, T_cam_lidar, priors, usual)
    layout, rings = joint.state.layout, joint.terms.scans.rings.astype(np.intp)
    L = layout.n_rings
    cov, about_mean = joint.cost.covariance(), np.eye(L) - 1 / L
    sigma = np.sqrt([np.diag(about_mean @ cov[at[:, None], at] @ about_mean) for at in layout.lasers])
    # Lasers that met few boards are known as well as without them.
    prior = np.array([joint.levels.laser_m, joint.priors.azimuth_rad, joint.priors.elevation_rad])
    sigma = np.minimum(sigma * WIDENED[:, None], np.maximum(sigma, prior[:, None]))
    lens = layout.z["lens"]
    known = KnownLidar(
        rings, joint.state.lasers, sigma, joint.state.z[lens], np.sqrt(np.diag(joint.cov_z))[lens]
    )
    seen = np.concatenate([o.lidar.ring for session in sessions for o in session])
    n_points = np.array([np.count_nonzero(seen == ring) for ring in rings])
    return LidarErrors(known, prior, tuple(len(session) for session in sessions), n_points)
