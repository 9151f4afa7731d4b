"""Boards and scene in one estimate: error and truth of the claim in simulated rooms, and on recordings."""

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import chi2

import lce_rig as lce
from benchmarks.recordings import SETS, RecordedSet
from benchmarks.scene_rooms import ROOMS, FurnishedRoom, furnished_room, only, with_few
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import Calibration, SceneShare
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, difference, perturb, sigma_sizes, tangent_sizes
from lce_rig.detect.detection import Detections
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.pipeline.witness import scene_views, share_of
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.views import without_movers
from lce_rig.session import Session

_SIZES = {"rlfs": (3, 5, 10), "rles": (3, 5, 10), "os1_64": (11,)}
# Claims of drawn board results: weak as os1_64's, and usual.
_DRAWN = {"0.5 deg, 30 mm an axis": (0.5, 0.030), "0.15 deg, 10 mm": (0.15, 0.010)}
_COLUMNS = (
    "rooms", "boards alone: rms", "claimed", "in 95 %", "NEES",
    "with scene: rms", "claimed", "in 95 %", "NEES", "not used",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Trial:
    """One board result and what the scene did to it: errors (6,) from the truth."""

    before: Array
    after: Array
    share: SceneShare

    @classmethod
    def of(cls, share: SceneShare, T_true: Array) -> "_Trial":
        """Compare with the truth what a user would get."""
        is_used = share.state == "used"
        T = share.T_cam_lidar if is_used else share.T_cam_lidar_boards
        if not is_used:
            share = replace(share, cov=share.cov_boards)
        return cls(difference(share.T_cam_lidar_boards, T_true), difference(T, T_true), share)


def bench_scene_sharpen(n_rooms: int, n_splits: int, only_sets: str = "", folder: Path = ROOMS) -> None:
    """Print the tables of docs/scene.md.

    Args:
        n_rooms: simulated rooms of rig rlfs; a third as many of the others.
        n_splits: random choices of captures of a recording.
        only_sets: rigs and recordings whose name contains this.
        folder: where simulated sessions are kept.
    """
    for name, n in (("rlfs", n_rooms), ("rles", n_rooms // 3), ("os1_64", n_rooms // 3)):
        if only_sets in f"rooms_{name}":
            _bench_rooms(name, n, folder)
    for recorded in SETS:
        if (
            recorded.name in ("rlfs01", "rlfs02", "os1_64")
            and recorded.is_there
            and only_sets in f"recorded_{recorded.name}"
        ):
            _bench_recording(recorded, n_splits)


def _bench_rooms(name: str, n_rooms: int, folder: Path) -> None:
    rooms = [_trials(name, seed, folder) for seed in range(n_rooms)]
    print(f"\nSimulated rooms, {name}: boards detected and calibrated\n")
    print_head("captures", *_COLUMNS)
    for size in _SIZES[name]:
        _print_trials(str(size), [room[str(size)] for room in rooms if str(size) in room])
    print("\nThe same rooms, 5 captures, board results drawn from a known covariance\n")
    print_head("drawn from", *_COLUMNS)
    for kind in _DRAWN:
        _print_trials(kind, [room[kind] for room in rooms])


def _trials(name: str, seed: int, folder: Path) -> dict[str, _Trial]:
    """Sharpen the boards' results of one room, and drawn ones, by number of captures and by what is drawn."""
    room = furnished_room(name, seed, max(_SIZES[name]), folder)
    every = room.calibrate(room.names)
    views = scene_views(room.session, room.detections, every, len(room.names))
    trials = {
        str(size): _Trial.of(share_of(without_movers(views[:size]), room.lens, calibration), room.T_cam_lidar)
        for size, calibration in _calibrated(room, _SIZES[name])
    }
    for kind, (sigma_deg, sigma_m) in _DRAWN.items():
        cov = np.diag([sigma_m] * 3 + [np.radians(sigma_deg)] * 3) ** 2
        off = np.random.default_rng([seed, 5]).multivariate_normal(np.zeros(6), cov)
        boards = replace(every, T_cam_lidar=perturb(room.T_cam_lidar, off), cov=cov, cov_shared=0 * cov)
        trials[kind] = _Trial.of(share_of(without_movers(views[:5]), room.lens, boards), room.T_cam_lidar)
    return trials


def _calibrated(room: FurnishedRoom, sizes: Sequence[int]) -> Iterator[tuple[int, Calibration]]:
    for size in sizes:
        try:
            yield size, room.calibrate(room.names[:size])
        except NotEnoughDataError:
            continue


def _print_trials(title: str, trials: Sequence[_Trial]) -> None:
    cells: list[str] = []
    for errors, covs in (
        ([t.before for t in trials], [t.share.cov_boards for t in trials]),
        ([t.after for t in trials], [t.share.cov for t in trials]),
    ):
        sizes = np.array([tangent_sizes(error) for error in errors])
        claims = np.median([sigma_sizes(cov) for cov in covs], axis=0)
        nees = np.array([e @ np.linalg.solve(cov, e) for e, cov in zip(errors, covs, strict=True)])
        cells += [
            _sizes(np.sqrt(np.mean(sizes**2, axis=0))),
            _sizes(claims),
            f"{100 * np.mean(nees < chi2.ppf(0.95, 6)):.0f} %",
            f"{nees.mean():.1f}",
        ]
    n_unused = sum(trial.share.state != "used" for trial in trials)
    print_row(title, len(trials), *cells, n_unused)


def _sizes(sizes: Array) -> str:
    return f"{sizes[0]:.3f} deg, {1000 * sizes[1]:.1f} mm"


def _bench_recording(recorded: RecordedSet, n_splits: int) -> None:
    """Compare results of five captures, with and without the scene, with that of all captures without it."""
    with tempfile.TemporaryDirectory() as folder:
        recorded.collect(Path(folder) / "session")
        session = Session.open(Path(folder) / "session")
        detections = lce.detect(session)
        rig = with_few(session.rig)
        (every,), _ = calibrate_detections(rig, detections)
        lens = rig.cameras[every.camera].to_intrinsics()
        views = scene_views(session, detections, every, 60)
        whole = share_of(without_movers(views), lens, every)
        print(f"\n{recorded.name}: all {len(views)} captures\n")
        print_head("boards alone claim", "with scene", "moved by", "surprise", "directions", "state")
        figures = (_sizes(np.array(sigma_sizes(cov))) for cov in (whole.cov_boards, whole.cov))
        moved = _sizes(np.array(tangent_sizes(whole.change)))
        print_row(*figures, moved, f"{whole.surprise:.1f}", whole.n_directions, whole.state)
        print("\nFive random captures compared with all boards without the scene\n")
        print_head("choice", "boards alone", "claimed", "with scene", "claimed", "state")
        _print_choices(rig, detections, views, every, n_splits)


def _print_choices(
    rig: Rig, detections: Detections, views: list[SceneView], every: Calibration, n: int
) -> None:
    lens = rig.cameras[every.camera].to_intrinsics()
    apart: list[tuple[Array, Array]] = []
    for k in range(n):
        chosen = np.random.default_rng(k).choice(len(views), 5, replace=False)
        names = [views[index].capture for index in sorted(chosen)]
        try:
            (calibration,), _ = calibrate_detections(rig, only(detections, names))
        except NotEnoughDataError:
            print_row(k, "boards nearly parallel", "", "", "", "")
            continue
        share = share_of(without_movers([views[index] for index in sorted(chosen)]), lens, calibration)
        T = share.T_cam_lidar if share.state == "used" else calibration.T_cam_lidar
        cov = share.cov if share.state == "used" else calibration.cov
        before, after = (
            np.array(tangent_sizes(difference(T_k, every.T_cam_lidar)))
            for T_k in (calibration.T_cam_lidar, T)
        )
        apart.append((before, after))
        claims = (_sizes(np.array(sigma_sizes(c))) for c in (calibration.cov, cov))
        before_claim, after_claim = claims
        print_row(k, _sizes(before), before_claim, _sizes(after), after_claim, share.state)
    if apart:
        medians = [_sizes(np.median([pair[side] for pair in apart], axis=0)) for side in (0, 1)]
        print_row("median", medians[0], "", medians[1], "", "")
