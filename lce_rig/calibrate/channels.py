"""Joint extrinsics from all channels of a camera: frames and events share pixels and lens, not their times.

    consensus by channel -> shared scans -> motion and time offsets -> one board pose per scan -> the method

If images show how the board moved, its pose at the LiDAR's time replaces its pose in each image. Every
channel is also calibrated alone, and two are compared by Algorithm 1, as a camera has one pose.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.calibrate.algorithm_1.algorithm import NOMINAL_SIGMA_M
from lce_rig.calibrate.algorithm_1.moments import Weights
from lce_rig.calibrate.consensus import Consensus
from lce_rig.calibrate.estimate import CalibrationEstimate
from lce_rig.calibrate.methods import agree, calibrate_observations, with_consensus
from lce_rig.calibrate.motion.board_motion import PoseSamples, fit_motions
from lce_rig.calibrate.motion.time_offsets import (
    TimeOffsets,
    at_scan_time,
    deskew_points,
    estimate_time_offsets,
)
from lce_rig.calibrate.options import CaptureCandidates, EstimateSettings
from lce_rig.calibrate.plane_and_ends import along_normals
from lce_rig.calibrate.shared_scans import (
    Clocks,
    SharedScan,
    join_scans,
    pooled_noise_px,
    sample_scans,
    time_sigmas_s,
)
from lce_rig.core.board import Board
from lce_rig.core.calibration import ChannelResult
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, difference
from lce_rig.core.results import Observation

# Fewer captures with known motion do not determine time offsets.
_MIN_MOVING = 6
# Ratio of mean squared rates to noise above which boards moved.
_MOVED = 1.0
_N_SHARES = 7


def calibrate_channels(
    candidates: Mapping[str, Sequence[CaptureCandidates]],
    board: Board,
    options: EstimateSettings,
    clocks: Clocks,
    progress: Callable[[int, int], None] | None = None,
) -> CalibrationEstimate:
    """Estimate T_cam_lidar from detections of the channels of one camera and a LiDAR.

    Args:
        candidates: by channel, of each capture with detections of both sensors; channels whose captures agree
            on no extrinsics are skipped.
        board: its specification.
        options: switches of the algorithm.
        clocks: of the sensors.
        progress: called with (subsets done, subsets in all).

    Raises:
        NotEnoughDataError: no channel has enough captures, or they leave a direction undetermined.
    """
    agreed = _agree(candidates, board)
    scans, conflicts = join_scans(agreed, candidates)
    noise_px = {name: pooled_noise_px([o.image for o in c.observations]) for name, c in agreed.items()}
    samples = sample_scans(scans, clocks, noise_px)
    is_moving = int(np.sum(samples.tells_motion)) >= _MIN_MOVING
    if len(agreed) == 1 and not is_moving:
        ((name, consensus),) = agreed.items()
        estimate = calibrate_observations(consensus.observations, board, options, progress)
        estimate = with_consensus(estimate, consensus)
        n_captures = len(consensus.observations)
        result = _channel_result(name, n_captures, noise_px[name], estimate, estimate, None)
        return replace(estimate, channels=(result,))
    plain = _for_comparison(options)
    still = {name: calibrate_observations(own.observations, board, plain) for name, own in agreed.items()}
    start = next(iter(still.values()))
    offsets = _offsets(samples, scans, board, options, clocks, start) if is_moving else None
    mover = _Mover(samples, scans, offsets, start.T_cam_lidar, clocks.sweep_s)
    estimate = _widened(calibrate_observations(mover.observations(), board, options, progress), offsets)
    for consensus in agreed.values():
        estimate = with_consensus(estimate, consensus)
    same_scan = {scan.capture: scan.captures for scan in scans if len(scan.captures) > 1}
    estimate = replace(estimate, refused={**conflicts, **estimate.refused}, same_scan=same_scan)
    seen = {name: mover.observations(name if len(agreed) > 1 else None) for name in sorted(agreed)}
    fast = replace(options, n_draws=0, tolerances=None)
    alone = {name: _widened(calibrate_observations(own, board, fast), offsets) for name, own in seen.items()}
    results = tuple(
        _channel_result(
            name, len(agreed[name].observations), noise_px[name], alone[name], still[name], offsets
        )
        for name in seen
    )
    apart, cov = _difference(mover, tuple(seen.values()), board, plain)
    return replace(estimate, channels=results, channel_difference=apart, channel_difference_cov=cov)


@dataclass(frozen=True, eq=False)
class _Mover:
    """Computes board poses at the LiDAR's time, from all channels or positioned by one alone."""

    samples: PoseSamples
    scans: Sequence[SharedScan]
    offsets: TimeOffsets | None
    T_cam_lidar: Array
    sweep_s: float

    def observations(self, only: str | None = None) -> list[Observation]:
        kept = [k for k, scan in enumerate(self.scans) if only is None or only in scan.images]
        scans = [self.scans[k] for k in kept]
        if self.offsets is None:
            return [scan.observation(only) for scan in scans]
        motions = fit_motions(self.samples.select(kept), self.offsets.offset_s, only)
        still = [scan.observation(only) for scan in scans]
        return deskew_points(at_scan_time(still, motions, self.sweep_s), motions, self.T_cam_lidar)

    @property
    def is_motion_own(self) -> bool:
        """Whether a channel alone shows motion, so that channels can be compared."""
        return bool(np.mean(self.samples.is_followed.any(axis=1)) > 0.5)


def _agree(candidates: Mapping[str, Sequence[CaptureCandidates]], board: Board) -> dict[str, Consensus]:
    """Find each channel's consensus, the channel with the steadiest corners first."""
    agreed: dict[str, Consensus] = {}
    troubles: list[NotEnoughDataError] = []
    for channel, items in candidates.items():
        try:
            agreed[channel] = agree(items, board)
        except NotEnoughDataError as error:
            troubles.append(error)
    if not agreed:
        raise troubles[0]
    noise = {name: pooled_noise_px([o.image for o in c.observations]) for name, c in agreed.items()}
    return {name: agreed[name] for name in sorted(agreed, key=lambda name: noise[name])}


def _for_comparison(options: EstimateSettings) -> EstimateSettings:
    """Choose Algorithm 1, without draws and without what all channels of a camera have in common."""
    return replace(options.without_constant_errors(), method="paper", estimator=None, n_draws=0)


def _offsets(
    samples: PoseSamples,
    scans: Sequence[SharedScan],
    board: Board,
    options: EstimateSettings,
    clocks: Clocks,
    start: CalibrationEstimate,
) -> TimeOffsets | None:
    """Estimate the channels' time offsets; None if the boards did not move."""
    unit = 1 / NOMINAL_SIGMA_M**2
    weights = Weights(
        plane=start.diagnostics.plane_weight * unit,
        edge=start.diagnostics.edge_weight * unit,
        shift_prior=options.parts.edge_shift_precision,
    )
    moving = np.flatnonzero(samples.tells_motion).tolist()
    offsets = estimate_time_offsets(
        samples.select(moving),
        [scans[k].observation() for k in moving],
        board,
        options,
        weights,
        start.T_cam_lidar,
        prior_sigma_s=np.array(time_sigmas_s(scans, clocks, samples.channels)),
        sweep_s=clocks.sweep_s,
    )
    significance = fit_motions(samples.select(moving), offsets.offset_s).significance
    return offsets if significance > _MOVED else None


def _widened(estimate: CalibrationEstimate, offsets: TimeOffsets | None) -> CalibrationEstimate:
    """Add the effect of the time offsets' uncertainty on the extrinsics to the covariance."""
    if offsets is None:
        return estimate
    added = offsets.sensitivity @ offsets.cov @ offsets.sensitivity.T
    return replace(estimate, cov=estimate.cov + added)


def _channel_result(
    name: str,
    n_captures: int,
    noise_px: float,
    alone: CalibrationEstimate,
    still: CalibrationEstimate,
    offsets: TimeOffsets | None,
) -> ChannelResult:
    result = ChannelResult(
        name,
        n_captures,
        noise_px,
        alone.T_cam_lidar,
        alone.cov,
        depth_scatter_m(alone),
        depth_scatter_m(still),
    )
    if offsets is None:
        return result
    index = offsets.channels.index(name)
    return replace(
        result,
        time_offset_s=float(offsets.offset_s[index]),
        time_offset_sigma_s=float(np.sqrt(offsets.cov[index, index])),
    )


def depth_scatter_m(estimate: CalibrationEstimate) -> float:
    """Compute the standard deviation over captures of the LiDAR's mean distance from the camera's plane."""
    seen = estimate.observations.values()
    T_cam_board = np.array([observation.image.T_cam_board for observation in seen])
    middles = np.array([observation.lidar.points.mean(axis=0) for observation in seen])
    depths = along_normals(T_cam_board[:, :3, 2], T_cam_board[:, :3, 3], middles, estimate.T_cam_lidar)
    return float(np.std(depths))


def _difference(
    mover: _Mover, seen: Sequence[Sequence[Observation]], board: Board, options: EstimateSettings
) -> tuple[Array | None, Array | None]:
    """Compare two channels' extrinsics: the tangent (6,) between them and its covariance.

    If only the two channels together show how boards moved, each pose depends on both; then one channel's
    extrinsic from half of the scans is compared with the other's from the other half, and of several ways to
    share them out the median counts.

    Args:
        mover: of the boards.
        seen: observations of each channel, positioned by it alone.
        board: its specification.
        options: of Algorithm 1, without what the channels have in common.
    """
    if len(seen) != 2:
        return None, None
    if mover.offsets is None or mover.is_motion_own:
        first, second = (_widened(calibrate_observations(own, board, options), mover.offsets) for own in seen)
        return difference(first.T_cam_lidar, second.T_cam_lidar), first.cov + second.cov
    rng = np.random.default_rng(options.seed)
    ways: list[tuple[float, Array, Array]] = []
    for _ in range(_N_SHARES):
        mine = set(rng.permutation(len(mover.scans))[: len(mover.scans) // 2].tolist())
        names = {mover.scans[k].capture for k in mine}
        try:
            halves = [
                calibrate_observations([o for o in own if (o.capture in names) == is_first], board, options)
                for own, is_first in zip(seen, (True, False), strict=True)
            ]
        except NotEnoughDataError:
            continue  # This split of few scans leaves a direction undetermined; others may not.
        apart = difference(halves[0].T_cam_lidar, halves[1].T_cam_lidar)
        cov = halves[0].cov + halves[1].cov
        ways.append((float(apart @ np.linalg.solve(cov, apart)), apart, cov))
    if not ways:
        return None, None
    return sorted(ways, key=lambda way: way[0])[len(ways) // 2][1:]
