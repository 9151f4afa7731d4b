"""Extrinsics from KITTI's drives without a board: errors, coverage of the claim, changes seen."""

import json
import time
from collections import Counter
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from saved_results import made_calibration, result_file

from benchmarks.measured import measure
from benchmarks.recordings import RIGS, recordings
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.geometry import Array, difference, exp_so3, perturb, pose, tangent_sizes
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.judge.scene_drift import SceneDrift, watch_scene
from lce_rig.pipeline.pair_drift import Seen
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.rig import Rig, load_rig
from lce_rig.scene.estimate import REACH, SceneEstimate, estimate_scene
from lce_rig.scene.outline_score import OutlineView, build_outline_view

_GIVEN = (
    "000000",
    "000741",
    "001483",
    "002224",
    "002966",
    "003707",
    "004448",
)  # Most constants were chosen on these.
_CHI2_95 = 12.59  # of six degrees of freedom
_CHANGE = np.array([0.2, np.radians(1.0)])  # m, rad


TRUSTED_COV = np.diag([0.003] * 3 + [0.0005] * 3) ** 2  # 3 mm, 0.03 deg: trusted extrinsics
_SIZE = "{:.2f} deg, {:.0f} mm"


def bench_scene_estimate(n_trials: int, only: str = "") -> None:
    """Print the tables; given views are those that most constants were chosen on."""
    lens, T, views = _views()
    given = [view for view in views if view.capture[:6] in _GIVEN]
    other = [view for view in views if view.capture[:6] not in _GIVEN]
    if only in "errors":
        _print_all_errors(views, given, other, lens, T, n_trials)
    if only in "changes":
        print("\ntrusted extrinsics of 0.03 deg and 3 mm, three views\n")
        print_head("views", "changed by", "trials", "holds", "changed", "cannot tell",
                   "smallest change noticed (median)")  # fmt: skip
        for name, group in (("given 7", given), ("other 5", other)):
            _print_changes(name, list(combinations(group, 3)), lens, T, n_trials)


def _print_all_errors(
    views: Sequence[OutlineView],
    given: Sequence[OutlineView],
    other: Sequence[OutlineView],
    lens: Intrinsics,
    T: Array,
    n_trials: int,
) -> None:
    print("\nfrom starts within 2 deg and 20 cm about each axis\n")
    print_head("views", "trials", "cannot tell", "median error", "95 %", "95 % of sigma",
               "within 0.5 deg, 20 cm or cannot tell", "claim of 95 % covers", "time")  # fmt: skip
    for name, group, n_views in (
        ("any 7 of 12", views, 7),
        ("any 3 of the given 7", given, 3),
        ("any 3 of the other 5", other, 3),
        ("the other 5", other, 5),
        ("one of the given 7", given, 1),
        ("one of the other 5", other, 1),
    ):
        _print_errors(name, group, n_views, lens, T, n_trials)


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


def _views() -> tuple[Intrinsics, Array, list[OutlineView]]:
    """Find the edges of all views, and the trusted extrinsics."""
    rig, c, samples = drives(recordings() / "kitti_drives")
    lidar, lens = rig.lidars[c.lidar], rig.lens_of(c)
    beam = Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad)
    start = time.process_time()
    views = [
        build_outline_view(each.name, each.image, each.scan, beam, lens, c.T_cam_lidar)
        for each in samples
        if isinstance(each.image, Image)
    ]
    print(f"\n{len(views)} views, edges in {1000 * (time.process_time() - start) / len(views):.0f} ms each")
    return lens, c.T_cam_lidar, views


def _print_errors(
    name: str, group: Sequence[OutlineView], n_views: int, lens: Intrinsics, T: Array, n_trials: int
) -> None:
    rng = np.random.default_rng(0)
    start, found = time.process_time(), []
    for _ in range(n_trials):
        chosen = [group[k] for k in rng.permutation(len(group))[:n_views]]
        found.append(estimate_scene(chosen, lens, perturb(T, rng.uniform(-1, 1, 6) * REACH)))
    seconds = (time.process_time() - start) / n_trials
    usable = [each for each in found if each.state == "usable"]
    errors = np.array([tangent_sizes(difference(each.T_cam_lidar, T)) for each in usable]).reshape(-1, 2)
    n_within = int(np.sum((errors[:, 0] < 0.5) & (errors[:, 1] < 0.2))) + n_trials - len(usable)
    n_covered = sum(each.chi2(T) < _CHI2_95 for each in usable)
    states = Counter(each.state for each in found if each.state != "usable")
    measure(f"scene_estimate.{name}.covered", "{} of {}", n_covered, len(usable))
    measure(f"scene_estimate.{name}.within", "{} of {}", n_within, n_trials)
    if usable:
        measure(f"scene_estimate.{name}.error", _SIZE, *_deg_mm(np.median(errors, axis=0)))
    spread = np.array([_sizes(each) for each in usable]).reshape(-1, 2)
    print_row(
        name,
        n_trials,
        ", ".join(f"{n} {state}" for state, n in states.items()) or "0",
        *(_size(np.percentile(errors, q, axis=0)) if usable else "" for q in (50, 95)),
        _size(np.median(spread, axis=0)) if usable else "",
        n_within,
        f"{n_covered} of {len(usable)}",
        f"{seconds:.1f} s",
    )


def _sizes(estimate: SceneEstimate) -> tuple[float, float]:
    variances = np.diag(estimate.cov)
    return float(np.degrees(np.sqrt(variances[3:].sum()))), float(np.sqrt(variances[:3].sum()))


def _size(pair: Array) -> str:
    return _SIZE.format(*_deg_mm(pair))


def _deg_mm(pair: Array) -> tuple[float, float]:
    return float(pair[0]), 1000 * float(pair[1])


def _print_changes(
    name: str, triples: Sequence[Sequence[OutlineView]], lens: Intrinsics, T: Array, n_trials: int
) -> None:
    rng = np.random.default_rng(1)
    c = made_calibration(T, TRUSTED_COV)
    unchanged = [watch_scene(views, lens, c) for views in triples]
    noticed = np.median([each.smallest for each in unchanged], axis=0)
    print_row(name, "nothing", len(triples), *_answers(unchanged), _size(noticed))
    _measure_answers(f"{name}.unchanged", _answers(unchanged))
    measure(f"scene_estimate.{name}.smallest", _SIZE, *_deg_mm(noticed))
    changed = np.zeros(3, dtype=int)
    for part, label in enumerate(("20 cm", "1 deg")):
        found = []
        for k in range(n_trials):
            axis = rng.normal(size=3)
            tangent = np.zeros(6)
            tangent[3 * part : 3 * part + 3] = _CHANGE[part] * axis / np.linalg.norm(axis)
            deployed = made_calibration(perturb(T, tangent), TRUSTED_COV)
            found.append(watch_scene(triples[k % len(triples)], lens, deployed))
        print_row(name, f"{label}, any direction", len(found), *_answers(found), "")
        changed += _answers(found)
    _measure_answers(f"{name}.changed", changed.tolist())


def _measure_answers(key: str, counts: Sequence[int]) -> None:
    for what, n in zip(("holds", "changes", "unknown"), counts, strict=True):
        measure(f"scene_estimate.{key}.{what}", "{}", n)
    measure(f"scene_estimate.{key}.trials", "{}", sum(counts))


def _answers(found: Sequence[SceneDrift]) -> tuple[int, int, int]:
    """Count results that hold, that changed, and open answers."""
    states = Counter(each.state for each in found)
    return states["unchanged"], states["changed"], states["unknown"]
