"""The method, from the boards that both sensors saw to extrinsics with their uncertainty.

    fit_session_lens     the camera's intrinsics and the board's shape, from the images and the profile
    find_consensus       the captures of each channel that agree on one rigid transform
    join_scans           the images of all channels that share a scan
    estimate_motion      time offsets and motion of the boards: one pose of the board at the time of each scan
    solve                Algorithm 1: extrinsics from planes and ring ends, certified, without outliers
    maximise_likelihood  method "ml": extrinsics, board poses and constant errors of maximum likelihood
    by_scatter,
    by_likelihood        uncertainty

Channels of one camera, frames and events, share pixels and lens, not their times. Together they give one set
of extrinsics; each is also calibrated alone, and two are compared by Algorithm 1, as a camera has one pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import Algorithm1, solve
from lce_rig.calibrate.consensus import Consensus, find_consensus
from lce_rig.calibrate.likelihood.fit import maximise_likelihood
from lce_rig.calibrate.likelihood.levels import what_is_known
from lce_rig.calibrate.motion.board_motion import sample_poses
from lce_rig.calibrate.motion.time_offsets import MIN_MOVING, Motion, estimate_motion
from lce_rig.calibrate.observations import Clocks, join_scans
from lce_rig.calibrate.options import EstimateSettings
from lce_rig.calibrate.plane_and_ends import along_normals
from lce_rig.calibrate.result import CalibrationEstimate
from lce_rig.calibrate.session_lens import fit_session_lens
from lce_rig.calibrate.uncertainty import by_likelihood, by_scatter, with_profile
from lce_rig.core.board import Board
from lce_rig.core.calibration import ChannelResult
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, PoseDifference, difference
from lce_rig.core.progress import Progress, begin, silent
from lce_rig.core.results import Observation

_N_SHARES = 7


def estimate_extrinsics(
    candidates: Mapping[str, Sequence[Observation]],
    board: Board,
    settings: EstimateSettings,
    clocks: Clocks,
    progress: Progress = silent,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from detections of the channels of one camera and a LiDAR.

    Args:
        candidates: by channel, of each capture with detections of both sensors; channels whose captures agree
            on no extrinsics are skipped.
        board: its specification.
        settings: method, priors and tolerances.
        clocks: of the sensors.
        progress: told of each step.

    Raises:
        NotEnoughDataError: no channel has enough captures, or they leave a direction undetermined.
    """
    begin(progress, "intrinsics and board")
    candidates, settings = _with_session_lens(candidates, board, settings)
    agreed, noise_px = _agree(candidates, board)
    matched = {name: consensus.observations for name, consensus in agreed.items()}
    scans, conflicts = join_scans(matched, candidates)
    samples = sample_poses(scans, clocks, noise_px)

    def result_of(
        name: str, alone: CalibrationEstimate, cov: Array, still: Algorithm1 | None = None
    ) -> ChannelResult:
        scatter_m = depth_scatter_m(alone.T_cam_lidar, list(alone.observations.values()))
        still_m = depth_scatter_m(still.T_cam_lidar, still.observations) if still else scatter_m
        of_all = name, len(matched[name]), noise_px[name]
        return ChannelResult(*of_all, alone.T_cam_lidar, cov, scatter_m, still_m)

    if len(agreed) == 1 and np.count_nonzero(samples.tells_motion) < MIN_MOVING:
        ((name, of_channel),) = matched.items()
        estimate = estimate_observations(of_channel, board, settings, progress)
        channel = result_of(name, estimate, estimate.cov)
        return _with_consensus(replace(estimate, channels=(channel,)), list(agreed.values()))

    begin(progress, "motion of the board")
    still = {name: solve(observations, board) for name, observations in matched.items()}
    motion = estimate_motion(scans, samples, board, next(iter(still.values())), clocks)
    estimate = estimate_observations(motion.observations(), board, settings, progress)
    estimate = _with_consensus(estimate, list(agreed.values()))

    fast = replace(settings, tolerances=None, lens=None)
    by_channel = {name: motion.observations(name if len(agreed) > 1 else None) for name in sorted(agreed)}
    channels = []
    for name, observations in by_channel.items():
        begin(progress, f"{name} alone")
        alone = estimate_observations(observations, board, fast)
        result = result_of(name, alone, motion.widened(alone.cov), still[name])
        if motion.offset_s is not None:
            index = motion.samples.channels.index(name)
            offset_s, sigma_s = float(motion.offset_s[index]), float(np.sqrt(motion.cov[index, index]))
            result = replace(result, time_offset_s=offset_s, time_offset_sigma_s=sigma_s)
        channels.append(result)
    begin(progress, "difference of the channels")
    return replace(
        estimate,
        cov=motion.widened(estimate.cov),
        refused={**conflicts, **estimate.refused},
        same_scan={scan.capture: scan.captures for scan in scans if len(scan.captures) > 1},
        channels=tuple(channels),
        channel_difference=_difference(motion, tuple(by_channel.values()), board),
    )


def fit_extrinsic(
    candidates: Sequence[Observation],
    board: Board,
    settings: EstimateSettings | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from both sensors' detections of boards that stood still.

    Args:
        candidates: of each capture with detections of both sensors, in any order.
        board: its specification.
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
        board: its specification.
        settings: method, priors and tolerances.
        progress: told of each step.

    Raises:
        NotEnoughDataError: the captures leave a direction undetermined, which is named.
    """
    begin(progress, "Algorithm 1")
    start = solve(observations, board)
    begin(progress, "uncertainty" if settings.method == "paper" else "maximum likelihood")
    if settings.method == "paper":
        return by_scatter(start, board, settings)
    priors, usual = what_is_known(settings)
    joint = maximise_likelihood([start.observations], board, [start.T_cam_lidar], priors, usual)
    return with_profile(by_likelihood(start, joint, board), joint, board, settings)


def _with_session_lens(
    candidates: Mapping[str, Sequence[Observation]], board: Board, settings: EstimateSettings
) -> tuple[Mapping[str, Sequence[Observation]], EstimateSettings]:
    """Fit the lens of a profile that is not exact, and the boards' poses with it."""
    if settings.tolerances is None or settings.tolerances.lens.is_exact:
        return candidates, settings
    lens = fit_session_lens(candidates, board, settings.tolerances.lens)
    refitted = {name: lens.refit(observations) for name, observations in candidates.items()}
    return refitted, replace(settings, lens=lens)


def _agree(
    candidates: Mapping[str, Sequence[Observation]], board: Board
) -> tuple[dict[str, Consensus], dict[str, float]]:
    """Find each channel's consensus and corner noise, px; the channel with the steadiest corners first."""
    agreed: dict[str, Consensus] = {}
    troubles: list[NotEnoughDataError] = []
    for channel, items in candidates.items():
        try:
            agreed[channel] = find_consensus(items, board)
        except NotEnoughDataError as error:
            troubles.append(error)
    if not agreed:
        raise troubles[0]
    # Of each channel's corners per coordinate, from the residuals of all its boards.
    noise = {
        name: float(np.sqrt(np.mean([o.image.sigma_px**2 for o in consensus.observations])))
        for name, consensus in agreed.items()
    }
    return {name: agreed[name] for name in sorted(agreed, key=lambda name: noise[name])}, noise


def _with_consensus(estimate: CalibrationEstimate, agreed: Sequence[Consensus]) -> CalibrationEstimate:
    """Add the refusals of the channels' consensus to an estimate."""
    refused = dict(estimate.refused)
    for consensus in agreed:
        refused = {**consensus.refused, **refused}
    return replace(estimate, refused=dict(sorted(refused.items())))


def depth_scatter_m(T_cam_lidar: Array, observations: Sequence[Observation]) -> float:
    """Compute the standard deviation over captures of the LiDAR's mean distance from the camera's plane."""
    T_cam_board = np.array([observation.image.T_cam_board for observation in observations])
    middles = np.array([observation.lidar.points.mean(axis=0) for observation in observations])
    depths = along_normals(T_cam_board[:, :3, 2], T_cam_board[:, :3, 3], middles, T_cam_lidar)
    return float(np.std(depths))


def _difference(
    motion: Motion, by_channel: Sequence[Sequence[Observation]], board: Board
) -> PoseDifference | None:
    """Compare two channels' extrinsics.

    If only the two channels together show how boards moved, each pose depends on both; then one channel's
    extrinsic from half of the scans is compared with the other's from the other half, and of several ways to
    share them out the median counts.

    Args:
        motion: of the boards.
        by_channel: observations of each channel, positioned by it alone.
        board: its specification.
    """
    if len(by_channel) != 2:
        return None
    if motion.is_seen_by_each:
        first, second = (solve(observations, board) for observations in by_channel)
        covs = [motion.widened(each.cost.jackknife_covariance()[:6, :6]) for each in (first, second)]
        return PoseDifference(difference(first.T_cam_lidar, second.T_cam_lidar), covs[0] + covs[1])
    rng = np.random.default_rng(0)
    ways: list[PoseDifference] = []
    for _ in range(_N_SHARES):
        mine = set(rng.permutation(len(motion.scans))[: len(motion.scans) // 2].tolist())
        names = {motion.scans[k].capture for k in mine}
        try:
            halves = [
                solve([o for o in observations if (o.capture in names) == is_first], board)
                for observations, is_first in zip(by_channel, (True, False), strict=True)
            ]
        except NotEnoughDataError:
            continue  # This split of few scans leaves a direction undetermined; others may not.
        apart = difference(halves[0].T_cam_lidar, halves[1].T_cam_lidar)
        cov = sum(half.cost.jackknife_covariance()[:6, :6] for half in halves)
        ways.append(PoseDifference(apart, np.asarray(cov)))
    return sorted(ways, key=lambda way: way.chi2)[len(ways) // 2] if ways else None
