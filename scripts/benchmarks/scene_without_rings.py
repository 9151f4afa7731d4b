"""Extrinsics checked by the scene of LiDARs without rings: false alarms, and changes seen."""

import json
import time
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from saved_results import made_calibration, result_file

from benchmarks.recordings import RIGS, recordings
from benchmarks.scene_rooms import furnished_room
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import MOTIONS, Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, exp_so3, perturb, pose
from lce_rig.pipeline.pair_drift import Seen
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.rig import Rig, load_rig
from lce_rig.scene.alignment import IS_ROTATION, SceneView
from lce_rig.scene.depth_edges import leave_standing
from lce_rig.scene.drift import watch
from lce_rig.scene.views import build_view

TRUSTED_COV = np.diag([0.003] * 3 + [0.0005] * 3) ** 2  # 3 mm, 0.03 deg: trusted extrinsics
_STATES = ("changed", "unchanged", "unknown")
_SIZES = np.where(IS_ROTATION, np.radians(1.0), 0.2)
_IN_ROOMS = np.where(IS_ROTATION, np.radians(1.0), 0.05)
_RANDOM = ((0.5, 0.05), (1.0, 0.1), (2.0, 0.2))  # deg, m: largest of each of the six axes
_N_RANDOM = 200

# Views that are judged together, their lens and the true extrinsics.
_Group = tuple[Sequence[SceneView], Intrinsics, Array]


def bench_scene_without_rings(n_rooms: int, only: str = "") -> None:
    """Print the tables of docs/benchmarks.md."""
    if only in "kitti_drives":
        lens, T, views = _edges(recordings() / "kitti_drives")
        for n_views in (1, 3, len(views)):
            _print_axes(
                f"{n_views} views", [(each, lens, T) for each in combinations(views, n_views)], _SIZES
            )
        for n_views in (1, 3):
            _print_random(n_views, views, lens, T)
    if only in "rooms":
        _print_axes(f"{n_rooms} rooms", list(map(_room, range(n_rooms))), _IN_ROOMS)


def drives(folder: Path) -> tuple[Rig, Calibration, list[Seen]]:
    """Read KITTI's views, and their trusted extrinsics as a result."""
    trusted = json.loads((folder / "gt.json").read_text())["extrinsics"]
    w, *v = np.array(trusted["rotation"]) / np.linalg.norm(trusted["rotation"])
    turn = 2 * np.arctan2(np.linalg.norm(v), w) * np.array(v) / np.linalg.norm(v)
    T = pose(exp_so3(turn), np.array(trusted["translation"]))
    rig, c = load_rig(str(RIGS / "kitti.yaml")), made_calibration(T, TRUSTED_COV)
    captures = SceneCaptures(rig, result_file(rig.name, [c]), str(folder))
    captures.take_recordings([folder], lambda done, of: None)
    return rig, c, list(captures.kept[0])


def _edges(folder: Path) -> tuple[Intrinsics, Array, list[SceneView]]:
    """Find the edges of KITTI's views; their trusted extrinsics."""
    rig, c, samples = drives(folder)
    start = time.process_time()
    views = [build_view(rig, c, each.name, each.image, each.scan) for each in samples]
    print(f"\n{len(views)} views, edges in {1000 * (time.process_time() - start) / len(views):.0f} ms each")
    return rig.lens_of(c), c.T_cam_lidar, views


def _room(seed: int) -> _Group:
    """Simulate five captures of a Mid-360 in a furnished room, without what moves in it."""
    room = furnished_room("mid360", seed, 5)
    c = made_calibration(room.T_cam_lidar, TRUSTED_COV)
    views = room.views(c)
    standing = leave_standing([view.edges for view in views])
    views = [SceneView(view.capture, edges, view.field) for view, edges in zip(views, standing, strict=True)]
    return views, room.lens, room.T_cam_lidar


def _print_axes(name: str, groups: Sequence[_Group], sizes: Array) -> None:
    print(f"\n{name}\n")
    print_head("changed by", "trials", "changed", "that axis named", "no change seen", "cannot tell")
    print_row("nothing", *_judged(groups, [np.zeros(6)]))
    for axis, size in enumerate(sizes):
        label = f"{np.degrees(size):g} deg" if IS_ROTATION[axis] else f"{1000 * size:g} mm"
        tangents = [sign * size * np.eye(6)[axis] for sign in (-1, 1)]
        print_row(f"{MOTIONS[axis]} {label}", *_judged(groups, tangents, MOTIONS[axis]))


def _print_random(n_views: int, views: Sequence[SceneView], lens: Intrinsics, T: Array) -> None:
    """Change all axes at random, as detectors of miscalibration are tested."""
    print(f"\nall axes at random, {n_views} views\n")
    print_head("each axis up to", "trials", "changed", "no change seen", "cannot tell")
    rng = np.random.default_rng(0)
    for turn_deg, shift_m in _RANDOM:
        states: Counter[str] = Counter()
        for _ in range(_N_RANDOM):
            tangent = rng.uniform(-1, 1, 6) * np.where(IS_ROTATION, np.radians(turn_deg), shift_m)
            chosen = [views[k] for k in rng.permutation(len(views))[:n_views]]
            states[watch(chosen, lens, perturb(T, tangent), TRUSTED_COV).state] += 1
        print_row(f"{turn_deg:g} deg, {1000 * shift_m:g} mm", _N_RANDOM, *(states[each] for each in _STATES))


def _judged(groups: Iterable[_Group], tangents: Sequence[Array], axis: str = "") -> tuple[object, ...]:
    """Count trials, changes found, those that name the axis, all-clears and open answers."""
    tally: Counter[str] = Counter()
    for views, lens, T in groups:
        for tangent in tangents:
            drift = watch(views, lens, perturb(T, tangent), TRUSTED_COV)
            changes = [each for each in drift.axes if each.state == "changed"]
            tally[drift.state] += 1
            tally["named"] += any(axis in (each.axis, *each.instead) for each in changes)
    n_changed, *others = (tally[state] for state in _STATES)
    return sum((n_changed, *others)), n_changed, tally["named"] if axis else "", *others
