"""The constants of a simulated session: the room, the sensors' true poses and errors."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, Literal

import numpy as np

from lce_rig.core.board import Board
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Scan
from lce_rig.core.data_sheets import DATA_SHEETS, DataSheet
from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import T_BODY_OPTICAL, Array, invert, perturb, pose
from lce_rig.rig import Rig
from lce_rig.simulate.backdrop import Backdrop, build_backdrop
from lce_rig.simulate.event_camera import EventPixels, draw_pixels
from lce_rig.simulate.lidar import LidarModel, Sweep, measure_sweep
from lce_rig.simulate.options import LidarNoise, SimulationOptions
from lce_rig.simulate.placements import CameraView, place_board
from lce_rig.simulate.room import LIDAR_HEIGHT_M, Room, build_room

# Independent streams of random numbers, so that more captures or another camera change nothing else.
# Streams of a session are [seed, OF_SESSION, stream, ...], those of a capture [seed, index, stream, ...].
OF_SESSION = 1_000_000_007
TRUTH, ROOM, LASERS, START, PLACEMENT, SCAN, IMAGE, PIXELS, HAND, CARRIER, PHASE, EVENTS = range(12)
# T_cam_lidar of a camera without nominal extrinsics: 8 cm above and in front of the LiDAR, facing forward.
_FORWARD = pose(T_BODY_OPTICAL[:3, :3].T, np.array([0.0, -0.08, -0.08]))
# View, ahead of its first LiDAR, in which boards of a rig without cameras are placed.
_WINDOW = Intrinsics(600.0, 600.0, 640.0, 360.0, 1280, 720)


@dataclass(frozen=True, eq=False)
class Stage:
    """The constants of a session.

    Attributes:
        rig: the profile.
        seed: random seed of the session.
        options: content and errors of the session.
        board: the profile's board.
        room: the static objects around them.
        T_world_sensor: (4, 4) of each camera and LiDAR.
        backdrops: each simulated camera's image of the room.
        models: models of each LiDAR.
        noise: the sensor's errors.
        laser_bias_m: (L,) range offset of each laser of each LiDAR.
        pixels: event pixels of each camera with a channel of events.
        views: pairs of sensors that the board is placed for in turn.
    """

    rig: Rig
    seed: int
    options: SimulationOptions
    board: Board
    room: Room
    T_world_sensor: Mapping[str, Array]
    backdrops: Mapping[str, Backdrop]
    models: Mapping[str, LidarModel]
    noise: Mapping[str, LidarNoise]
    laser_bias_m: Mapping[str, Array]
    pixels: Mapping[str, EventPixels]
    views: list[CameraView]

    @property
    def framed(self) -> list[str]:
        """The cameras that take images, in the profile's order."""
        return [name for name in self.backdrops if self.rig.cameras[name].first_channel("frames")]

    def rng(self, *stream: int) -> np.random.Generator:
        """Start a stream of random numbers of this session or of one of its captures."""
        return np.random.default_rng([self.seed, *stream])

    def measure(self, lidar: str, sweep: Sweep, rng: np.random.Generator, stamp_ns: int) -> Scan:
        """Measure the hits of a LiDAR's beams, with its own errors."""
        settings, noise = self.rig.lidars[lidar], self.noise[lidar]
        return measure_sweep(
            sweep,
            self.models[lidar],
            replace(noise, range_offset_m=noise.range_offset_m + settings.range_offset_m),
            rng,
            laser_bias_m=self.laser_bias_m[lidar],
            sensor=lidar,
            stamp_ns=stamp_ns,
            min_range_m=settings.min_range_m,
            max_range_m=settings.max_range_m,
        )

    def place(self, index: int, rng: np.random.Generator) -> Array:
        """Choose T_world_board (4, 4) of a placement.

        Raises:
            LceRigError: no place is seen by the camera and the LiDAR whose turn it is.
        """
        view = self.views[index % len(self.views)]
        start = self.rng(OF_SESSION, START).random(3)
        return place_board(view, self.board, self.room, self.options, index // len(self.views), rng, start)


def truth_extrinsics(
    rig: Rig, seed: int, options: SimulationOptions | None = None
) -> dict[tuple[str, str], Array]:
    """Draw the true T_cam_lidar (4, 4) of every camera and LiDAR, and of every two LiDARs.

    The nominal extrinsics of the profile, each moved by a seeded few degrees and centimetres, so that a
    solver cannot pass by returning the nominal ones. Pairs without an entry follow from the others; a camera
    without any looks along the first LiDAR's x axis.

    Args:
        rig: the profile.
        seed: random seed of the session.
        options: `SimulationOptions.for_rig` of the rig by default.
    """
    options = options or SimulationOptions.for_rig(rig.name)
    T_base_sensor = _sensor_poses(rig, seed, options)
    return {
        (first, second): invert(T_base_sensor[first]) @ T_base_sensor[second]
        for first, second in [*product(rig.cameras, rig.lidars), *combinations(rig.lidars, 2)]
    }


def set_stage(
    rig: Rig, seed: int, options: SimulationOptions | None = None, *, is_draft: bool = False
) -> Stage:
    """Draw the truth of a session and render the room once for all its captures.

    Args:
        rig: the profile.
        seed: random seed of the session.
        options: `SimulationOptions.for_rig` of the rig by default.
        is_draft: whether to render the room at half the resolution, in a sixth of the time.

    Raises:
        ProfileError: a LiDAR's model is unknown, or no camera has a channel that can be simulated.
    """
    options = options or SimulationOptions.for_rig(rig.name)
    T_world_base = pose(np.eye(3), np.array([0.0, 0.0, LIDAR_HEIGHT_M]))
    T_world_sensor = {name: T_world_base @ T for name, T in _sensor_poses(rig, seed, options).items()}
    kinds: tuple[Literal["frames", "events"], ...] = ("frames",)
    if options.motion == "moving":
        kinds = ("frames", "events")
    cameras = [name for name, camera in rig.cameras.items() if any(map(camera.first_channel, kinds))]
    if rig.cameras and not cameras:
        hint = "Only frames can be simulated for a board held still: events need motion."
        raise ProfileError(f"rig {rig.name}: no camera has a channel of kind {' or '.join(kinds)}", hint)
    lenses = {name: rig.cameras[name].to_intrinsics() for name in cameras}
    eyes = [(name, lenses[name], T_world_sensor[name]) for name in cameras]
    if not eyes:
        first = next(iter(rig.lidars))
        eyes = [(first, _WINDOW, T_world_sensor[first] @ invert(_FORWARD))]
    sight = eyes[0][2][:3, 2]
    room = build_room(
        float(np.arctan2(sight[1], sight[0])),
        np.random.default_rng([seed, OF_SESSION, ROOM]),
        options.decoys,
    )
    sheets: dict[str, DataSheet] = {}
    for name, settings in rig.lidars.items():
        sheet = settings.data_sheet()
        if sheet is None:
            hint = f"Known: {', '.join(s.name for s in DATA_SHEETS)}. For others, set elevations_deg."
            raise ProfileError(f"lidars.{name}.model: {settings.model} cannot be simulated", hint)
        sheets[name] = sheet
    models = {name: LidarModel.of(sheet, rig.lidars[name].rate_hz) for name, sheet in sheets.items()}
    noise = {name: options.lidar or LidarNoise.of(sheet) for name, sheet in sheets.items()}
    mounted = options.mounting_of(seed)
    bias = {}
    for k, (name, model) in enumerate(models.items()):
        drawn = np.random.default_rng([mounted, OF_SESSION, LASERS, k]).standard_normal(len(model.starts_ns))
        bias_m = noise[name].laser_sigma_m * drawn
        # The mean of all lasers is `LidarNoise.range_offset_m` and nothing else.
        bias[name] = np.asarray(bias_m - bias_m.mean())
    pixels = {
        name: draw_pixels(
            lenses[name], options.events, np.random.default_rng([mounted, OF_SESSION, PIXELS, k])
        )
        for k, name in enumerate(cameras)
        if options.motion == "moving" and rig.cameras[name].first_channel("events")
    }
    views = [
        CameraView(*eye, lidar, models[lidar], T_world_sensor[lidar]) for eye in eyes for lidar in rig.lidars
    ]
    backdrops = {
        name: build_backdrop(room, T_world_sensor[name], lenses[name], is_draft=is_draft) for name in cameras
    }
    board = rig.board.to_board()
    return Stage(
        rig, seed, options, board, room, T_world_sensor, backdrops, models, noise, bias, pixels, views
    )


def require_lidar(rig: Rig) -> None:
    """Check that a rig can be simulated.

    Raises:
        ProfileError: the rig has no LiDAR.
    """
    if not rig.lidars:
        raise ProfileError(
            f"rig {rig.name}: without a LiDAR it cannot be simulated",
            "Simulate its cameras beside a LiDAR, as in the rig two_cameras.",
        )


def _sensor_poses(rig: Rig, seed: int, options: SimulationOptions) -> dict[str, Array]:
    """Chain the perturbed nominal extrinsics into T_base_sensor, the base being the first LiDAR.

    Raises:
        ProfileError: the rig has no LiDAR.
    """
    require_lidar(rig)
    links: list[tuple[str, str, Array]] = []
    for index, entry in enumerate(rig.nominal_extrinsics):
        rng = np.random.default_rng([options.mounting_of(seed), OF_SESSION, TRUTH, index])
        angle_deg = min(options.truth_rotation_deg, 0.8 * entry.tolerance_deg) * rng.uniform(0.4, 1.0)
        shift_m = min(options.truth_translation_m, 0.8 * entry.tolerance_m) * rng.uniform(0.4, 1.0)
        axes = rng.standard_normal((2, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        tangent = np.concatenate([shift_m * axes[0], np.radians(angle_deg) * axes[1]])
        links.append((entry.camera, entry.lidar, perturb(entry.to_matrix(), tangent)))
    base = next(iter(rig.lidars))
    T_base: dict[str, Array] = {base: np.eye(4)}
    for _ in range(len(links)):
        for camera, lidar, T_cam_lidar in links:
            if lidar in T_base and camera not in T_base:
                T_base[camera] = T_base[lidar] @ invert(T_cam_lidar)
            elif camera in T_base and lidar not in T_base:
                T_base[lidar] = T_base[camera] @ T_cam_lidar
    for name in rig.cameras:
        T_base.setdefault(name, invert(_FORWARD))
    for name in rig.lidars:
        T_base.setdefault(name, np.eye(4))
    return T_base


def rig_truth(rig: Rig, seed: int, options: SimulationOptions) -> dict[str, Any]:
    """Return the extrinsics and clocks of a simulated rig.

    Returns:
        `pairs` of camera, or another LiDAR, and lidar with T_cam_lidar (p_cam = T p_lidar), the first pair's
        alone, and the excess of the timestamps of images and events over the rig's clock, which is the
        LiDAR's.
    """
    pairs = [
        {"camera": camera, "lidar": lidar, "T_cam_lidar": T.tolist()}
        for (camera, lidar), T in sorted(
            truth_extrinsics(rig, seed, options).items(), key=lambda pair: (pair[0][0] in rig.lidars, pair[0])
        )
    ]
    return {
        "seed": seed,
        "mounting_seed": options.mounting_of(seed),
        "T_cam_lidar": pairs[0]["T_cam_lidar"],
        "pairs": pairs,
        "motion": options.motion,
        "frame_offset_s": options.frame_offset_s,
        "event_offset_s": options.event_offset_s,
    }
