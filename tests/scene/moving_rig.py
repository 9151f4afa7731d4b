"""A rig that drives through the simulated room at constant velocity: scans, images and events with truth."""

from dataclasses import dataclass

import numpy as np

from lce_rig.core.data import Image
from lce_rig.core.geometry import Array, exp_so3, invert, pose
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.backdrop import build_backdrop
from lce_rig.simulate.event_camera import EventCamera, draw_pixels
from lce_rig.simulate.image_rendering import expose
from lce_rig.simulate.lidar import sweep_scene
from lce_rig.simulate.scene import Scene
from lce_rig.simulate.stage import Stage, set_stage

NOWHERE = pose(np.eye(3), np.array([0.0, 0.0, -1e6]))
START_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True, eq=False)
class MovingRig:
    """Drives with a velocity (3,) m/s, and turns at a rate (3,) rad/s."""

    stage: Stage
    velocity_mps: Array
    rate_rad_s: Array
    T_world_start: Array

    @classmethod
    def build(cls, rig, seed, velocity_mps, rate_rad_s, at=(0.0, 0.0)):
        stage = set_stage(rig, seed, SimulationOptions.for_rig(rig.name))
        start = pose(np.eye(3), np.array([*at, 0.0]))
        rates = (np.array(each, dtype=np.float64) for each in (velocity_mps, rate_rad_s))
        return cls(stage, *rates, start)

    def base_at(self, t_ns):
        """Pose of the rig relative to its pose in the stage, (..., 4, 4)."""
        t_s = 1e-9 * (np.asarray(t_ns, dtype=np.float64) - START_NS)[..., None]
        turn = exp_so3(t_s * self.rate_rad_s)
        return self.T_world_start @ pose(turn, t_s * self.velocity_mps)

    def sensor_at(self, sensor, t_ns):
        return self.base_at(t_ns) @ self.stage.T_world_sensor[sensor]

    def scan(self, lidar, stamp_ns, seed):
        stage, rng = self.stage, np.random.default_rng([seed, 1])
        empty = Scene(stage.room.raycaster, (), stage.board, NOWHERE)
        sweep = sweep_scene(
            empty,
            np.eye(4),
            stage.models[lidar],
            stage.noise["lidar"],
            rng,
            stamp_ns,
            lidar_at=lambda t_ns: self.sensor_at(lidar, t_ns),
        )
        return stage.measure(lidar, sweep, rng, stamp_ns)

    def radiance(self, camera, t_ns):
        lens = self.stage.rig.cameras[camera].to_intrinsics()
        return build_backdrop(self.stage.room, self.sensor_at(camera, t_ns), lens).radiance

    def image(self, camera, stamp_ns, seed):
        rng = np.random.default_rng([seed, 2])
        pixels = expose(self.radiance(camera, stamp_ns), self.stage.options.camera, rng)
        return Image(camera, "frames", stamp_ns, pixels, stamp_ns)

    def events(self, camera, start_ns, end_ns, seed, n_steps=8):
        lens, noise = self.stage.rig.cameras[camera].to_intrinsics(), self.stage.options.events
        rng = np.random.default_rng([seed, 3])
        times = np.linspace(start_ns, end_ns, n_steps + 1).astype(np.int64)
        seen = [self.radiance(camera, int(t)).mean(axis=-1).astype(np.float32) for t in times]
        sensor = EventCamera(draw_pixels(lens, noise, rng), noise, seen[0], start_ns, rng, sensor=camera)
        for light, t_ns in zip(seen[1:], times[1:], strict=True):
            sensor.see(light, int(t_ns))
        return sensor.take()

    def truth(self, camera, lidar):
        return invert(self.stage.T_world_sensor[camera]) @ self.stage.T_world_sensor[lidar]
