"""A board in front of the simulated sensors, still or moving, at any time."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, pose
from lce_rig.rig import Rig
from lce_rig.simulate.image_rendering import develop, focus, glance, render_radiance, shot_noise_e
from lce_rig.simulate.lidar import Sweep, sweep_again, sweep_scene
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import between, hold_board
from lce_rig.simulate.sampling import StagedBoard
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import CARRIER, OF_SESSION, set_stage

_NOISE_STREAM = 102
# A place that no beam reaches.
_NOWHERE = pose(np.eye(3), np.array([0.0, 0.0, -1e6]))
# Noise is drawn once, this much larger than the image, and cut out elsewhere for every image.
_SPARE_PX = 128
# Scans of the standing room, each of a beam phase of its own, which take turns.
_PHASES = 5


class LiveScene:
    """Renders images and scans of a moving board.

    What is still is rendered once; each image and scan has its own noise. The beams of a board that is held
    keep their phase from scan to scan. On its way only the board is rendered, coarsely, into an image of the
    room that stays as it is: nothing is captured there.

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
        self._is_held = True
        self._scene: Scene | None = None
        self._light: dict[str, NDArray[np.float32]] = {}
        self._sweeps: dict[str, Sweep] = {}
        self._rooms: dict[str, list[Sweep]] = {}
        self._phase = 0
        self._normals: dict[str, NDArray[np.float32]] = {}
        self._empty: dict[str, NDArray[np.uint8]] = {}

    def hold(self, T_world_board: Array) -> None:
        """Hold the board still at (4, 4)."""
        self._show(T_world_board, is_held=True)
        # The rotor is not synchronised with anything: the beam phase differs from place to place.
        self._phase = (self._phase + 1) % _PHASES

    def pass_by(self, start: Array, end: Array, share: float) -> None:
        """Move the board between two poses (4, 4)."""
        self._show(between(start, end, share), is_held=False)

    def can_be_held(self, camera: str, T_world_board: Array) -> bool:
        """Return whether a pose (4, 4) is free of obstacles, and enough rings of the LiDAR hit the board."""
        view = next(view for view in self.stage.views if view.camera == camera)
        stage = self.stage
        is_free = view.can_be_held(stage.board, stage.room, T_world_board)
        return is_free and view.count_rings(stage.board, T_world_board) >= stage.rig.quality.min_rings

    def take(self, stamp_ns: int) -> Iterator[Image | Scan]:
        """Take a scan of each LiDAR that begins at a time, and an image of each camera at its middle."""
        period_ns = max(model.period_ns for model in self.stage.models.values())
        yield from self.take_images(stamp_ns + period_ns // 2)
        yield from self.take_scans(stamp_ns)

    def take_images(self, stamp_ns: int) -> Iterator[Image]:
        """Take an image of each camera."""
        stage, noise = self.stage, self.stage.options.camera
        for camera in stage.framed:
            backdrop = stage.backdrops[camera]
            if self._is_held:
                if camera not in self._light:
                    self._light[camera] = focus(render_radiance(self._render(), backdrop), noise)
                pixels = develop(self._with_noise(camera, self._light[camera]))
            else:
                if camera not in self._empty:
                    self._empty[camera] = develop(self._with_noise(camera, focus(backdrop.radiance, noise)))
                pixels = np.array(self._empty[camera])
                part, linear = glance(self._render(), backdrop, noise)
                pixels[part] = develop(self._with_noise(camera, linear))
            channel = stage.rig.cameras[camera].first_channel("frames") or "frames"
            yield Image(camera, channel, stamp_ns, pixels, stamp_ns)

    def take_scans(self, stamp_ns: int) -> Iterator[Scan]:
        """Take a scan of each LiDAR that begins at a time."""
        stage = self.stage
        for lidar, model in stage.models.items():
            noise, T_world_lidar = stage.noise[lidar], stage.T_world_sensor[lidar]
            if lidar not in self._sweeps:
                rooms = self._rooms.setdefault(lidar, [])
                if len(rooms) <= self._phase:
                    empty = Scene(stage.room.raycaster, (), stage.board, _NOWHERE)
                    rooms.append(sweep_scene(empty, T_world_lidar, model, noise, self._noise))
                room = rooms[min(self._phase, len(rooms) - 1)]
                self._sweeps[lidar] = sweep_again(room, self._render(), T_world_lidar, model, noise)
            yield stage.measure(lidar, self._sweeps[lidar], self._noise, stamp_ns)

    def _show(self, T_world_board: Array, *, is_held: bool) -> None:
        self.T_world_board, self._is_held = T_world_board, is_held
        self._scene = None
        self._light.clear()
        self._sweeps.clear()

    def _with_noise(self, camera: str, linear: NDArray[np.float32]) -> NDArray[np.float32]:
        """Add noise to light (h, w, 3): a piece of a field that is drawn once, cut out at a random place."""
        noise = self.stage.options.camera
        if not np.isfinite(noise.full_well_e):
            return linear
        if camera not in self._normals:
            height, width = self.stage.backdrops[camera].range_m.shape
            shape = height + _SPARE_PX, width + _SPARE_PX, 3
            self._normals[camera] = self._noise.standard_normal(shape, dtype=np.float32)
        height, width = linear.shape[:2]
        v, u = self._noise.integers(_SPARE_PX, size=2)
        sigma = shot_noise_e(linear, noise) / np.float32(noise.full_well_e)
        return np.asarray(self._normals[camera][v : v + height, u : u + width] * sigma + linear)

    def _render(self) -> Scene:
        if self._scene is None:
            rng = self.stage.rng(OF_SESSION, CARRIER)
            self._scene = StagedBoard(self.stage, hold_board(self.T_world_board), rng).scene_at(0)
        return self._scene
