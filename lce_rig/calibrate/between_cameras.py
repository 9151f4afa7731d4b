"""Two cameras that saw the same boards: agreeing captures, and the initial guess of the relative pose.

    fit_session_lens    the intrinsics of each camera
    find_consensus      the captures that agree on one rigid transform
    mean_pose           the relative pose, and without each placement in turn
    maximise_likelihood noise levels

The first camera's images give poses of the board, the second one's points on it (`PatternBoard`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lce_rig.calibrate.consensus import find_consensus
from lce_rig.calibrate.likelihood.fit import JointEstimate, maximise_likelihood
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.observations import group_poses
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.result import Start
from lce_rig.calibrate.session_lens import SessionLens, fit_session_lens
from lce_rig.core.board import Board
from lce_rig.core.calibration import Certificate, Diagnostics
from lce_rig.core.geometry import Array, invert, mean_pose, student_weights, transform
from lce_rig.core.results import ImageBoard, Observation, PatternBoard

# Standard deviations of a board's pose between two cameras, m and rad: they weight translation against
# rotation.
_TYPICAL = np.repeat([3e-3, 2e-3], 3)


class StereoPair(NamedTuple):
    """Two cameras.

    Attributes:
        start: T_first_second with the captures that agree.
        joint: joint estimate of these captures; the second camera is its base.
        lenses: lenses of each camera; None for exact ones.
        rejected: the other captures in which both see the pattern.
    """

    start: Start
    joint: JointEstimate
    lenses: tuple[SessionLens | None, SessionLens | None]
    rejected: Sequence[Observation]


def match_cameras(
    images: Mapping[str, tuple[ImageBoard, ImageBoard]],
    board: Board,
    settings: tuple[EstimateSettings, EstimateSettings],
) -> StereoPair:
    """Find the captures that agree on the pose of the second camera in the first one's frame.

    Args:
        images: images of both cameras by capture.
        board: the board.
        settings: settings of each camera; a lens given there is not fitted again.

    Raises:
        NotEnoughDataError: too few captures, or captures that agree with no extrinsics.
    """
    seen = [_refit({name: both[k] for name, both in images.items()}, board, settings[k]) for k in (0, 1)]
    (first, one), (second, other) = seen
    corners = board.corners()
    candidates = [
        Observation.of(name, first[name], PatternBoard.candidates(second[name], corners))
        for name in sorted(images)
    ]
    consensus = find_consensus(candidates, board)
    start = _mean(consensus.observations, board)
    start = replace(start, refused=dict(sorted(consensus.refused.items())))
    priors, usual = what_is_known(settings[0])
    joint = maximise_likelihood(
        [start.observations], board, [start.T_cam_lidar], priors, usual, lenses=[one, other]
    )
    rejected = [each for each in candidates if each.capture in start.refused]
    return StereoPair(start, joint, (one, other), rejected)


def _refit(
    images: Mapping[str, ImageBoard], board: Board, settings: EstimateSettings
) -> tuple[dict[str, ImageBoard], SessionLens | None]:
    """Fit a camera's lens, unless it is known, and the boards' poses with it."""
    found, lens = list(images.values()), settings.lens
    if lens is None and settings.tolerances is not None and not settings.tolerances.lens.is_exact:
        lens = fit_session_lens({"": found}, board, settings.tolerances.lens)
    if lens is not None:
        found = lens.refit_images(found)
    return dict(zip(images, found, strict=True)), lens


def _mean(observations: Sequence[Observation], board: Board) -> Start:
    """Average the relative poses of all captures, and predict each placement from the others."""
    T = np.array([o.pose.T_cam_board @ invert(o.surface.T_lidar_board) for o in observations])
    placement = group_poses(np.array([o.pose.T_cam_board for o in observations]))
    # A rotation shifts distant boards more. Here all poses have the same uncertainty, near or far.
    information = np.tile(np.diag(_TYPICAL**-2), (len(T), 1, 1))

    def average(keep: Array) -> Array:
        return mean_pose(T[keep], information[keep], weigh=student_weights)[0]

    T_all, corners = average(np.full(len(T), True)), board.corners()
    held_out_m = np.full(len(T), np.nan)
    for number in np.unique(placement):
        is_here = placement == number
        if is_here.all():
            continue
        T_others = average(~is_here)
        for k in np.flatnonzero(is_here).tolist():
            o = observations[k]
            there = transform(T_others @ o.surface.T_lidar_board, corners)
            apart = there - transform(o.pose.T_cam_board, corners)
            held_out_m[k] = np.sqrt(np.mean(np.sum(apart**2, axis=1)))
    # The mean pose is unique, so the start needs no global search.
    return Start(T_all, Certificate(True, 0.0), list(observations), {}, held_out_m, Diagnostics())
