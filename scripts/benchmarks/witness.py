"""The scene as a witness beside the boards: good results that it refuses, wrong ones that only it finds."""

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from benchmarks.fault_kinds import KINDS, Case, direction, exchanged_lens
from benchmarks.fault_sessions import WRONG_PLATES_M, SimulatedScans, with_plate
from benchmarks.recordings import RIGS, SETS, RecordedSet
from benchmarks.scene_rooms import furnished_room
from benchmarks.tables import compare, print_head, print_row
from lce_rig import pipeline
from lce_rig.calibrate import CalibrateOptions
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import worst
from lce_rig.core.geometry import Array, invert, perturb, transform
from lce_rig.core.results import MOTIONS, Calibration, ImageBoard
from lce_rig.core.scene_opinion import SceneOpinion
from lce_rig.detect.detection import ImageDetection, LidarDetection
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.verdict import scene_findings, with_opinion
from lce_rig.pipeline.calibration import clocks_of
from lce_rig.pipeline.witness import MAX_CAPTURES, opinion_of
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.views import build_view, without_board
from lce_rig.session import Session
from lce_rig.show.overlays.session_check import check_session

_SETS = (*SETS, RecordedSet("os1_64", str(RIGS / "os1_64.yaml"), (("os1_64", "frames"),)))
# A fault of boards that stand still; those of hand-held boards would need their times.
_STILL = ("rlfs01", "rlfs02", "rlfs03", "sss_noise15mm", "acfr_vlp16", "os1_64")
_OF_ONE_RIG = {"rlfs01": "rlfs02", "rlfs02": "rlfs01"}
# Faults that leave the pictures of the scene as they are, or change them by a known map.
_NOT_HERE = ("boards nearly parallel", "cameras swapped")
_N_SUBSETS, _N_MOVED, _N_DRAWS, _WRONG = 20, 10, 20, 3.0
_FEW = 6


_T = TypeVar("_T")


@dataclass(frozen=True, eq=False)
class _Place:
    """A session whose extrinsics are known, and its scene.

    Attributes:
        name: of the set.
        rig: its profile.
        good: its own result, before the scene's opinion.
        T_cam_lidar: the truth; of a recording, its own result.
        views: of the captures with a board in both sensors, in the order of time, all edges.
        detections: of the session.
        scans: the boards of those captures, from which faults are drawn.
    """

    name: str
    rig: Rig
    good: Calibration
    T_cam_lidar: Array
    views: tuple[SceneView, ...]
    detections: pipeline.Detections
    scans: SimulatedScans

    @property
    def boards(self) -> Mapping[str, ImageDetection]:
        """What was detected in the images, by capture."""
        return self.detections.images[self.good.camera, "frames"]


def _open(name: str, path: Path, T_true: Array | None) -> _Place:
    session = Session.open(path)
    rig, detections = session.rig, pipeline.detect(session)
    (good, *_), _ = pipeline.calibrate_detections(rig, detections)
    images, boards = detections.images[good.camera, "frames"], detections.lidars[good.lidar]
    poses, scans, views = {}, {}, []
    resized: dict[str, dict[str, LidarDetection]] = {kind: {} for kind in WRONG_PLATES_M}
    for capture in session.captures:
        image, board = images.get(capture.name), boards.get(capture.name)
        if not isinstance(image, ImageBoard) or not isinstance(board, list):
            continue
        scan = capture.scan(good.lidar)
        views.append(build_view(rig, good, capture.name, capture.image(good.camera, "frames"), scan))
        poses[capture.name], scans[capture.name] = image.T_cam_board, board
        for kind, added_m in WRONG_PLATES_M.items():
            resized[kind][capture.name] = BoardFinder(with_plate(rig, added_m)).scan(scan)
    T = good.T_cam_lidar if T_true is None else T_true
    spoilt = SimulatedScans(0, T, poses, scans, resized, {}, {})
    return _Place(name, rig, good, T, tuple(views), detections, spoilt)


def bench_witness(n_seeds: int, only: str = "") -> None:
    """Print what the scene says of results as they are, and of those of faulty sessions.

    Args:
        n_seeds: furnished rooms, each with every fault once; a quarter of as many draws of each recorded set.
        only: sets whose name contains this; the rooms are "rooms".
    """
    recorded = list(_recorded(only))
    rooms = [_open("rooms", *_room(seed)) for seed in range(n_seeds if only in "rooms" else 0)]
    _print_good(recorded, rooms)
    still = [place for place in recorded if place.name in _STILL]
    _print_moved([place for place in still if place.good.verdict != "fail"], rooms)
    for places, what, n_draws in ((still, "recorded", -(-n_seeds // 4)), (rooms, "simulated", 1)):
        for n_captures in (None, _FEW) if places else ():
            print(f"\nFaults in {what} sessions of {n_captures or 'all'} captures\n")
            _print_faults(places, n_draws, n_captures)


def _room(seed: int) -> tuple[Path, Array]:
    room = furnished_room("rlfs", seed, folder=Path(tempfile.gettempdir()) / "lce-rig-benchmarks" / "rooms")
    return room.session.path, room.T_cam_lidar


def _recorded(only: str) -> Iterator[_Place]:
    for recorded in _SETS:
        frames = tuple(each for each in recorded.folders if each[1] == "frames")
        recorded = replace(recorded, folders=frames)
        if recorded.is_there and only in recorded.name:
            with tempfile.TemporaryDirectory() as folder:
                recorded.collect(Path(folder) / "session")
                yield _open(recorded.name, Path(folder) / "session", None)


def _print_good(recorded: Sequence[_Place], rooms: Sequence[_Place]) -> None:
    print(f"\nResults as they are; opinions of {_N_SUBSETS} random subsets of {MAX_CAPTURES} captures\n")
    print_head(
        "set", "boards", "opinions", "agrees", "cannot tell", "contradicts", "refused",
        "axes told", "would see (median)",
    )  # fmt: skip
    for place in recorded:
        _print_opinions(place.name, [place], _N_SUBSETS)
    if rooms:
        _print_opinions("rooms", rooms, 1)


def _print_opinions(name: str, places: Sequence[_Place], n_subsets: int) -> None:
    opinions, refused = [], 0
    for place in places:
        rng = np.random.default_rng(0)
        own = [_opinion(place, place.good, place.boards, rng) for _ in range(n_subsets)]
        refused += sum(worst(scene_findings(each, place.good)) == "error" for each in own)
        opinions += own
    states = Counter(opinion.state for opinion in opinions)
    known = [axis for opinion in opinions for axis in opinion.of("agrees")]
    told = [_smallest([a.smallest for a in known if a.axis == motion], motion) for motion in MOTIONS]
    verdicts = Counter(place.good.verdict for place in places)
    print_row(
        name, ", ".join(f"{n} {verdict}" for verdict, n in sorted(verdicts.items())), len(opinions),
        states["agrees"], states["unknown"], states["contradicts"], refused,
        f"{len(known) / len(opinions):.1f}", ", ".join(filter(None, told)) or "-",
    )  # fmt: skip


def _smallest(sizes: Sequence[float], axis: str) -> str:
    if not sizes:
        return ""
    scale, unit = (1, "deg") if axis.startswith("rotation") else (1000, "mm")
    return f"{axis} {scale * np.median(sizes):.2g} {unit}"


def _opinion(
    place: _Place,
    calibration: Calibration,
    boards: Mapping[str, ImageDetection],
    rng: np.random.Generator,
    views: Sequence[SceneView] | None = None,
) -> SceneOpinion:
    views = place.views if views is None else views
    chosen = np.sort(rng.choice(len(views), min(MAX_CAPTURES, len(views)), replace=False))
    lens = place.rig.cameras[calibration.camera].to_intrinsics()
    own = [without_board(views[k], boards[views[k].capture], place.rig, calibration) for k in chosen]
    return opinion_of(own, lens, calibration)


# Changes since the calibration, drawn within these limits: rotation deg, translation m.
_MOVED = {
    "nothing": ((0.0, 0.0), (0.0, 0.0)),
    "0.5 to 1 deg, 5 to 20 mm": ((0.5, 1.0), (0.005, 0.02)),
    "1 to 3 deg, 5 to 40 mm": ((1.0, 3.0), (0.005, 0.04)),
}


def _print_moved(recorded: Sequence[_Place], rooms: Sequence[_Place]) -> None:
    """Verify results of a rig that has changed since, on a session of the rig as it is.

    Results of rlfs01 are verified on rlfs02, of the same rig, and vice versa; others on their own session.
    """
    good = {place.name: place.good for place in recorded}
    print("\n`verify` of results of a rig that has changed since\n")
    print_head(
        "sets", "changed by", "results", "boards refuse", "scene contradicts", "scene refuses",
        "only the scene refuses", "neither refuses, scene contradicts", "scene agrees",
    )  # fmt: skip
    for places, what, n_draws in ((recorded, "recorded", _N_MOVED), (rooms, "rooms", 2)):
        for title, (degrees, metres) in _MOVED.items() if places else ():
            rng = np.random.default_rng(0)
            found = []
            for place in places:
                for _ in range(n_draws):
                    shift = rng.uniform(*metres) * direction(rng, 3)
                    turn = np.radians(rng.uniform(*degrees)) * direction(rng, 3)
                    deployed = good.get(_OF_ONE_RIG.get(place.name, ""), place.good)
                    T = place.T_cam_lidar if places is rooms else deployed.T_cam_lidar
                    moved = perturb(T, np.concatenate([shift, turn]))
                    found.append(_verified(place, replace(deployed, T_cam_lidar=moved), rng))
            n_both = [sum(each) for each in zip(*found, strict=True)]
            print_row(what, title, len(found), *n_both)


def _verified(place: _Place, deployed: Calibration, rng: np.random.Generator) -> tuple[bool, ...]:
    """Verify extrinsics on the captures of a session; the columns of `_print_moved`."""
    c = replace(deployed, captures_used=())
    opinion = _opinion(place, c, place.boards, rng)
    clocks = clocks_of(place.rig, c.camera, c.lidar)
    found = check_session(place.rig, place.detections, c, "frames", clocks, opinion).findings
    by_scene = [each for each in found if each.code == "verdict.scene"]
    by_boards = [each for each in found if each.code != "verdict.scene"]
    has_refused = worst(by_scene) == "error"
    return (
        bool(by_boards), bool(by_scene), has_refused, has_refused and not by_boards,
        bool(by_scene) and not (has_refused or by_boards), opinion.state == "agrees",
    )  # fmt: skip


@dataclass(frozen=True)
class _Outcome:
    boards: str
    scene: str
    both: str
    error: float

    @property
    def is_wrong(self) -> bool:
        return self.error > _WRONG


def _print_faults(places: Sequence[_Place], n_seeds: int, n_captures: int | None) -> None:
    print_head(
        "fault", "results", "good", "of them pass", "contradicted", "refused",
        "wrong", "not failed by the boards", "of them pass", "contradicted", "refused",
    )  # fmt: skip
    total: list[_Outcome] = []
    for number, kind in enumerate(KINDS):
        if kind in _NOT_HERE:
            continue
        found = [
            outcome
            for place in places
            for seed in range(n_seeds)
            if (outcome := _run(place, kind, number, seed, n_captures)) is not None
        ]
        _print_outcomes(kind, found)
        total += found
    _print_outcomes("all", total)


def _print_outcomes(kind: str, found: Sequence[_Outcome]) -> None:
    good = [each for each in found if not each.is_wrong and each.boards != "fail"]
    wrong = [each for each in found if each.is_wrong]
    missed = [each for each in wrong if each.boards != "fail"]
    print_row(
        kind, len(found), len(good), _count(good, "boards", "pass"),
        _count(good, "scene", "contradicts"), _count(good, "both", "fail"),
        len(wrong), len(missed), _count(missed, "boards", "pass"),
        _count(missed, "scene", "contradicts"), _count(missed, "both", "fail"),
    )  # fmt: skip


def _count(outcomes: Sequence[_Outcome], name: str, value: str) -> int:
    return sum(getattr(each, name) == value for each in outcomes)


def _run(place: _Place, kind: str, number: int, seed: int, n_captures: int | None) -> _Outcome | None:
    """Calibrate a session with a fault and ask its scene; None where the boards give no result."""
    if n_captures is not None:
        place = _fewer(place, n_captures, np.random.default_rng(seed))
    case = KINDS[kind](place.scans, place.rig, np.random.default_rng([seed, number]))
    camera, lidar = place.good.camera, place.good.lidar
    detections = pipeline.Detections({(camera, "frames"): case.images}, {lidar: case.scans})
    try:
        (result, *_), _ = pipeline.calibrate_detections(
            case.rig, detections, CalibrateOptions(n_draws=_N_DRAWS)
        )
    except NotEnoughDataError:
        return None
    views = _faulty_views(place, kind, case, np.random.default_rng([seed, number]))
    opinion = _opinion(place, result, case.images, np.random.default_rng(seed), views)
    both = with_opinion(result, opinion)
    rotation_deg, translation_mm = compare(result.T_cam_lidar, case.T_cam_lidar)
    error = place.rig.calibration.in_targets(rotation_deg, translation_mm / 1000)
    if opinion.strongest is not None:
        told = f"{result.verdict}, error {error:.1f} targets: {opinion.strongest}"
        print(f"{place.name}, {kind}, seed {seed}: {told}", file=sys.stderr, flush=True)
    return _Outcome(result.verdict, opinion.state, both.verdict, error)


def _fewer(place: _Place, n_captures: int, rng: np.random.Generator) -> _Place:
    """Choose some of the captures at random, in the order of time."""
    names = [view.capture for view in place.views]
    chosen = {names[k] for k in rng.choice(len(names), min(n_captures, len(names)), replace=False)}

    def kept(items: Mapping[str, _T]) -> dict[str, _T]:
        return {name: item for name, item in items.items() if name in chosen}

    scans = replace(
        place.scans,
        T_cam_board=kept(place.scans.T_cam_board),
        scans=kept(place.scans.scans),
        resized={kind: kept(found) for kind, found in place.scans.resized.items()},
    )
    return replace(place, scans=scans, views=tuple(view for view in place.views if view.capture in chosen))


def _faulty_views(place: _Place, kind: str, case: Case, rng: np.random.Generator) -> Sequence[SceneView]:
    """Show the scene as the faulty rig would see it."""
    if kind == "stale intrinsics":
        lens = place.rig.cameras[place.good.camera].to_intrinsics()
        return _through(exchanged_lens(place.rig, rng), lens, place.views)
    if kind == "camera nudged half-way":
        return _nudged(place, case)
    return place.views


def _through(true: Intrinsics, lens: Intrinsics, views: Sequence[SceneView]) -> list[SceneView]:
    """Show the fields as another lens would."""
    height, width = views[0].field.values.shape
    reduction = views[0].field.reduction
    at = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2)
    rays = true.unproject((at + 0.5) * reduction - 0.5)
    pixels, _ = lens.project(rays)
    source = ((np.where(np.isfinite(pixels), pixels, -1e4) + 0.5) / reduction - 0.5).astype(np.float32)
    grid = source.reshape(height, width, 2)
    return [
        replace(
            view, field=replace(view.field, values=cv2.remap(view.field.values, grid, None, cv2.INTER_LINEAR))
        )
        for view in views
    ]


def _nudged(place: _Place, case: Case) -> list[SceneView]:
    """Move the edges of the captures after the nudge so that their images show the rig as it was then."""
    T_after_before = case.T_cam_lidar @ invert(place.T_cam_lidar)
    # Of images that do not change: exact where the extrinsics are right, in first order about it.
    T_before_after = invert(place.T_cam_lidar) @ invert(T_after_before) @ place.T_cam_lidar
    found = []
    for view in place.views:
        T, image = place.scans.T_cam_board[view.capture], case.images[view.capture]
        is_after = isinstance(image, ImageBoard) and (
            np.linalg.norm(image.T_cam_board - T_after_before @ T) < np.linalg.norm(image.T_cam_board - T)
        )
        points = transform(T_before_after, view.edges.points) if is_after else view.edges.points
        found.append(replace(view, edges=replace(view.edges, points=points)))
    return found
