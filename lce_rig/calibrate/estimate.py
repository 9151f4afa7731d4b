"""The whole method: from boards detected by both sensors to extrinsics with their uncertainty.

    fit_session_lens     the camera's intrinsics and the board's shape, from the images and the profile
    find_consensus       the captures of each channel that agree on one rigid transform
    join_scans           the images of all channels that share a scan
    estimate_motion      time offsets and motion of the boards: one pose of the board at the time of each scan
    solve                Algorithm 1: extrinsics from planes and ring ends, certified, without outliers
    maximise_likelihood  method "ml": extrinsics, board poses and constant errors of maximum likelihood
    by_likelihood,
    by_algorithm_1       uncertainty

Channels of one camera, frames and events, share pixels and lens, not their times. Together they give one set
of extrinsics; two are compared by Algorithm 1, as a camera has one pose.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import solve
from lce_rig.calibrate.association import find_association_error, is_of_all
from lce_rig.calibrate.consensus import Consensus, find_consensus
from lce_rig.calibrate.findings import FEW_AGREE, MIRRORED, UNDETERMINED
from lce_rig.calibrate.likelihood.fit import maximise_likelihood
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.motion.board_motion import sample_poses
from lce_rig.calibrate.motion.time_offsets import MIN_MOVING, Motion, estimate_motion
from lce_rig.calibrate.observations import Clocks, join_scans
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.calibrate.session_lens import fit_session_lens
from lce_rig.calibrate.uncertainty import by_algorithm_1, by_likelihood
from lce_rig.core.board import Board
from lce_rig.core.calibration import ChannelResult
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Finding
from lce_rig.core.geometry import PoseDifference, difference
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.core.results import Observation


def estimate_extrinsics(
    candidates: Mapping[str, Sequence[Observation]],
    board: Board,
    settings: EstimateSettings,
    clocks: Clocks,
    progress: Progress = silent,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from detections of the channels of one camera and a LiDAR.

    Args:
        candidates: by channel, one per capture with detections of both sensors; channels whose captures agree
            on no extrinsics are skipped.
        board: the board's specification.
        settings: method, priors and tolerances.
        clocks: clock settings of the sensors.
        progress: called at each step.

    Raises:
        NotEnoughDataError: no channel has enough captures, or they leave a direction undetermined.
    """
    begin(progress, "intrinsics and board")
    fitted, of_lens = _with_session_lens(candidates, board, settings)
    agreed, noise_px, errors = _agree(fitted, board)
    if mirrored := _mirrored(errors):
        fitted, of_lens = _with_session_lens(candidates, board, settings, mirrored)
        agreed, noise_px, errors = _agree(fitted, board)
    try:
        estimate = _estimate(fitted, agreed, noise_px, board, of_lens, clocks, progress)
    except NotEnoughDataError as error:
        raise _before_geometry(error, fitted, agreed) from error
    return replace(estimate, association=errors)


def _estimate(
    candidates: Mapping[str, Sequence[Observation]],
    agreed: Mapping[str, Consensus],
    noise_px: Mapping[str, float],
    board: Board,
    settings: EstimateSettings,
    clocks: Clocks,
    progress: Progress,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from the captures that agree."""
    matched = {name: consensus.observations for name, consensus in agreed.items()}
    scans, conflicts = join_scans(matched, candidates)
    samples = sample_poses(scans, clocks, noise_px)

    of_channels = {
        name: ChannelResult(name, len(observations), noise_px[name]) for name, observations in matched.items()
    }

    if len(agreed) == 1 and np.count_nonzero(samples.tells_motion) < MIN_MOVING:
        ((_, of_channel),) = matched.items()
        estimate = estimate_observations(of_channel, board, settings, progress)
        estimate = replace(estimate, channels=tuple(of_channels.values()))
        return _with_consensus(estimate, list(agreed.values()))

    begin(progress, "motion of the board")
    motion = estimate_motion(scans, samples, board, solve(next(iter(matched.values())), board), clocks)
    estimate = estimate_observations(motion.observations(), board, settings, progress)
    estimate = _with_consensus(estimate, list(agreed.values()))
    if motion.offset_s is not None:
        sigma_s = np.sqrt(np.diag(motion.cov))
        for name, offset_s, sigma in zip(
            samples.channels, motion.offset_s.tolist(), sigma_s.tolist(), strict=True
        ):
            of_channels[name] = replace(of_channels[name], time_offset_s=offset_s, time_offset_sigma_s=sigma)
    return replace(
        estimate,
        cov=motion.widened(estimate.cov),
        refused={**conflicts, **estimate.refused},
        same_scan={scan.capture: scan.captures for scan in scans if len(scan.captures) > 1},
        channels=tuple(of_channels[name] for name in sorted(of_channels)),
        channel_difference=_difference(motion, sorted(of_channels), board),
    )


def fit_extrinsic(
    candidates: Sequence[Observation],
    board: Board,
    settings: EstimateSettings | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from both sensors' detections of boards that stood still.

    Args:
        candidates: observations of each capture with detections of both sensors, in any order.
        board: the board's specification.
        settings: method, priors and tolerances.

    Raises:
        NotEnoughDataError: too few captures, captures that agree with no extrinsics, or captures that leave a
            direction undetermined, which is named.
    """
    by_channel, settings = _with_session_lens({"": candidates}, board, settings or EstimateSettings())
    consensus = find_consensus(by_channel[""], board)
    estimate = estimate_observations(consensus.observations, board, settings)
    return _with_consensus(estimate, [consensus])


def estimate_observations(
    observations: Sequence[Observation],
    board: Board,
    settings: EstimateSettings,
    progress: Progress = silent,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar by the settings' method from matched boards.

    Args:
        observations: one per capture.
        board: the board's specification.
        settings: method, priors and tolerances.
        progress: called at each step.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    begin(progress, "Algorithm 1")
    start = solve(observations, board)
    begin(progress, "maximum likelihood")
    priors, usual = what_is_known(settings)
    joint = maximise_likelihood(
        [start.observations], board, [start.T_cam_lidar], priors, usual, lenses=[settings.lens]
    )
    if settings.method == "paper":
        return by_algorithm_1(start, joint, board, settings.lens)
    return by_likelihood(start, joint, board, settings.lens)


def _mirrored(errors: Sequence[Finding]) -> set[str]:
    """List the captures whose images are mirrored; their corners do not fit the lens."""
    found = (each.figures["captures"] for each in errors if each.code == MIRRORED.code)
    return {str(name) for captures in found if isinstance(captures, tuple) for name in captures}


def _with_session_lens(
    candidates: Mapping[str, Sequence[Observation]],
    board: Board,
    settings: EstimateSettings,
    skipped: Collection[str] = (),
) -> tuple[Mapping[str, Sequence[Observation]], EstimateSettings]:
    """Fit the lens to the images, but for skipped captures, unless it is exact or known; refit all poses."""
    if settings.tolerances is None or settings.tolerances.lens.is_exact:
        return candidates, settings
    images = {
        name: [o.image for o in observations if o.capture not in skipped]
        for name, observations in candidates.items()
    }
    lens = settings.lens or fit_session_lens(images, board, settings.tolerances.lens)
    refitted = {name: lens.refit(observations) for name, observations in candidates.items()}
    return refitted, replace(settings, lens=lens)


def _agree(
    candidates: Mapping[str, Sequence[Observation]], board: Board
) -> tuple[dict[str, Consensus], dict[str, float], tuple[Finding, ...]]:
    """Find each channel's consensus and corner noise, px; the channel with the least noise comes first.

    Channels in which an error of association explains most captures are skipped; those of others are listed.
    """
    agreed: dict[str, Consensus] = {}
    troubles: list[NotEnoughDataError] = []
    errors: list[Finding] = []
    for channel, items in candidates.items():
        consensus, trouble = None, None
        try:
            consensus = find_consensus(items, board)
        except NotEnoughDataError as error:
            trouble = error
        cause = find_association_error(items, board, consensus)
        if cause is not None and is_of_all(cause):
            trouble = NotEnoughDataError.of(cause)
        elif cause is not None:
            errors.append(cause)
        if trouble is not None:
            troubles.append(trouble)
        elif consensus is not None:
            agreed[channel] = consensus
    if not agreed:
        raise troubles[0]
    # Corner noise per channel and coordinate, from the residuals of all boards.
    noise = {
        name: float(np.sqrt(np.mean([o.image.sigma_px**2 for o in consensus.observations])))
        for name, consensus in agreed.items()
    }
    return {name: agreed[name] for name in sorted(agreed, key=lambda name: noise[name])}, noise, tuple(errors)


def _before_geometry(
    error: NotEnoughDataError,
    candidates: Mapping[str, Sequence[Observation]],
    agreed: Mapping[str, Consensus],
) -> NotEnoughDataError:
    """Report the disagreement of most captures rather than the weak geometry of the few that agree."""
    n_agreeing = sum(len(consensus.observations) for consensus in agreed.values())
    n_captures = sum(len(candidates[channel]) for channel in agreed)
    if error.finding is None or error.finding.code != UNDETERMINED.code or 2 * n_agreeing >= n_captures:
        return error
    needed = n_captures // 2 + 1
    return NotEnoughDataError.of(FEW_AGREE(n_agreeing=n_agreeing, n_captures=n_captures, n_needed=needed))


def _with_consensus(estimate: CalibrationEstimate, agreed: Sequence[Consensus]) -> CalibrationEstimate:
    """Add the refusals of the channels' consensus to an estimate."""
    refused = dict(estimate.refused)
    for consensus in agreed:
        refused = {**consensus.refused, **refused}
    return replace(estimate, refused=dict(sorted(refused.items())))


def _difference(motion: Motion, channels: Sequence[str], board: Board) -> PoseDifference | None:
    """Compare the extrinsics of two channels; None if the boards' motion needs both channels."""
    if len(channels) != 2 or not motion.is_seen_by_each:
        return None
    first, second = (solve(motion.observations(channel), board) for channel in channels)
    covs = [motion.widened(each.cost.jackknife_covariance()[:6, :6]) for each in (first, second)]
    return PoseDifference(difference(first.T_cam_lidar, second.T_cam_lidar), covs[0] + covs[1])
