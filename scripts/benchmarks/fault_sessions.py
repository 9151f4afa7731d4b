"""Simulated sessions for the study of faults: what the LiDAR's detector saw, kept in a folder.

Pictures are not rendered, which would take most of the time, and would be too good: corners of rendered
boards lie within 0.01 px of the truth. They are drawn from the true poses instead, with the errors that
recordings show (`fault_kinds`); every fault of a camera is then an exact change of pose, lens or board.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.kept import kept_folder
from benchmarks.still_sessions import scan_held_board, with_small_pictures
from lce_rig.core.geometry import Array, exp_so3, invert, pose
from lce_rig.detect.detection import LidarDetection, from_arrays, to_arrays
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulationOptions
from lce_rig.simulate.poses import can_be_held, count_rings, seen_share
from lce_rig.simulate.stage import PLACEMENT, Stage, set_stage, truth_extrinsics

N_CAPTURES, N_PARALLEL = 15, 12
# Plates as a profile may have them wrong: what is added to the true width and height, m.
WRONG_PLATES_M = {
    "width 10 mm too large": (0.01, 0.0),
    "width 25 mm too large": (0.025, 0.0),
    "both 25 mm too small": (-0.025, -0.025),
}
# A further stream of random numbers; the simulation itself uses the lower ones.
_PARALLEL = 90
_N_PLACES = 4000


def rig_with_drawing(name: str) -> Rig:
    """Load a shipped profile as of a user who has a CAD model: it holds the nominal extrinsics."""
    rig = load_rig(name)
    drawn = tuple(entry.model_copy(update={"source": "cad"}) for entry in rig.nominal_extrinsics)
    return rig.model_copy(update={"nominal_extrinsics": drawn})


@dataclass(frozen=True, eq=False)
class SimulatedScans:
    """What the LiDAR saw in one session.

    Attributes:
        seed: of the session.
        T_cam_lidar: (4, 4) the truth.
        T_cam_board: true (4, 4) by capture.
        scans: the board in each scan, by capture.
        resized: the same with the plate's size wrong in the profile, by kind of error.
        parallel_poses: true T_cam_board of a board whose normal hardly changes, by capture.
        parallel_scans: what the LiDAR saw of that.
    """

    seed: int
    T_cam_lidar: Array
    T_cam_board: dict[str, Array]
    scans: dict[str, LidarDetection]
    resized: dict[str, dict[str, LidarDetection]]
    parallel_poses: dict[str, Array]
    parallel_scans: dict[str, LidarDetection]


def simulated_scans(rig: Rig, seed: int, folder: Path) -> SimulatedScans:
    """Read a session from where it is kept, or simulate it and keep it."""
    path = kept_folder(folder, rig) / f"{seed:04d}.npz"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(".part.npz")
        np.savez_compressed(unfinished, **_flatten(_simulate(rig, seed)))
        unfinished.rename(path)
    with np.load(path) as arrays:
        return _restore(seed, dict(arrays))


def with_plate(rig: Rig, added_m: tuple[float, float]) -> Rig:
    """Give the profile's plate another width and height."""
    size = {"width_m": rig.board.width_m + added_m[0], "height_m": rig.board.height_m + added_m[1]}
    return rig.model_copy(update={"board": rig.board.model_copy(update=size)})


def _simulate(rig: Rig, seed: int) -> SimulatedScans:
    options = SimulationOptions.for_rig(rig.name)
    stage = set_stage(with_small_pictures(rig), seed, options)
    truth = truth_extrinsics(rig, seed, options)[next(iter(rig.cameras)), next(iter(rig.lidars))]
    poses: dict[str, Array] = {}
    scans: dict[str, LidarDetection] = {}
    resized: dict[str, dict[str, LidarDetection]] = {kind: {} for kind in WRONG_PLATES_M}
    for index in range(N_CAPTURES):
        name = f"{index:06d}"
        rng = stage.rng(index, PLACEMENT)
        T_world_board = stage.place(index, rng)
        scan = scan_held_board(stage, T_world_board, rng, index)
        poses[name] = invert(stage.views[0].T_world_cam) @ T_world_board
        scans[name] = BoardFinder(rig).scan(scan)
        for kind, added_m in WRONG_PLATES_M.items():
            resized[kind][name] = BoardFinder(with_plate(rig, added_m)).scan(scan)
    parallel_poses: dict[str, Array] = {}
    parallel_scans: dict[str, LidarDetection] = {}
    rng = stage.rng(_PARALLEL)
    for index, T_world_board in enumerate(nearly_parallel(stage, rng)):
        name = f"{index:06d}"
        parallel_poses[name] = invert(stage.views[0].T_world_cam) @ T_world_board
        seen = scan_held_board(stage, T_world_board, rng, 1000 + index)
        parallel_scans[name] = BoardFinder(rig).scan(seen)
    return SimulatedScans(seed, truth, poses, scans, resized, parallel_poses, parallel_scans)


def nearly_parallel(stage: Stage, rng: np.random.Generator) -> Iterator[Array]:
    """Hold the board at many places with its normal within a few degrees of one direction."""
    view, spread_deg = stage.views[0], rng.uniform(1.0, 5.0)
    lean = exp_so3(np.radians(15) * rng.uniform(-1, 1, 3) * [1, 1, 0])
    n_found = 0
    for _ in range(_N_PLACES):
        T_world_board = _facing(stage, lean, spread_deg, rng)
        if not can_be_held(view, stage.board, stage.room, T_world_board):
            continue
        is_seen = seen_share(view, stage.board, T_world_board) > 0.8
        if is_seen and count_rings(view, stage.board, T_world_board) >= 5:
            yield T_world_board
            n_found += 1
            if n_found == N_PARALLEL:
                return


def _facing(stage: Stage, lean: Array, spread_deg: float, rng: np.random.Generator) -> Array:
    lens = stage.views[0].intrinsics
    pixel = rng.uniform(0.15, 0.85, 2) * [lens.width_px, lens.height_px]
    centre = lens.unproject(pixel) * rng.uniform(*stage.options.distance_m)
    wobble = exp_so3(np.radians(spread_deg) * rng.standard_normal(3) * [1, 1, 0])
    mean_deg, half_width_deg = stage.options.roll_deg
    roll_deg = mean_deg + half_width_deg * rng.uniform(-1, 1)
    roll = exp_so3(np.radians(roll_deg) * np.array([0.0, 0.0, 1.0]))
    facing = np.diag([1.0, -1.0, -1.0])
    return np.asarray(stage.views[0].T_world_cam @ pose(lean @ wobble @ facing @ roll, centre))


def _flatten(session: SimulatedScans) -> dict[str, Any]:
    arrays: dict[str, Any] = {"T_cam_lidar": session.T_cam_lidar}
    groups = {"scans": session.scans, "parallel": session.parallel_scans}
    groups |= {f"resized {kind}": scans for kind, scans in session.resized.items()}
    for group, detections in groups.items():
        for name, detection in detections.items():
            arrays |= {f"{group}/{name}/{key}": value for key, value in to_arrays(detection).items()}
    arrays |= {f"pose/{name}": T for name, T in session.T_cam_board.items()}
    arrays |= {f"parallel pose/{name}": T for name, T in session.parallel_poses.items()}
    arrays["names"] = np.array(json.dumps({group: list(found) for group, found in groups.items()}))
    return arrays


def _restore(seed: int, arrays: dict[str, Any]) -> SimulatedScans:
    names = json.loads(str(arrays["names"]))

    def below(prefix: str) -> dict[str, Any]:
        return {key[len(prefix) :]: value for key, value in arrays.items() if key.startswith(prefix)}

    def group(title: str) -> dict[str, Any]:
        return {name: from_arrays(below(f"{title}/{name}/")) for name in names[title]}

    return SimulatedScans(
        seed,
        arrays["T_cam_lidar"],
        below("pose/"),
        group("scans"),
        {kind: group(f"resized {kind}") for kind in WRONG_PLATES_M},
        below("parallel pose/"),
        group("parallel"),
    )
