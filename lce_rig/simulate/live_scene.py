"""A board before the simulated sensors, now held and now on its way, whenever somebody looks."""

from collections.abc import Iterator

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, exp_so3, log_so3, pose
from lce_rig.rig import Rig
from lce_rig.simulate.camera import expose, render_radiance
from lce_rig.simulate.carriers import build_carrier
from lce_rig.simulate.lidar import Sweep, measure_sweep, sweep_scene
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import can_be_held, count_rings
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import CARRIER, OF_SESSION, set_stage

_NOISE_STREAM = 102


class LiveScene:
    """Takes pictures and scans of a board that somebody moves.

    What is still is rendered once; each picture and scan has its own noise. The beams of a board that is held
    keep their phase from scan to scan.

    Attributes:
        stage: the simulated rig and its room.
        T_world_board: (4, 4) where the board is.
    """

    def __init__(self, rig: Rig, seed: int, options: SimulationOptions) -> None:
        """Draw the truth and render the room.

        Raises:
            ProfileError: a LiDAR's model is unknown, or no camera can be simulated.
        """
        self.stage = set_stage(rig, seed, options)
        self.T_world_board: Array = np.eye(4)
        self._noise = self.stage.rng(OF_SESSION, _NOISE_STREAM)
        self._scene: Scene | None = None
        self._radiance: dict[str, Array] = {}
        self._sweeps: dict[str, Sweep] = {}

    def hold(self, T_world_board: Array) -> None:
        """Hold the board still at (4, 4)."""
        self.T_world_board = T_world_board
        self._scene = None
        self._radiance.clear()
        self._sweeps.clear()

    def pass_by(self, start: Array, end: Array, share: float) -> None:
        """Put the board on its way between two poses (4, 4)."""
        turn = log_so3(start[:3, :3].T @ end[:3, :3])
        place = (1 - share) * start[:3, 3] + share * end[:3, 3]
        self.hold(pose(start[:3, :3] @ exp_so3(share * turn), place))

    def can_be_held(self, camera: str, T_world_board: Array) -> bool:
        """Tell whether nothing is in the way at a pose (4, 4), and enough rings of the LiDAR meet it."""
        view = next(view for view in self.stage.views if view.camera == camera)
        stage = self.stage
        is_free = can_be_held(view, stage.board, stage.room, T_world_board)
        return is_free and count_rings(view, stage.board, T_world_board) >= stage.rig.quality.min_rings

    def take(self, stamp_ns: int) -> Iterator[Image | Scan]:
        """Take a scan of each LiDAR that begins at a time, and a picture of each camera at its middle."""
        stage = self.stage
        period_ns = max(model.period_ns for model in stage.models.values())
        for camera in stage.framed:
            yield self._take_image(camera, stamp_ns + period_ns // 2)
        for lidar in stage.models:
            yield self._take_scan(lidar, stamp_ns)

    def _take_image(self, camera: str, stamp_ns: int) -> Image:
        stage = self.stage
        if camera not in self._radiance:
            self._radiance[camera] = render_radiance(self._render(), stage.backdrops[camera])
        pixels = expose(self._radiance[camera], stage.options.camera, self._noise)
        channel = stage.rig.cameras[camera].first_channel("frames") or "frames"
        return Image(camera, channel, stamp_ns, pixels, stamp_ns)

    def _take_scan(self, lidar: str, stamp_ns: int) -> Scan:
        stage, settings = self.stage, self.stage.rig.lidars[lidar]
        model, noise = stage.models[lidar], stage.options.lidar_noise
        if lidar not in self._sweeps:
            T_world_lidar = stage.T_world_sensor[lidar]
            self._sweeps[lidar] = sweep_scene(self._render(), T_world_lidar, model, noise, self._noise)
        return measure_sweep(
            self._sweeps[lidar],
            model,
            noise,
            self._noise,
            laser_bias_m=stage.laser_bias_m[lidar],
            sensor=lidar,
            stamp_ns=stamp_ns,
            min_range_m=settings.min_range_m,
            max_range_m=settings.max_range_m,
        )

    def _render(self) -> Scene:
        if self._scene is None:
            stage, options = self.stage, self.stage.options
            rng = stage.rng(OF_SESSION, CARRIER)
            carrier = build_carrier(options.carrier, stage.board, self.T_world_board, rng)
            raycaster, reflectivity = stage.room.raycaster, options.print_reflectivity
            self._scene = Scene(raycaster, carrier, stage.board, self.T_world_board, reflectivity)
        return self._scene
