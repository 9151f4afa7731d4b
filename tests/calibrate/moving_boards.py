"""Moving boards before a LiDAR and the two channels of one camera, with clock errors."""

from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.geometry import fit_plane, invert, perturb
from lce_rig.core.results import Observation
from tests.calibrate.boards import BOARD, T_FORWARD, Scenario, photograph, random_pose, scan_board

STAMP_NS = 1_700_000_000_000_000_000
TRACK_S = (-0.1, -0.05, 0.05, 0.1)


@dataclass(frozen=True)
class Moving:
    """How boards move and clocks err.

    Attributes:
        speed_mps, turn_deg_s: standard deviation of the rates, for each axis.
        offset_s: what is to be added to the stamps of each channel.
        tracked: channels whose boards are followed from picture to picture.
        has_stamps: whether samples carry stamps; without them pictures lie `offset_s` after the first firing.
        events_px: corner noise of the events' pictures.
        apart: tangent (6,) of the place of the camera that the events show, from that of the frames.
    """

    speed_mps: float = 0.15
    turn_deg_s: float = 8.0
    offset_s: tuple[tuple[str, float], ...] = (("frames", -0.02), ("events", 0.06))
    tracked: tuple[str, ...] = ()
    has_stamps: bool = True
    events_px: float = 0.2
    apart: tuple[float, ...] = (0.0,) * 6


def simulate_moving(n, seed, moving=None, scenario=None):
    """Simulate n captures of a moving board, by channel."""
    moving, scenario = moving or Moving(), scenario or Scenario()
    rng = np.random.default_rng(seed)
    found = {channel: [] for channel, _ in moving.offset_s}
    while len(found["frames"]) < n:
        T_cam_board = random_pose(rng, scenario, BOARD)
        rates = np.r_[
            moving.speed_mps * rng.standard_normal(3), np.radians(moving.turn_deg_s) * rng.standard_normal(3)
        ]
        middle_s = rng.uniform(0.02, 0.08)
        still = scan_board(invert(T_FORWARD) @ perturb(T_cam_board, rates * middle_s), rng, scenario, BOARD)
        if still is None:
            continue
        lidar = skew(still, rates, middle_s)
        images = {
            channel: _picture(channel, T_cam_board, rates, offset_s, moving, scenario, rng)
            for channel, offset_s in moving.offset_s
        }
        if any(image is None for image in images.values()):
            continue
        name = f"{len(found['frames']):06d}"
        for channel, image in images.items():
            assert image is not None
            found[channel].append(Observation(name, image, lidar))
    return found


def skew(lidar, rates, middle_s):
    """Move points along their rays to where a board on its way meets them."""
    azimuth = np.arctan2(lidar.points[:, 1], lidar.points[:, 0])
    since_s = -(azimuth - azimuth.mean()) / (2 * np.pi) * 0.1
    R_lidar_cam = T_FORWARD[:3, :3].T
    centre, normal = lidar.points.mean(axis=0), lidar.plane[:3]
    v, w = R_lidar_cam @ rates[:3], R_lidar_cam @ rates[3:]

    def along_rays(points, times_s):
        way = (times_s[:, None] * (v + np.cross(w, points - centre))) @ normal
        return points * (1 + way / (points @ normal))[:, None]

    nearest = np.argmin(np.linalg.norm(lidar.points[None] - lidar.edge_points[:, None], axis=2), axis=1)
    points = along_rays(lidar.points, since_s)
    plane, rms_m = fit_plane(points)
    return replace(
        lidar,
        points=points,
        edge_points=along_rays(lidar.edge_points, since_s[nearest]),
        plane=plane,
        sigma_m=rms_m,
        offset_ns=np.rint(1e9 * (middle_s + since_s - since_s.mean())).astype(np.int64),
        stamp_ns=STAMP_NS,
    )


def _picture(channel, T_cam_board, rates, offset_s, moving, scenario, rng):
    """Photograph the board; the camera's clock reads `offset_s` less than the LiDAR's."""
    is_events = channel == "events"
    noise = replace(scenario, corner_sigma_px=moving.events_px if is_events else scenario.corner_sigma_px)
    elsewhere = perturb(np.eye(4), np.array(moving.apart) * is_events)
    taken_s = offset_s + (rng.uniform(-0.03, 0.07) if moving.has_stamps else 0.0)

    def at(t_s):
        return photograph(elsewhere @ perturb(T_cam_board, rates * t_s), rng, noise, BOARD)

    image = at(taken_s)
    if image is None or not moving.has_stamps:
        return image
    stamp_ns = STAMP_NS + round(1e9 * (taken_s - offset_s))
    image = replace(image, stamp_ns=stamp_ns)
    if channel not in moving.tracked:
        return image
    followed = [at(taken_s + t) for t in TRACK_S]
    kept = [(t, other) for t, other in zip(TRACK_S, followed, strict=True) if other is not None]
    if not kept:
        return image
    return replace(
        image,
        track_ns=np.array([stamp_ns + round(1e9 * t) for t, _ in kept], dtype=np.int64),
        track_T_cam_board=np.stack([other.T_cam_board for _, other in kept]),
        track_cov=np.stack([other.cov for _, other in kept]),
    )
