"""Samples of a board that is held still or moved, and simulated sessions of them with their truth."""

from collections.abc import Iterator, Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from heapq import merge
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, invert, transform
from lce_rig.rig import Rig
from lce_rig.simulate.event_camera import EventCamera
from lce_rig.simulate.image_rendering import expose, render_radiance
from lce_rig.simulate.lidar import sweep_scene
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import Trajectory, carry_board, hold_board, sway_board
from lce_rig.simulate.room import build_carrier
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import (
    CARRIER,
    EVENTS,
    HAND,
    IMAGE,
    OF_SESSION,
    PHASE,
    PLACEMENT,
    SCAN,
    Stage,
    set_stage,
)
from lce_rig.simulate.subframes import MovingView, film, speed_px_s

# Largest motion of the board in the image between two renderings of one exposure, px.
_SMEAR_STEP_PX = 0.35
_MOST_MOMENTS = 15

Stream = tuple[int, ...]
_START_NS = 1_700_000_000_000_000_000
_CAPTURE_EVERY_NS = 4_000_000_000
# Range noise, and mixed returns at the border, do not count as the board's.
_ON_BOARD_M = 0.05
_PACKET_NS = 20_000_000
_TRACK_EVERY_NS = 10_000_000


@dataclass(frozen=True, eq=False)
class StagedBoard:
    """A board, held still or moved, and its carrier in front of the sensors of a stage.

    Samples are taken at times of the rig's clock. Their noise follows from a stream of random numbers.

    Attributes:
        stage: the session.
        trajectory: poses of the board over time.
        carrier_rng: source of the carrier's appearance; it is copied, so that the carrier stays the same.
    """

    stage: Stage
    trajectory: Trajectory
    carrier_rng: np.random.Generator

    def T_sensor_board(self, sensor: str, t_ns: int | NDArray[np.int64]) -> Array:
        """Compute the board's true pose (..., 4, 4) before a camera or LiDAR at times of the rig's clock.

        Timestamps of images and events read `frame_offset_s` or `event_offset_s` more than that clock.
        """
        return np.asarray(invert(self.stage.T_world_sensor[sensor]) @ self.trajectory.at(t_ns))

    def scene_at(self, t_ns: int) -> Scene:
        """Build the scene at a time."""
        T_world_board, stage = self.trajectory.at(t_ns), self.stage
        carrier = build_carrier(stage.options.carrier, stage.board, T_world_board, deepcopy(self.carrier_rng))
        return Scene(stage.room.raycaster, carrier, stage.board, T_world_board)

    def take_image(self, camera: str, exposed_ns: int, stream: Stream) -> Image:
        """Expose an image around a time: the mean of the views while the shutter is open."""
        stage, options = self.stage, self.stage.options
        backdrop = stage.backdrops[camera]
        smear_px = options.exposure_s * speed_px_s(self.trajectory, stage.board, backdrop, exposed_ns)
        n_moments = int(np.clip(np.ceil(smear_px / _SMEAR_STEP_PX), 1, _MOST_MOMENTS))
        middles = (np.arange(n_moments) + 0.5) / n_moments - 0.5
        moments_ns = exposed_ns + np.rint(1e9 * options.exposure_s * middles).astype(np.int64)
        scene = self.scene_at(exposed_ns)
        scenes = [scene.with_board_at(T_world_board) for T_world_board in self.trajectory.at(moments_ns)]
        radiance = np.mean([render_radiance(moment, backdrop) for moment in scenes], axis=0)
        rng = stage.rng(*_numbered(stream, IMAGE, list(stage.backdrops).index(camera)))
        stamp_ns = exposed_ns + round(1e9 * options.frame_offset_s)
        channel = stage.rig.cameras[camera].first_channel("frames") or "frames"
        return Image(camera, channel, stamp_ns, expose(radiance, options.camera, rng), stamp_ns)

    def take_scan(self, lidar: str, stamp_ns: int, stream: Stream) -> Scan:
        """Take a scan that begins at a time; every firing hits a moving board at its pose at that time.

        The carrier keeps its pose of mid-revolution.
        """
        stage = self.stage
        T_world_lidar, model, noise = stage.T_world_sensor[lidar], stage.models[lidar], stage.noise[lidar]
        scene = self.scene_at(stamp_ns + model.period_ns // 2)
        rng = stage.rng(*_numbered(stream, SCAN, list(stage.models).index(lidar)))
        board_at = None if self.trajectory.is_still else self.trajectory.at
        sweep = sweep_scene(scene, T_world_lidar, model, noise, rng, stamp_ns, board_at)
        return stage.measure(lidar, sweep, rng, stamp_ns)

    def view(self, camera: str) -> MovingView:
        """Look at the board through a camera's lens."""
        stage = self.stage
        return MovingView(stage.backdrops[camera], stage.board, self.trajectory, stage.options.camera)

    def take_events(
        self, camera: str, start_ns: int, end_ns: int, every_ns: int, stream: Stream
    ) -> Iterator[Events]:
        """Record an event camera from one time to another, in packets of `every_ns`."""
        stage, view = self.stage, self.view(camera)
        sensor = EventCamera(
            stage.pixels[camera],
            stage.options.events,
            view.at(start_ns),
            start_ns,
            stage.rng(*_numbered(stream, EVENTS, list(stage.pixels).index(camera))),
            sensor=camera,
            offset_ns=round(1e9 * stage.options.event_offset_s),
        )
        for t_ns in range(start_ns, end_ns, every_ns):
            film(view, sensor, t_ns, min(t_ns + every_ns, end_ns))
            yield sensor.take()


def _numbered(stream: Stream, kind: int, sensor: int) -> Stream:
    """Name the stream of one sensor: (session or capture, kind, sensor, any further numbers)."""
    return (stream[0], kind, sensor, *stream[1:])


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """One capture with its truth.

    Attributes:
        index: index of the capture in its session.
        images: one per camera with a channel of frames, in the profile's order.
        scans: one per LiDAR, in the profile's order.
        T_lidar_board: true (4, 4) by LiDAR, at its scan's timestamp.
        T_cam_board: true (4, 4) by camera, at the middle of its image's exposure; of a camera without
            frames, at the timestamp of the scan it was placed for.
        target: the camera and the LiDAR that the board was placed for; others may not see it.
        events: one per camera with a channel of events, if the board moves.
        trajectory: pose of the board in the world at any time of the rig's clock, the LiDAR's.
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
        n_captures: number of captures; the first ones do not depend on it.
        seed: random seed of truth, room, placements and noise.
        options: `SimulationOptions.for_rig` of the rig by default.

    Raises:
        ProfileError: a LiDAR's model is unknown, or no camera has a channel that can be simulated.
        LceRigError: no placement of the board is visible to the camera and the LiDAR.
    """
    stage = set_stage(rig, seed, options)
    options = stage.options
    for index in range(n_captures):
        rng = stage.rng(index, PLACEMENT)
        T_world_board = stage.place(index, rng)
        if options.motion == "still":
            yield capture_at(stage, index, T_world_board, rng)
            continue
        # The board passes its placement when the LiDAR scans it.
        middle_ns = _middle_ns(stage, index)
        trajectory = sway_board(T_world_board, middle_ns, options.hand, stage.rng(index, HAND))
        # A camera that runs freely: its image nearest to the scan's middle, by its own timestamps.
        phase_s = options.frame_every_s * stage.rng(index, PHASE).uniform(-0.5, 0.5)
        exposed_ns = middle_ns + round(1e9 * (phase_s - options.frame_offset_s))
        yield _capture(StagedBoard(stage, trajectory, stage.rng(index, CARRIER)), index, exposed_ns)


def capture_at(
    stage: Stage, index: int, T_world_board: Array, rng: np.random.Generator | None = None
) -> SimulatedCapture:
    """Take one capture of a still board at a given placement.

    Args:
        stage: the session, see `set_stage`.
        index: index of the capture; its noise and its timestamp follow from it.
        T_world_board: (4, 4).
        rng: source of the carrier's appearance; follows from the index by default.
    """
    board = StagedBoard(stage, hold_board(T_world_board), rng or stage.rng(index, CARRIER))
    return _capture(board, index, _middle_ns(stage, index))


def _middle_ns(stage: Stage, index: int) -> int:
    """Find when the LiDAR of a capture looks straight ahead."""
    lidar = stage.views[index % len(stage.views)].lidar
    return _START_NS + index * _CAPTURE_EVERY_NS + stage.models[lidar].period_ns // 2


def _capture(board: StagedBoard, index: int, exposed_ns: int) -> SimulatedCapture:
    """Take samples, with the truth at each sensor's own time."""
    stage, options = board.stage, board.stage.options
    stamp_ns = _START_NS + index * _CAPTURE_EVERY_NS
    images = [board.take_image(camera, exposed_ns, (index,)) for camera in stage.framed]
    scans = [board.take_scan(lidar, stamp_ns, (index,)) for lidar in stage.models]
    before_s, after_s = options.events_span_s
    start_ns, end_ns = (stamp_ns + round(1e9 * (s - options.event_offset_s)) for s in (-before_s, after_s))
    events = [
        next(board.take_events(camera, start_ns, end_ns, end_ns - start_ns, (index,)))
        for camera in stage.pixels
    ]
    times_ns = dict.fromkeys(stage.T_world_sensor, stamp_ns) | dict.fromkeys(stage.framed, exposed_ns)
    T_sensor_board = {name: board.T_sensor_board(name, t_ns) for name, t_ns in times_ns.items()}
    view = stage.views[index % len(stage.views)]
    return SimulatedCapture(
        index,
        images,
        scans,
        {name: T_sensor_board[name] for name in stage.rig.lidars},
        {name: T_sensor_board[name] for name in stage.rig.cameras},
        (view.camera, view.lidar),
        events,
        board.trajectory,
        stage.T_world_sensor,
    )


def capture_truth(rig: Rig, capture: SimulatedCapture, options: SimulationOptions) -> dict[str, Any]:
    """Return the board's true pose at each sensor's time of measurement.

    Returns:
        `boards`: `t_ns`, on the rig's clock, and `T_sensor_board` at that time, by sensor; and `speed_mps` of
            the
        board's middle at the time of the LiDAR that it was placed for. A LiDAR's time is the mean firing time
        of its returns from the board. A camera's is the middle of its image's exposure, or without an image
        that LiDAR's time.
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
    """Return the mean firing time of a scan's board returns; mid-scan without any.

    Each return is compared with the board's pose at that return's own time.
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


@dataclass(frozen=True, eq=False)
class SimulatedRecording(StagedBoard):
    """A recording with its truth; iterating yields its samples in order of their timestamps.

    Attributes:
        start_ns, end_ns: on the rig's clock.
    """

    start_ns: int
    end_ns: int

    def __iter__(self) -> Iterator[Image | Scan | Events]:
        stage = self.stage
        every_ns = round(1e9 * stage.options.frame_every_s)

        def images(camera: str) -> Iterator[Image]:
            for k, t_ns in enumerate(range(self.start_ns + every_ns // 2, self.end_ns, every_ns)):
                yield self.take_image(camera, t_ns, (OF_SESSION, k))

        def scans(lidar: str, period_ns: int) -> Iterator[Scan]:
            for k, t_ns in enumerate(range(self.start_ns, self.end_ns - period_ns + 1, period_ns)):
                yield self.take_scan(lidar, t_ns, (OF_SESSION, k))

        streams: list[Iterator[Image | Scan | Events]] = [
            *map(images, stage.framed),
            *(scans(lidar, model.period_ns) for lidar, model in stage.models.items()),
            *(
                filter(len, self.take_events(camera, self.start_ns, self.end_ns, _PACKET_NS, (OF_SESSION,)))
                for camera in stage.pixels
            ),
        ]
        return merge(*streams, key=stamp_of)


def stamp_of(sample: Image | Scan | Events) -> int:
    """Read a sample's timestamp; a packet of events has that of its first one."""
    return int(sample.t_ns[0]) if isinstance(sample, Events) else int(sample.stamp_ns or 0)


def simulate_recording(
    rig: Rig, *, duration_s: float, seed: int, options: SimulationOptions | None = None
) -> SimulatedRecording:
    """Set up a recording that is simulated while iterated over; the same arguments give the same bytes.

    The board moves from one placement to the next; they are those of `simulate_captures` with this seed.

    Args:
        rig: the profile.
        duration_s: duration of the recording.
        seed: random seed of truth, room, placements and noise.
        options: `SimulationOptions.for_rig` of the rig by default; the board always moves.

    Raises:
        ProfileError: a LiDAR's model is unknown, or no camera has a channel that can be simulated.
        LceRigError: no placement of the board is visible to the camera and the LiDAR.
    """
    options = replace(options or SimulationOptions.for_rig(rig.name), motion="moving")
    stage = set_stage(rig, seed, options)
    end_ns = _START_NS + round(1e9 * duration_s)
    placements: list[Array] = []
    while True:
        placements.append(stage.place(len(placements), stage.rng(len(placements), PLACEMENT)))
        trajectory = carry_board(placements, _START_NS, options.hand, stage.rng(OF_SESSION, HAND))
        if trajectory.departure_ns[-1] >= end_ns:
            carrier_rng = stage.rng(OF_SESSION, CARRIER)
            return SimulatedRecording(stage, trajectory, carrier_rng, _START_NS, end_ns)


def recording_truth(recording: SimulatedRecording) -> dict[str, Any]:
    """Return the board's pose before the first LiDAR, 100 times per second.

    Returns:
        `boards`: by LiDAR `t_ns` (K), on the rig's clock, and `T_sensor_board` (K, 4, 4).
    """
    lidar = next(iter(recording.stage.rig.lidars))
    t_ns = np.arange(recording.start_ns, recording.end_ns + _TRACK_EVERY_NS, _TRACK_EVERY_NS)
    track = {"t_ns": t_ns.tolist(), "T_sensor_board": recording.T_sensor_board(lidar, t_ns).tolist()}
    return {"boards": {lidar: track}}
