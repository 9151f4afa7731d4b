"""A simulated session with its truth: captures of the board among decoys, still or hand-held."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.rig import Rig
from lce_rig.simulate.carriers import build_carrier
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import CARRIER, HAND, PHASE, PLACEMENT, Stage, set_stage
from lce_rig.simulate.subframes import film
from lce_rig.simulate.takes import MovingBoard, take_image, take_scan
from lce_rig.simulate.trajectory import Trajectory, hold_board, sway_board

_FIRST_STAMP_NS = 1_700_000_000_000_000_000
_CAPTURE_EVERY_NS = 4_000_000_000
# Range noise, and mixed returns at the border, do not count as the board's.
_ON_BOARD_M = 0.05


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """One capture with its truth.

    Attributes:
        index: of the capture in its session.
        images: one a camera that has a channel of frames, in the profile's order.
        scans: one a LiDAR, in the profile's order.
        T_lidar_board: true (4, 4) by LiDAR, at its scan's timestamp.
        T_cam_board: true (4, 4) by camera, at the middle of its image's exposure; of a camera without
            frames, at the timestamp of the scan it was placed for.
        target: the camera and the LiDAR that the board was placed for; others may not see it.
        events: one a camera that has a channel of events, if the board moves.
        trajectory: where the board is in the world at any time of the rig's clock, the LiDAR's.
        T_world_sensor: (4, 4) of each camera and LiDAR.
    """

    index: int
    images: list[Image]
    scans: list[Scan]
    T_lidar_board: Mapping[str, Array]
    T_cam_board: Mapping[str, Array]
    target: tuple[str, str]
    events: list[Events]
    trajectory: Trajectory
    T_world_sensor: Mapping[str, Array]

    def T_sensor_board(self, sensor: str, t_ns: int | NDArray[np.int64]) -> Array:
        """Compute the board's true pose (..., 4, 4) before a camera or LiDAR at times of the rig's clock.

        Timestamps of images and events read `frame_offset_s` or `event_offset_s` more than that clock.
        """
        return np.asarray(invert(self.T_world_sensor[sensor]) @ self.trajectory.at(t_ns))


def simulate_captures(
    rig: Rig, *, n_captures: int, seed: int, options: SimulationOptions | None = None
) -> Iterator[SimulatedCapture]:
    """Simulate captures one by one; the same arguments give the same bytes.

    Args:
        rig: the profile.
        n_captures: how many; the first ones do not depend on this number.
        seed: of truth, room, placements and noise.
        options: `SimulationOptions.for_rig` of the rig by default.

    Raises:
        ProfileError: a LiDAR's model is unknown, or no camera has a channel that can be simulated.
        LceRigError: no place for the board is seen by the camera and the LiDAR.
    """
    stage = set_stage(rig, seed, options)
    for index in range(n_captures):
        if stage.options.motion == "moving":
            yield _moving_capture(stage, index)
        else:
            rng = stage.rng(index, PLACEMENT)
            yield capture_at(stage, index, stage.place(index, rng), rng)


def capture_at(
    stage: Stage, index: int, T_world_board: Array, rng: np.random.Generator | None = None
) -> SimulatedCapture:
    """Take one capture of a board that is held still at a given place.

    Args:
        stage: the session, see `set_stage`.
        index: of the capture; its noise and its timestamp follow from it.
        T_world_board: (4, 4).
        rng: source of what its carrier looks like; follows from the index by default.
    """
    carrier_rng = stage.rng(index, CARRIER) if rng is None else rng
    carrier = build_carrier(stage.options.carrier, stage.board, T_world_board, carrier_rng)
    scene = Scene(stage.room.raycaster, carrier, stage.board, T_world_board, stage.options.print_reflectivity)
    stamp_ns = _FIRST_STAMP_NS + index * _CAPTURE_EVERY_NS
    exposed_ns = stamp_ns + _half_turn_ns(stage, index)
    images = [take_image(stage, camera, scene, exposed_ns, (index,)) for camera in stage.framed]
    scans = [take_scan(stage, lidar, scene, stamp_ns, (index,)) for lidar in stage.models]
    times_ns = dict.fromkeys(stage.T_world_sensor, stamp_ns)
    return _capture(stage, index, images, scans, [], hold_board(T_world_board), times_ns)


def _moving_capture(stage: Stage, index: int) -> SimulatedCapture:
    """Take one capture of a board that passes its placement when the LiDAR scans it."""
    options = stage.options
    stamp_ns = _FIRST_STAMP_NS + index * _CAPTURE_EVERY_NS
    middle_ns = stamp_ns + _half_turn_ns(stage, index)
    T_world_board = stage.place(index, stage.rng(index, PLACEMENT))
    trajectory = sway_board(T_world_board, middle_ns, options.hand, stage.rng(index, HAND))
    board = MovingBoard(stage, trajectory, (index, CARRIER))
    # A camera that runs freely: its image nearest to the scan's middle, by its own timestamps.
    phase_s = options.frame_every_s * stage.rng(index, PHASE).uniform(-0.5, 0.5)
    exposed_ns = middle_ns + round(1e9 * (phase_s - options.frame_offset_s))
    images = [board.take_image(camera, exposed_ns, (index,)) for camera in stage.framed]
    scans = [board.take_scan(lidar, stamp_ns, (index,)) for lidar in stage.models]
    before_s, after_s = options.events_span_s
    start_ns, end_ns = (stamp_ns + round(1e9 * (s - options.event_offset_s)) for s in (-before_s, after_s))
    events = []
    for camera in stage.pixels:
        view = board.view(camera)
        sensor = board.event_camera(camera, view, start_ns, (index,))
        film(view, sensor, start_ns, end_ns)
        events.append(sensor.take())
    times_ns = dict.fromkeys(stage.T_world_sensor, stamp_ns) | dict.fromkeys(stage.framed, exposed_ns)
    return _capture(stage, index, images, scans, events, trajectory, times_ns)


def _half_turn_ns(stage: Stage, index: int) -> int:
    """How long after its scan's timestamp the LiDAR of this capture looks straight ahead."""
    view = stage.views[index % len(stage.views)]
    return stage.models[view.lidar].period_ns // 2


def _capture(
    stage: Stage,
    index: int,
    images: list[Image],
    scans: list[Scan],
    events: list[Events],
    trajectory: Trajectory,
    times_ns: Mapping[str, int],
) -> SimulatedCapture:
    """Put samples together with the truth at each sensor's own time."""
    view = stage.views[index % len(stage.views)]
    T_sensor_board = {
        name: invert(T_world_sensor) @ trajectory.at(times_ns[name])
        for name, T_world_sensor in stage.T_world_sensor.items()
    }
    return SimulatedCapture(
        index,
        images,
        scans,
        {name: T_sensor_board[name] for name in stage.rig.lidars},
        {name: T_sensor_board[name] for name in stage.rig.cameras},
        (view.camera, view.lidar),
        events,
        trajectory,
        stage.T_world_sensor,
    )


def capture_truth(rig: Rig, capture: SimulatedCapture, options: SimulationOptions) -> dict[str, Any]:
    """Return where the board was when each sensor saw it.

    Returns:
        `boards`: by sensor `t_ns`, on the rig's clock, and `T_sensor_board` then; `speed_mps` of the board's
        middle when the LiDAR that it was placed for met it. A LiDAR's time is the mean firing time of its
        returns from the board, a camera's the middle of its image's exposure, or that of the LiDAR where it
        takes none.
    """
    times_ns = {scan.sensor: board_time_ns(rig, capture, scan) for scan in capture.scans}
    middle_ns = times_ns[capture.target[1]]
    times_ns |= dict.fromkeys(rig.cameras, middle_ns)
    for image in capture.images:
        times_ns[image.sensor] = (image.stamp_ns or 0) - round(1e9 * options.frame_offset_s)
    return {
        "speed_mps": round(float(capture.trajectory.speed_mps(middle_ns)), 6),
        "boards": {
            sensor: {"t_ns": t_ns, "T_sensor_board": capture.T_sensor_board(sensor, t_ns).tolist()}
            for sensor, t_ns in times_ns.items()
        },
    }


def board_time_ns(rig: Rig, capture: SimulatedCapture, scan: Scan) -> int:
    """Find the mean firing time of a scan's board returns; half a scan after its timestamp without any.

    Each return is compared with the board where it was at that return's own time.
    """
    first_ns = scan.stamp_ns or 0
    middle_ns = first_ns + round(0.5e9 / rig.lidars[scan.sensor].rate_hz)
    if scan.offset_ns is None:
        return middle_ns
    board = rig.board.to_board()
    T_lidar_board = capture.T_sensor_board(scan.sensor, middle_ns)
    reach_m = 0.3 + 0.5 * np.hypot(board.width_m, board.height_m)
    near = np.linalg.norm(scan.points - T_lidar_board[:3, 3], axis=1) < reach_m
    offset_ns = scan.offset_ns[near]
    T_board_lidar = invert(capture.T_sensor_board(scan.sensor, first_ns + offset_ns))
    points = transform(T_board_lidar, scan.points[near, None].astype(np.float64))[:, 0]
    is_on = np.all(np.abs(points) < [board.width_m / 2, board.height_m / 2, _ON_BOARD_M], axis=1)
    return first_ns + round(offset_ns[is_on].mean()) if is_on.any() else middle_ns
