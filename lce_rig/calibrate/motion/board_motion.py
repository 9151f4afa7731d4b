"""Motion of a hand-held board in front of one camera during each capture, from all its images.

Images of one capture, of one channel or several, see the board at different times. Around each scan, its
velocity is assumed to be constant,

    c(t) = c_0 + v t,    R(t) = exp((w t)^) R_0,    v ~ N(0, s_v^2 I),    w ~ N(0, s_w^2 I)               (1)

The four vectors of each capture follow from its images by linear least squares in the tangent space of one
of their poses; the hand's typical rates s_v and s_w follow from all captures together.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lce_rig.calibrate.observations import Clocks, SharedScan
from lce_rig.calibrate.quadratics import symmetric_inverse
from lce_rig.core.geometry import Array, difference, fit_plane, perturb, rotation_angle, skew
from lce_rig.core.results import LidarBoard, Observation

# Prior of a hand's typical rates: (speed m/s, turn rad/s) per axis, and its weight in captures.
USUAL_HABITS = np.array([0.15, np.radians(10.0)])
_USUAL_WEIGHT = 3.0
_N_LEARNING = 15
# Errors of board poses not covered by corner noise: lens, board and reconstruction.
POSE_FLOOR = np.r_[np.full(3, 1e-3), np.full(3, np.radians(0.1))]
_HALF_TURN = np.diag([-1, -1, 1])


@dataclass(frozen=True, eq=False)
class PoseSamples:
    """Board poses in the images of F captures, at most J per capture.

    Attributes:
        channels: names of the channels.
        T_cam_board: (F, J, 4, 4).
        information: (F, J, 6, 6) inverse covariance, zero without an image.
        time_s: (F, J) after the scan's timestamp, by the profile's clocks.
        channel: (F, J) index into `channels`.
    """

    channels: tuple[str, ...]
    T_cam_board: Array
    information: Array
    time_s: Array
    channel: NDArray[np.intp]

    @property
    def is_followed(self) -> NDArray[np.bool_]:
        """Whether a sample (F, J) is of a channel with images at several times of its capture."""
        known = self.information[..., 0, 0] > 0
        mates = known[:, :, None] & known[:, None] & (self.channel[:, :, None] == self.channel[:, None])
        return np.asarray(np.any(mates & (self.time_s[:, :, None] != self.time_s[:, None]), axis=2))

    @property
    def tells_motion(self) -> NDArray[np.bool_]:
        """Whether a capture (F,) has images at two times, or of two channels whose offset may differ."""
        known = self.information[..., 0, 0] > 0
        differs = (self.time_s != self.time_s[:, :1]) | (self.channel != self.channel[:, :1])
        return np.asarray(np.any(known & differs, axis=1))

    def select(self, keep: Sequence[int]) -> "PoseSamples":
        """Keep captures by index."""
        k = np.asarray(keep, dtype=np.intp)
        return PoseSamples(
            self.channels, self.T_cam_board[k], self.information[k], self.time_s[k], self.channel[k]
        )


@dataclass(frozen=True, eq=False)
class BoardMotions:
    """Equation (1) for F captures.

    Attributes:
        T_cam_board: (F, 4, 4) at the scan's timestamp.
        rates: (F, 6) tangent per second (m/s, rad/s).
        cov: (F, 12, 12) of pose and rates.
        misfit, log_volume: (F,) each, their sum is -2 ln p(poses) up to a constant: the residual of (1) at a
            hand's typical rates, and the log volume of possible motions.
    """

    T_cam_board: Array
    rates: Array
    cov: Array
    misfit: Array
    log_volume: Array

    @property
    def significance(self) -> float:
        """Mean squared rate in units of its variance: large where boards moved, about 1 for noise alone."""
        rates = self.rates
        squares = np.einsum("fi,fik,fk->f", rates, np.linalg.inv(self.cov[:, 6:, 6:]), rates)
        return float(np.mean(squares)) / 6

    def at(self, time_s: Array) -> Array:
        """Compute T_cam_board (F, 4, 4) at a time (F,) of each capture after its scan's timestamp."""
        return perturb(self.T_cam_board, self.rates * time_s[:, None])

    def cov_at(self, time_s: Array) -> Array:
        """Compute the covariance (F, 6, 6) of `at`."""
        t = time_s[:, None, None]
        cross = self.cov[:, :6, 6:]
        both = cross + np.swapaxes(cross, 1, 2)
        return np.asarray(self.cov[:, :6, :6] + t * both + t**2 * self.cov[:, 6:, 6:])


def sample_poses(scans: Sequence[SharedScan], clocks: Clocks, noise_px: Mapping[str, float]) -> PoseSamples:
    """Collect the board poses in the images of each scan.

    The images of one channel in one capture, reconstructed from one stream, share much of their error:
    together they count as one.

    Args:
        scans: scans with their images; the first image's corners give the orientation of the others.
        clocks: clock settings of the sensors.
        noise_px: corner noise by channel, replacing each image's own.
    """
    channels = tuple(sorted({channel for scan in scans for channel in scan.images}))
    floor = np.diag(POSE_FLOOR**2)
    rows: list[list[tuple[Array, Array, float, int]]] = []
    for scan in scans:
        row = []
        for channel, board in scan.images.items():
            after_s = clocks.after_scan_s(channel, board, scan.lidar)
            poses = [(board.T_cam_board, board.cov, after_s)]
            if board.track_ns is not None and board.track_T_cam_board is not None:
                assert board.stamp_ns is not None and board.track_cov is not None
                times_s = after_s + (board.track_ns - board.stamp_ns) * 1e-9
                poses += zip(board.track_T_cam_board, board.track_cov, times_s.tolist(), strict=True)
            scale = (noise_px[channel] / max(board.sigma_px, 1e-6)) ** 2
            for T_cam_board, cov, t in poses:
                information = symmetric_inverse(len(poses) * (scale * cov + floor))
                row.append((T_cam_board, information, t, channels.index(channel)))
        rows.append(row)
    shape = len(rows), max(len(row) for row in rows)
    T = np.broadcast_to(np.eye(4), (*shape, 4, 4)).copy()
    information, time_s = np.zeros((*shape, 6, 6)), np.zeros(shape)
    channel_id = np.zeros(shape, dtype=np.intp)
    for f, row in enumerate(rows):
        for j, sample in enumerate(row):
            T[f, j], information[f, j], time_s[f, j], channel_id[f, j] = sample
        turned = rotation_angle(T[f, 1:, :3, :3], T[f, 0, :3, :3]) > np.pi / 2
        T[f, 1:, :3, :3][turned] = T[f, 1:, :3, :3][turned] @ _HALF_TURN
    return PoseSamples(channels, T, information, time_s, channel_id)


def fit_motions(samples: PoseSamples, offset_s: Array, only: str | None = None) -> BoardMotions:
    """Fit equation (1) to each capture, with the typical rates of maximum likelihood.

    Args:
        samples: samples of F captures.
        offset_s: (C,) added to the images' times, by channel.
        only: channel that alone determines the board's position; the others then only determine its motion.

    References:
        The typical rates follow from expectation maximisation: Dempster, Laird, Rubin, "Maximum likelihood
        from incomplete data via the EM algorithm", J. Royal Statistical Society B, 1977.
    """
    time_s = samples.time_s + offset_s[samples.channel]
    base = samples.T_cam_board[:, 0]
    y = difference(samples.T_cam_board, base[:, None])
    # A tracked channel alone determines the motion: differences between channels must not count as motion.
    is_followed = samples.is_followed
    is_heard = is_followed | ~np.any(is_followed, axis=1, keepdims=True)
    heard = samples.information * is_heard[..., None, None]
    # Normal equations of y_j = p + t_j r, without the prior of r: (F, 12, 12) and (F, 12).
    powers = np.stack([np.ones_like(time_s), time_s], axis=-1)
    H = np.einsum("fja,fjb,fjkl->fakbl", powers, powers, heard).reshape(-1, 12, 12)
    g = np.einsum("fja,fjk->fak", powers, (heard @ y[..., None])[..., 0]).reshape(-1, 12)
    prior = _learn_habits(H, g)
    cov = np.asarray(np.linalg.inv(H + prior), dtype=np.float64)
    mean = (cov @ g[..., None])[..., 0]
    moved = y - mean[:, None, :6] - time_s[..., None] * mean[:, None, 6:]
    misfit = np.einsum("fji,fjik,fjk->f", moved, heard, moved)
    misfit += np.einsum("fi,ik,fk->f", mean, prior, mean)
    log_volume = -np.linalg.slogdet(cov)[1] - np.linalg.slogdet(prior[6:, 6:])[1]
    misfit += _disagreement(samples, moved, cov, time_s, ~is_heard)
    if only is not None or not np.all(is_heard):
        is_placing = np.ones(1) if only is None else samples.channel == samples.channels.index(only)
        information = samples.information * is_placing[..., None, None]
        mean, cov = _place(y, information, time_s, mean[:, 6:], cov[:, 6:, 6:])
    return BoardMotions(perturb(base, mean[:, :6]), mean[:, 6:], cov, misfit, log_volume)


def _disagreement(
    samples: PoseSamples, moved: Array, cov: Array, time_s: Array, is_silent: NDArray[np.bool_]
) -> Array:
    """Compute the squared residuals (F,) of images under motions estimated without them.

    Another camera pose, the same in all captures, does not count: its tangent (tau, phi) moves the
    board at c by tau + phi x c.
    """
    f, j = np.nonzero(is_silent & (samples.information[..., 0, 0] > 0))
    misfit = np.zeros(len(moved))
    if len(f) == 0:
        return misfit
    powers = np.stack([np.ones(len(f)), time_s[f, j]], axis=1)
    line_cov = np.einsum("na,nakbl,nb->nkl", powers, cov[f].reshape(-1, 2, 6, 2, 6), powers)
    weight = np.linalg.inv(np.linalg.inv(samples.information[f, j]) + line_cov)
    A = np.zeros((len(f), 6, 6))
    A[:] = np.eye(6)
    A[:, :3, 3:] = -skew(samples.T_cam_board[f, j, :3, 3])
    A_w = np.swapaxes(A, 1, 2) @ weight
    apart = np.linalg.lstsq((A_w @ A).sum(axis=0), (A_w @ moved[f, j, :, None]).sum(axis=0), rcond=None)[0]
    left = moved[f, j] - (A @ apart)[..., 0]
    np.add.at(misfit, f, np.einsum("ni,nik,nk->n", left, weight, left))
    return misfit


def _learn_habits(H: Array, g: Array) -> Array:
    """Estimate the prior precision (12, 12) of position and rates from the hand's typical rates.

    Args:
        H, g: (F, 12, 12), (F, 12) normal equations of both, from which the position is eliminated.
    """
    lever = H[:, 6:, :6] @ np.linalg.inv(H[:, :6, :6])
    H_rates, g_rates = H[:, 6:, 6:] - lever @ H[:, :6, 6:], g[:, 6:] - (lever @ g[:, :6, None])[..., 0]
    habits, prior = USUAL_HABITS, np.zeros((12, 12))
    for _ in range(_N_LEARNING):
        cov = np.linalg.inv(H_rates + np.diag(np.repeat(habits, 3) ** -2.0))
        second = (cov @ g_rates[..., None])[..., 0] ** 2 + np.diagonal(cov, axis1=1, axis2=2)
        total = second.reshape(-1, 2, 3).mean(axis=2).sum(axis=0)
        habits = np.sqrt((_USUAL_WEIGHT * USUAL_HABITS**2 + total) / (_USUAL_WEIGHT + len(g)))
    prior[6:, 6:] = np.diag(np.repeat(habits, 3) ** -2.0)
    return prior


def _place(
    y: Array, information: Array, time_s: Array, rates: Array, cov_rates: Array
) -> tuple[Array, Array]:
    """Solve y_j = p + t_j r for p with the rates r of covariance cov_rates."""
    total = information.sum(axis=1)
    cov = symmetric_inverse(total)
    moved = y - time_s[..., None] * rates[:, None]
    p = (cov @ np.einsum("fjkl,fjl->fk", information, moved)[..., None])[..., 0]
    lever = -cov @ np.einsum("fj,fjkl->fkl", time_s, information)  # d p / d r
    full = np.zeros((len(y), 12, 12))
    full[:, :6, :6] = cov + lever @ cov_rates @ np.swapaxes(lever, 1, 2)
    full[:, :6, 6:] = lever @ cov_rates
    full[:, 6:, :6] = np.swapaxes(full[:, :6, 6:], 1, 2)
    full[:, 6:, 6:] = cov_rates
    return np.concatenate([p, rates], axis=1), full


def board_time_s(lidar: LidarBoard, sweep_s: float) -> float:
    """Average the firing times of a board's points, s after the scan's timestamp; mid-scan if unknown."""
    return sweep_s / 2 if lidar.offset_ns is None else float(np.mean(lidar.offset_ns)) * 1e-9


def compensate(
    observations: Sequence[Observation], motions: BoardMotions, T_cam_lidar: Array, sweep_s: float
) -> list[Observation]:
    """Bring both sensors' boards to the LiDAR's time, and the points of each board to one time.

    Args:
        observations: observations of F captures.
        motions: motions of the board in them.
        T_cam_lidar: (4, 4), accurate to a few degrees; it only rotates the rates of motion.
        sweep_s: duration of a revolution of the LiDAR.
    """
    times_s = np.array([board_time_s(observation.lidar, sweep_s) for observation in observations])
    moved = [
        replace(o, pose=replace(o.pose, T_cam_board=T, cov=cov, T_cam_board_alternative=None))
        for o, T, cov in zip(observations, motions.at(times_s), motions.cov_at(times_s), strict=True)
    ]
    return deskew_points(moved, motions, T_cam_lidar)


def deskew_points(
    observations: Sequence[Observation], motions: BoardMotions, T_cam_lidar: Array
) -> list[Observation]:
    """Motion-compensate the points of boards to one time, as `compensate`."""
    R_cam_lidar = T_cam_lidar[:3, :3]
    rates = np.concatenate([motions.rates[:, :3] @ R_cam_lidar, motions.rates[:, 3:] @ R_cam_lidar], axis=1)
    return [replace(o, surface=deskew(o.lidar, rate)) for o, rate in zip(observations, rates, strict=True)]


def deskew(lidar: LidarBoard, rates_lidar: Array) -> LidarBoard:
    """Move a board's points to their positions at the points' mean firing time.

    Args:
        lidar: board with firing times; without them nothing is moved.
        rates_lidar: (6,) tangent per second (m/s, rad/s) of the board about its middle, frame lidar.
    """
    if lidar.offset_ns is None:
        return lidar
    since_s = lidar.offset_ns * 1e-9 - float(np.mean(lidar.offset_ns)) * 1e-9
    arms = lidar.points - lidar.T_lidar_board[:3, 3]
    moved = -since_s[:, None] * (rates_lidar[:3] + np.cross(rates_lidar[3:], arms))
    # A ring end is one of the points, or within one step of a point.
    ends, all_points = lidar.edge_points, lidar.points
    squared = np.sum(ends**2, axis=1)[:, None] - 2 * ends @ all_points.T + np.sum(all_points**2, axis=1)
    nearest = np.argmin(squared, axis=1)
    points = lidar.points + moved
    plane, rms_m = fit_plane(points)
    return replace(
        lidar, points=points, edge_points=lidar.edge_points + moved[nearest], plane=plane, sigma_m=rms_m
    )
