"""A simulated recording: images, scans and events of a board moved between placements."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from heapq import merge
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Events, Image, Scan
from lce_rig.core.geometry import Array, invert
from lce_rig.rig import Rig
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.stage import CARRIER, HAND, OF_SESSION, PLACEMENT, Stage, set_stage
from lce_rig.simulate.subframes import film
from lce_rig.simulate.takes import MovingBoard
from lce_rig.simulate.trajectory import Trajectory, carry_board

_START_NS = 1_700_000_000_000_000_000
_PACKET_NS = 20_000_000
_TRACK_EVERY_NS = 10_000_000


@dataclass(frozen=True, eq=False)
class SimulatedRecording:
    """A recording with its truth; iterating yields its samples in order of their timestamps.

    Attributes:
        stage: the rig's true geometry and the room.
        trajectory: where the board is in the world at any time of the rig's clock, the LiDAR's.
        start_ns, end_ns: on the rig's clock.
    """

    stage: Stage
    trajectory: Trajectory
    start_ns: int
    end_ns: int

    def __iter__(self) -> Iterator[Image | Scan | Events]:
        board = MovingBoard(self.stage, self.trajectory, (OF_SESSION, CARRIER))
        streams: list[Iterator[Image | Scan | Events]] = [
            *(self._pictures(board, camera) for camera in self.stage.framed),
            *(self._scans(board, lidar) for lidar in self.stage.models),
            *(self._packets(board, camera) for camera in self.stage.pixels),
        ]
        return merge(*streams, key=stamp_of)

    def T_sensor_board(self, sensor: str, t_ns: int | NDArray[np.int64]) -> Array:
        """Compute the board's true pose (..., 4, 4) before a camera or LiDAR at times of the rig's clock.

        Timestamps of images and events read `frame_offset_s` or `event_offset_s` more than that clock.
        """
        return np.asarray(invert(self.stage.T_world_sensor[sensor]) @ self.trajectory.at(t_ns))

    def _pictures(self, board: MovingBoard, camera: str) -> Iterator[Image]:
        every_ns = round(1e9 * self.stage.options.frame_every_s)
        for k, t_ns in enumerate(range(self.start_ns + every_ns // 2, self.end_ns, every_ns)):
            yield board.take_image(camera, t_ns, (OF_SESSION, k))

    def _scans(self, board: MovingBoard, lidar: str) -> Iterator[Scan]:
        period_ns = self.stage.models[lidar].period_ns
        for k, t_ns in enumerate(range(self.start_ns, self.end_ns - period_ns + 1, period_ns)):
            yield board.take_scan(lidar, t_ns, (OF_SESSION, k))

    def _packets(self, board: MovingBoard, camera: str) -> Iterator[Events]:
        view = board.view(camera)
        sensor = board.event_camera(camera, view, self.start_ns, (OF_SESSION,))
        for t_ns in range(self.start_ns, self.end_ns, _PACKET_NS):
            film(view, sensor, t_ns, min(t_ns + _PACKET_NS, self.end_ns))
            packet = sensor.take()
            if len(packet):
                yield packet


def stamp_of(sample: Image | Scan | Events) -> int:
    """Read a sample's timestamp; a packet of events has that of its first one."""
    return int(sample.t_ns[0]) if isinstance(sample, Events) else int(sample.stamp_ns or 0)


def simulate_recording(
    rig: Rig, *, duration_s: float, seed: int, options: SimulationOptions | None = None
) -> SimulatedRecording:
    """Set up a recording; iterating over it simulates it, and gives the same bytes each time.

    The board passes the placements that `simulate_captures` of this seed would show, from one to the next.

    Args:
        rig: the profile.
        duration_s: of the recording.
        seed: of truth, room, placements and noise.
        options: `SimulationOptions.for_rig` of the rig by default; the board always moves.

    Raises:
        ProfileError: a LiDAR's model is unknown, or no camera has a channel that can be simulated.
        LceRigError: no place for the board is seen by the camera and the LiDAR.
    """
    options = replace(options or SimulationOptions.for_rig(rig.name), motion="moving")
    stage = set_stage(rig, seed, options)
    end_ns = _START_NS + round(1e9 * duration_s)
    placements: list[Array] = []
    while True:
        placements.append(stage.place(len(placements), stage.rng(len(placements), PLACEMENT)))
        trajectory = carry_board(placements, _START_NS, options.hand, stage.rng(OF_SESSION, HAND))
        if trajectory.departure_ns[-1] >= end_ns:
            return SimulatedRecording(stage, trajectory, _START_NS, end_ns)


def recording_truth(recording: SimulatedRecording) -> dict[str, Any]:
    """Return where the board is before the first LiDAR, 100 times per second.

    Returns:
        `boards`: by LiDAR `t_ns` (K), on the rig's clock, and `T_sensor_board` (K, 4, 4).
    """
    lidar = next(iter(recording.stage.rig.lidars))
    t_ns = np.arange(recording.start_ns, recording.end_ns + _TRACK_EVERY_NS, _TRACK_EVERY_NS)
    track = {"t_ns": t_ns.tolist(), "T_sensor_board": recording.T_sensor_board(lidar, t_ns).tolist()}
    return {"boards": {lidar: track}}
