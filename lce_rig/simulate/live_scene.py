"""A board in front of the simulated sensors, still or moving, at any time."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array
from lce_rig.rig import Rig
from lce_rig.simulate.image_rendering import expose, render_radiance
from lce_rig.simulate.lidar import Sweep, sweep_scene
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import between, hold_board
from lce_rig.simulate.sampling import StagedBoard
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import CARRIER, OF_SESSION, set_stage

_NOISE_STREAM = 102


class LiveScene:
    """Renders images and scans of a moving board.

    For a held board, images are rendered and beams are traced once; each image and scan has its own
    noise. While it moves and is not captured, both are drafts: images without shadows and anti-aliasing,
    infinitely thin beams. The room is always a draft, so that a collection starts sooner.

    Attributes:
        stage: the simulated rig and its room.
        T_world_board: (4, 4) present pose of the board.
    """

    def __init__(self, rig: Rig, seed: int, options: SimulationOptions) -> None:
        """Draw the truth and render the room.

        Raises:
            ProfileError: a LiDAR's model is unknown, or no camera can be simulated.
        """
        self.stage = set_stage(rig, seed, options, is_draft=True)
        self._noise = self.stage.rng(OF_SESSION, _NOISE_STREAM)
        self._show(np.eye(4), is_held=True)

    def hold(self, T_world_board: Array) -> None:
        """Hold the board still at (4, 4)."""
        self._show(T_world_board, is_held=True)

    def pass_by(self, start: Array, end: Array, share: float) -> None:
        """Move the board between two poses (4, 4)."""
        self._show(between(start, end, share), is_held=False)

    def can_be_held(self, camera: str, T_world_board: Array) -> bool:
        """Check whether a pose (4, 4) is free of obstacles, and enough rings of the LiDAR hit the board."""
        view = next(view for view in self.stage.views if view.camera == camera)
        stage = self.stage
        is_free = view.can_be_held(stage.board, stage.room, T_world_board)
        return is_free and view.count_rings(stage.board, T_world_board) >= stage.rig.quality.min_rings

    def take(self, stamp_ns: int) -> Iterator[Image | Scan]:
        """Take a scan of each LiDAR that starts at a time, and an image of each camera at mid-scan."""
        period_ns = max(model.period_ns for model in self.stage.models.values())
        yield from self.take_images(stamp_ns + period_ns // 2)
        yield from self.take_scans(stamp_ns)

    def take_images(self, stamp_ns: int) -> Iterator[Image]:
        """Take an image of each camera."""
        stage = self.stage
        for camera in stage.framed:
            if camera not in self._radiance:
                backdrop = stage.backdrops[camera]
                self._radiance[camera] = render_radiance(self._render(), backdrop, is_draft=not self._is_held)
            pixels = expose(self._radiance[camera], stage.options.camera, self._noise)
            channel = stage.rig.cameras[camera].first_channel("frames") or "frames"
            yield Image(camera, channel, stamp_ns, pixels, stamp_ns)

    def take_scans(self, stamp_ns: int) -> Iterator[Scan]:
        """Take a scan of each LiDAR that begins at a time."""
        stage = self.stage
        for lidar, model in stage.models.items():
            if lidar not in self._sweeps:
                noise = stage.noise[lidar]
                if not self._is_held:
                    noise = replace(
                        noise, divergence_rad=(0.0, 0.0), exit_size_m=(0.0, 0.0), edge_growth_m=0.0
                    )
                T_world_lidar = stage.T_world_sensor[lidar]
                self._sweeps[lidar] = sweep_scene(self._render(), T_world_lidar, model, noise, self._noise)
            yield stage.measure(lidar, self._sweeps[lidar], self._noise, stamp_ns)

    def _show(self, T_world_board: Array, *, is_held: bool) -> None:
        self.T_world_board, self._is_held = T_world_board, is_held
        self._scene: Scene | None = None
        self._radiance: dict[str, Array] = {}
        self._sweeps: dict[str, Sweep] = {}

    def _render(self) -> Scene:
        if self._scene is None:
            rng = self.stage.rng(OF_SESSION, CARRIER)
            self._scene = StagedBoard(self.stage, hold_board(self.T_world_board), rng).scene_at(0)
        return self._scene
