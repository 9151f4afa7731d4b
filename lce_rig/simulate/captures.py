"""A simulated session: the rig's true geometry, and captures of the board among its decoys."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import ProfileError
from lce_rig.core.geometry import Array, invert, perturb, pose
from lce_rig.rig import Rig
from lce_rig.simulate.backdrop import Backdrop, build_backdrop
from lce_rig.simulate.camera import render_image
from lce_rig.simulate.carriers import build_carrier
from lce_rig.simulate.lidar import VLP16, LidarModel, simulate_scan
from lce_rig.simulate.options import SimulationOptions
from lce_rig.simulate.placements import View, place_board
from lce_rig.simulate.room import Room, build_room
from lce_rig.simulate.scene import Scene

LIDAR_MODELS = {"vlp16": VLP16}

_FIRST_STAMP_NS = 1_700_000_000_000_000_000
_CAPTURE_EVERY_NS = 4_000_000_000
# Independent streams of random numbers, so that more captures or another camera change nothing else.
# Streams of a session are [seed, _OF_SESSION, stream, ...], those of a capture [seed, index, stream, ...].
_OF_SESSION = 1_000_000_007
_TRUTH, _ROOM, _LASERS, _START, _PLACEMENT, _SCAN, _IMAGE = range(7)
# Camera optical axes (x right, y down, z forward) from the LiDAR's (x forward, y left, z up).
_FORWARD = pose(
    np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.array([0.0, -0.08, -0.08])
)


@dataclass(frozen=True, eq=False)
class SimulatedCapture:
    """One capture with its truth.

    Attributes:
        index: of the capture in its session.
        images: one a camera that has a channel of frames, in the profile's order.
        scans: one a LiDAR, in the profile's order.
        T_lidar_board: true (4, 4) by LiDAR.
        T_cam_board: true (4, 4) by camera.
        target: the camera and the LiDAR that the board was placed for; others may not see it.
    """

    index: int
    images: list[Image]
    scans: list[Scan]
    T_lidar_board: Mapping[str, Array]
    T_cam_board: Mapping[str, Array]
    target: tuple[str, str]


@dataclass(frozen=True, eq=False)
class _Stage:
    """What stays the same over a session."""

    room: Room
    T_world_sensor: Mapping[str, Array]
    backdrops: Mapping[str, Backdrop]
    models: Mapping[str, LidarModel]
    laser_bias_m: Mapping[str, Array]
    views: list[View]


def truth_extrinsics(
    rig: Rig, seed: int, options: SimulationOptions | None = None
) -> dict[tuple[str, str], Array]:
    """Draw the true T_cam_lidar (4, 4) of every camera and LiDAR.

    The nominal extrinsics of the profile, each moved by a seeded few degrees and centimetres, so that nobody
    can pass by handing back the nominal. Pairs without an entry follow from the others; a camera without any
    looks along the first LiDAR's x axis.

    Args:
        rig: the profile.
        seed: of the session.
        options: `SimulationOptions.for_rig` of the rig by default.
    """
    options = options or SimulationOptions.for_rig(rig.name)
    T_base_sensor = _sensor_poses(rig, seed, options)
    return {
        (camera, lidar): invert(T_base_sensor[camera]) @ T_base_sensor[lidar]
        for camera in rig.cameras
        for lidar in rig.lidars
    }


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
        ProfileError: a LiDAR's model is unknown, or no camera has a channel of frames.
        LceRigError: no place for the board is seen by the camera and the LiDAR.
    """
    options = options or SimulationOptions.for_rig(rig.name)
    stage = _set_stage(rig, seed, options)
    for index in range(n_captures):
        yield _capture(rig, stage, seed, options, index)


def _sensor_poses(rig: Rig, seed: int, options: SimulationOptions) -> dict[str, Array]:
    """Chain the perturbed nominal extrinsics into T_base_sensor, the base being the first LiDAR."""
    links: list[tuple[str, str, Array]] = []
    for index, entry in enumerate(rig.nominal_extrinsics):
        rng = np.random.default_rng([seed, _OF_SESSION, _TRUTH, index])
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


def _set_stage(rig: Rig, seed: int, options: SimulationOptions) -> _Stage:
    T_world_base = pose(np.eye(3), np.array([0.0, 0.0, options.lidar_height_m]))
    T_world_sensor = {name: T_world_base @ T for name, T in _sensor_poses(rig, seed, options).items()}
    cameras = [name for name in rig.cameras if _frames_channel(rig, name)]
    if not cameras:
        raise ProfileError(
            f"rig {rig.name}: no camera has a channel of kind frames", "Only frames can be simulated."
        )
    sight = T_world_sensor[cameras[0]][:3, 2]
    room = build_room(
        float(np.arctan2(sight[1], sight[0])),
        np.random.default_rng([seed, _OF_SESSION, _ROOM]),
        rig.board.to_board() if options.has_decoy_plate else None,
        options.lidar_height_m,
    )
    lenses = {name: rig.cameras[name].to_intrinsics() for name in cameras}
    models = {name: _lidar_model(rig, name) for name in rig.lidars}
    bias = {
        name: _laser_bias(models[name], np.random.default_rng([seed, _OF_SESSION, _LASERS, k]), options)
        for k, name in enumerate(rig.lidars)
    }
    views = [
        View(camera, lenses[camera], T_world_sensor[camera], lidar, models[lidar], T_world_sensor[lidar])
        for camera in cameras
        for lidar in rig.lidars
    ]
    backdrops = {name: build_backdrop(room, T_world_sensor[name], lenses[name]) for name in cameras}
    return _Stage(room, T_world_sensor, backdrops, models, bias, views)


def _frames_channel(rig: Rig, camera: str) -> str | None:
    channels = rig.cameras[camera].channels
    return next((name for name, channel in channels.items() if channel.kind == "frames"), None)


def _lidar_model(rig: Rig, lidar: str) -> LidarModel:
    given, rate_hz = rig.lidars[lidar].model, rig.lidars[lidar].rate_hz
    model = LIDAR_MODELS.get("".join(c for c in given.lower() if c.isalnum()))
    if model is None:
        known = ", ".join(m.name for m in LIDAR_MODELS.values())
        raise ProfileError(f"lidars.{lidar}.model: {given} cannot be simulated", f"Known models: {known}.")
    return replace(model, period_ns=round(1e9 / rate_hz))


def _laser_bias(model: LidarModel, rng: np.random.Generator, options: SimulationOptions) -> Array:
    """Draw each laser's offset; their mean is `LidarNoise.range_offset_m` and nothing else."""
    bias = options.lidar_noise.laser_sigma_m * rng.standard_normal(len(model.elevations_rad))
    return np.asarray(bias - bias.mean())


def _capture(rig: Rig, stage: _Stage, seed: int, options: SimulationOptions, index: int) -> SimulatedCapture:
    board = rig.board.to_board()
    rng = np.random.default_rng([seed, index, _PLACEMENT])
    view = stage.views[index % len(stage.views)]
    start = np.random.default_rng([seed, _OF_SESSION, _START]).random(3)
    T_world_board = place_board(view, board, stage.room, options, index // len(stage.views), rng, start)
    carrier = build_carrier(options.carrier, board, T_world_board, rng)
    scene = Scene(stage.room.raycaster, carrier, board, T_world_board, options.print_reflectivity)
    stamp_ns = _FIRST_STAMP_NS + index * _CAPTURE_EVERY_NS
    return SimulatedCapture(
        index,
        _take_images(
            rig, stage, scene, options, stamp_ns + stage.models[view.lidar].period_ns // 2, [seed, index]
        ),
        _take_scans(rig, stage, scene, options, stamp_ns, [seed, index]),
        {name: invert(stage.T_world_sensor[name]) @ T_world_board for name in rig.lidars},
        {name: invert(stage.T_world_sensor[name]) @ T_world_board for name in rig.cameras},
        (view.camera, view.lidar),
    )


def _take_scans(
    rig: Rig, stage: _Stage, scene: Scene, options: SimulationOptions, stamp_ns: int, seeds: list[int]
) -> list[Scan]:
    return [
        simulate_scan(
            scene,
            stage.T_world_sensor[name],
            stage.models[name],
            options.lidar_noise,
            np.random.default_rng([*seeds, _SCAN, k]),
            laser_bias_m=stage.laser_bias_m[name],
            sensor=name,
            stamp_ns=stamp_ns,
            min_range_m=settings.min_range_m,
            max_range_m=settings.max_range_m,
        )
        for k, (name, settings) in enumerate(rig.lidars.items())
    ]


def _take_images(
    rig: Rig, stage: _Stage, scene: Scene, options: SimulationOptions, stamp_ns: int, seeds: list[int]
) -> list[Image]:
    return [
        render_image(
            scene,
            backdrop,
            options.camera,
            np.random.default_rng([*seeds, _IMAGE, k]),
            sensor=name,
            channel=_frames_channel(rig, name) or "frames",
            stamp_ns=stamp_ns,
        )
        for k, (name, backdrop) in enumerate(stage.backdrops.items())
    ]
