"""One sample of one sensor, of a still or moving board."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array
from lce_rig.simulate.carriers import build_carrier
from lce_rig.simulate.event_camera import EventCamera
from lce_rig.simulate.image_rendering import expose, render_radiance
from lce_rig.simulate.lidar import sweep_scene
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import EVENTS, IMAGE, SCAN, Stage
from lce_rig.simulate.subframes import MovingView, speed_px_s
from lce_rig.simulate.trajectory import Trajectory

# While the shutter is open the board is drawn at moments that lie this far apart in the image at most.
_SMEAR_STEP_PX = 0.35
_MOST_MOMENTS = 15

Stream = tuple[int, ...]


def take_image(stage: Stage, camera: str, scene: Scene, exposed_ns: int, stream: Stream) -> Image:
    """Take an image of a scene that stands still, exposed about a time of the rig's clock."""
    return _develop(stage, camera, render_radiance(scene, stage.backdrops[camera]), exposed_ns, stream)


def take_scan(
    stage: Stage,
    lidar: str,
    scene: Scene,
    stamp_ns: int,
    stream: Stream,
    board_at: Callable[[NDArray[np.int64]], Array] | None = None,
) -> Scan:
    """Take a scan that begins at a time of the rig's clock; of a moving board where `board_at` is given."""
    rng = stage.rng(*_numbered(stream, SCAN, list(stage.models).index(lidar)))
    T_world_lidar, model = stage.T_world_sensor[lidar], stage.models[lidar]
    sweep = sweep_scene(scene, T_world_lidar, model, stage.noise[lidar], rng, stamp_ns, board_at)
    return stage.measure(lidar, sweep, rng, stamp_ns)


@dataclass(frozen=True, eq=False)
class MovingBoard:
    """A moving board and its carrier in front of the sensors of a stage.

    Attributes:
        stage: the session.
        trajectory: where the board is.
        carrier_stream: of random numbers that decide what its carrier looks like.
    """

    stage: Stage
    trajectory: Trajectory
    carrier_stream: Stream

    def scene_at(self, t_ns: int) -> Scene:
        """Build the scene at a time of the rig's clock."""
        T_world_board, stage = self.trajectory.at(t_ns), self.stage
        rng = stage.rng(*self.carrier_stream)
        carrier = build_carrier(stage.options.carrier, stage.board, T_world_board, rng)
        return Scene(
            stage.room.raycaster, carrier, stage.board, T_world_board, stage.options.print_reflectivity
        )

    def take_image(self, camera: str, exposed_ns: int, stream: Stream) -> Image:
        """Expose an image about a time of the rig's clock: the mean of what is seen while it lasts."""
        backdrop, options = self.stage.backdrops[camera], self.stage.options
        smear_px = options.exposure_s * speed_px_s(self.trajectory, self.stage.board, backdrop, exposed_ns)
        n_moments = int(np.clip(np.ceil(smear_px / _SMEAR_STEP_PX), 1, _MOST_MOMENTS))
        middles = (np.arange(n_moments) + 0.5) / n_moments - 0.5
        moments_ns = exposed_ns + np.rint(1e9 * options.exposure_s * middles).astype(np.int64)
        scene = self.scene_at(exposed_ns)
        scenes = [scene.with_board_at(T_world_board) for T_world_board in self.trajectory.at(moments_ns)]
        radiance = np.mean([render_radiance(moment, backdrop) for moment in scenes], axis=0)
        return _develop(self.stage, camera, radiance, exposed_ns, stream)

    def take_scan(self, lidar: str, stamp_ns: int, stream: Stream) -> Scan:
        """Take a scan whose every firing meets the board where it is by then.

        The carrier stays where it is when the rotor has made half its turn.
        """
        scene = self.scene_at(stamp_ns + self.stage.models[lidar].period_ns // 2)
        return take_scan(self.stage, lidar, scene, stamp_ns, stream, self.trajectory.at)

    def view(self, camera: str) -> MovingView:
        """Look at the board through a camera's lens."""
        options = self.stage.options
        return MovingView(
            self.stage.backdrops[camera],
            self.stage.board,
            self.trajectory,
            self.scene_at,
            options.camera,
            options.flicker_depth,
        )

    def event_camera(self, camera: str, view: MovingView, start_ns: int, stream: Stream) -> EventCamera:
        """Switch an event camera on at a time of the rig's clock."""
        stage = self.stage
        return EventCamera(
            stage.pixels[camera],
            stage.options.events,
            view.at(start_ns),
            start_ns,
            stage.rng(*_numbered(stream, EVENTS, list(stage.pixels).index(camera))),
            sensor=camera,
            offset_ns=round(1e9 * stage.options.event_offset_s),
        )


def _develop(stage: Stage, camera: str, radiance: Array, exposed_ns: int, stream: Stream) -> Image:
    rng = stage.rng(*_numbered(stream, IMAGE, list(stage.backdrops).index(camera)))
    stamp_ns = exposed_ns + round(1e9 * stage.options.frame_offset_s)
    channel = stage.rig.cameras[camera].first_channel("frames") or "frames"
    return Image(camera, channel, stamp_ns, expose(radiance, stage.options.camera, rng), stamp_ns)


def _numbered(stream: Stream, kind: int, sensor: int) -> Stream:
    """Name the stream of one sensor: (session or capture, kind, sensor, what else there is)."""
    return (stream[0], kind, sensor, *stream[1:])
