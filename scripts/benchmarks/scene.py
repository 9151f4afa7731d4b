"""The scene as a witness: false alarms, changes seen, truth of the smallest change."""

import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lce_rig as lce
from benchmarks.recordings import SETS, RecordedSet
from benchmarks.scene_rooms import furnished_room
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import MOTIONS, Calibration, ResultFile
from lce_rig.core.camera import Intrinsics
from lce_rig.core.data import Image
from lce_rig.core.geometry import Array, perturb
from lce_rig.detect.finder import BoardFinder
from lce_rig.pipeline.pair_drift import PairDrift, Seen
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.rig import Rig
from lce_rig.scene.alignment import IS_ROTATION, SceneView
from lce_rig.scene.depth_edges import leave_standing
from lce_rig.scene.drift import Drift, watch
from lce_rig.scene.views import build_view, without_board
from lce_rig.session import Session

_NAMES = ("rlfs01", "rlfs02", "acfr_vlp16", "os1_64")
_OF_ONE_RIG = (("rlfs01", "rlfs02"), ("rlfs02", "rlfs01"))
_PART = 5
_N_ROOMS = 10
_STATES = ("changed", "unchanged", "unknown")
_SIZES = (
    np.array([0.05, 0.05, 0.05, *np.radians([1.0, 0.5, 1.0])]),
    np.array([0.03, 0.03, 0.03, *np.radians([0.3, 0.3, 0.3])]),
)
_UNIT = np.where(IS_ROTATION, np.degrees(1.0), 1000.0)


@dataclass(frozen=True, eq=False)
class _Watched:
    """The views of one recorded set or simulated room, and its board calibration."""

    rig: Rig
    calibration: Calibration
    samples: list[Seen]
    views: list[SceneView]
    ignore_board: bool

    @classmethod
    def recorded(cls, recorded: RecordedSet, *, ignore_board: bool) -> "_Watched":
        """Calibrate a recorded set and find its edges."""
        with tempfile.TemporaryDirectory() as folder:
            recorded.collect(Path(folder) / "session")
            session = Session.open(Path(folder) / "session")
            (c,) = lce.calibrate(session).pairs
            samples = _samples(session, c)
            views = [build_view(session.rig, c, each.name, each.image, each.scan) for each in samples]
            if ignore_board:
                finder = BoardFinder(session.rig)
                views = [
                    without_board(view, finder.image(each.image), session.rig, c)
                    for view, each in zip(views, samples, strict=True)
                    if isinstance(each.image, Image)
                ]
        return cls(session.rig, c, samples, views, ignore_board)

    @classmethod
    def room(cls, seed: int, *, ignore_board: bool) -> "_Watched":
        """Calibrate a simulated room and find its edges."""
        room = furnished_room("rlfs", seed)
        c = room.calibrate()
        views = room.views(c, ignore_board=ignore_board)
        return cls(room.rig, c, _samples(room.session, c), views, ignore_board)

    @property
    def lens(self) -> Intrinsics:
        """The camera's intrinsics."""
        return self.rig.cameras[self.calibration.camera].to_intrinsics()

    def parts(self, n_splits: int) -> list["_Part"]:
        """Split the captures at random into parts of five, several times."""
        rng = np.random.default_rng(0)
        orders = [rng.permutation(len(self.views)) for _ in range(n_splits)]
        return [
            (self, self.seen([self.views[k] for k in order[first : first + _PART]]))
            for order in orders
            for first in range(0, len(order) - _PART + 1, _PART)
        ]

    def seen(self, views: list[SceneView]) -> list[SceneView]:
        """Leave out what moves, where the board is left out, as `drift` does."""
        if not self.ignore_board:
            return views
        standing = leave_standing([view.edges for view in views])
        return [replace(view, edges=edges) for view, edges in zip(views, standing, strict=True)]

    def drift(self, views: list[SceneView], deployed: Calibration) -> PairDrift:
        """Judge a result by some captures as `lce-rig drift` does, by scene and boards."""
        result = ResultFile(rig=self.rig.name, pairs=(deployed,))
        captures = SceneCaptures(self.rig, result, "a part")
        names = {view.capture for view in views}
        for each in self.samples:
            if each.name in names:
                captures.kept[0].take(each)
        return captures.judge().pairs[0]

    def judge(self, views: list[SceneView], tangent: Array) -> Drift:
        """Watch the board calibration, moved by a tangent."""
        c = self.calibration
        return watch(views, self.lens, perturb(c.T_cam_lidar, tangent), c.cov)


def _samples(session: Session, c: Calibration) -> list[Seen]:
    return [Seen(s.name, s.image(c.camera, "frames"), s.scan(c.lidar), None) for s in session.captures]


# Five captures, and what they are judged against.
_Part = tuple[_Watched, list[SceneView]]


def bench_scene(n_splits: int, only: str = "") -> None:
    """Print the tables of docs/drift.md; simulated rooms are split once, as one set."""
    for ignore_board in (False, True):
        print(f"\n### {'Edges at the board left out' if ignore_board else 'All edges'}")
        sets = [each for each in SETS if each.name in _NAMES and each.is_there and only in each.name]
        watched = {each.name: _Watched.recorded(each, ignore_board=ignore_board) for each in sets}
        seeds = range(_N_ROOMS if only in "rooms" else 0)
        rooms = [_Watched.room(seed, ignore_board=ignore_board) for seed in seeds]
        parts = {name: own.parts(n_splits) for name, own in watched.items()}
        if rooms:
            parts["rooms"] = [part for room in rooms for part in room.parts(1)]
        _print_unchanged(watched, parts)
        _print_changed(parts)
        if ignore_board:
            _print_beside(watched, parts)


def _print_unchanged(watched: dict[str, _Watched], parts: dict[str, list["_Part"]]) -> None:
    print("\nUnchanged rigs, and images mirrored (nothing fits)\n")
    print_head(
        "calibrated on", "watched", "parts", "no change seen", "cannot tell", "false alarms", "mirrored"
    )
    for source, target in [*((name, name) for name in parts), *_OF_ONE_RIG]:
        if source not in parts or target not in parts:
            continue
        states: Counter[str] = Counter()
        mirrored: Counter[str] = Counter()
        for own, views in parts[target]:
            deployed = own.calibration if source == target else watched[source].calibration
            arguments = (own.lens, deployed.T_cam_lidar, deployed.cov)
            states[watch(views, *arguments).state] += 1
            mirrored[watch(list(map(_mirrored, views)), *arguments).state] += 1
        shown = (states["unchanged"], states["unknown"], states["changed"])
        print_row(source, target, len(parts[target]), *shown, _counts(mirrored))


def _counts(states: Counter[str]) -> str:
    return ", ".join(f"{n} {state}" for state, n in sorted(states.items()))


def _mirrored(view: SceneView) -> SceneView:
    mirrored = np.ascontiguousarray(view.field.values[:, ::-1])
    return replace(view, field=replace(view.field, values=mirrored))


def _print_changed(every: dict[str, list["_Part"]]) -> None:
    print("\nOne axis changed, both signs; of the changes not seen, those for which the axis was unknown\n")
    print_head(
        "set", "axis", "seen", "cannot tell", "below the claim", "false all-clear", "right axis",
        "3 cm, .3 deg: seen",
        "smallest claimed (median)", "at the smallest: seen",
    )  # fmt: skip
    for name, parts in every.items():
        before = [own.judge(views, np.zeros(6)) for own, views in parts]
        for axis, label in enumerate(MOTIONS):
            tally: Counter[str] = Counter()
            smallest = [drift.axes[axis].smallest for drift in before]
            for (own, views), drift in zip(parts, before, strict=True):
                unit = float(_UNIT[axis]) if IS_ROTATION[axis] else 1.0
                is_known = drift.axes[axis].state == "unchanged"
                for sign in (-1.0, 1.0):
                    direction = sign * np.eye(6)[axis]
                    tally.update(
                        _outcome(own.judge(views, _SIZES[0][axis] * direction), axis, _SIZES[0][axis] * unit)
                    )
                    small = own.judge(views, _SIZES[1][axis] * direction)
                    tally["small"] += small.state == "changed"
                    if is_known:
                        tally["claims"] += 1
                        at = own.judge(views, drift.axes[axis].smallest / unit * direction)
                        tally["held"] += at.state == "changed"
            n = 2 * len(parts)
            digits, scale, named = (2, 1.0, "deg") if IS_ROTATION[axis] else (0, 1000.0, "mm")
            print_row(
                name,
                f"{label} {_SIZES[0][axis] * _UNIT[axis]:g} {named}",
                f"{tally['seen']} of {n}",
                tally["unknown"],
                tally["below"],
                tally["false"],
                tally["right"],
                f"{tally['small']} of {n}",
                f"{scale * np.median(smallest):.{digits}f} {named}",
                f"{tally['held']} of {tally['claims']}",
            )


def _outcome(drift: Drift, axis: int, size: float) -> list[str]:
    """Name what became of a change of one axis (deg or m)."""
    verdict = drift.axes[axis]
    if drift.state == "changed":
        named = {
            name for each in drift.axes if each.state == "changed" for name in (each.axis, *each.instead)
        }
        return ["seen", "right"] if MOTIONS[axis] in named else ["seen"]
    if drift.state == "unknown":
        return ["unknown"]
    return ["below" if size < verdict.smallest else "false"]


def _figures(values: Array, digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in values)


def _print_beside(watched: dict[str, _Watched], parts: dict[str, list[_Part]]) -> None:
    print("\nBoard and scene beside each other, as `lce-rig drift` judges\n")
    print_head("calibrated on", "watched", "changed by", "trials", "changed", "that axis", "no change seen",
               "cannot tell", "board alone: no change seen", "board would see (median)")  # fmt: skip
    for source, target in [*((name, name) for name in parts), *_OF_ONE_RIG]:
        if source not in parts or target not in parts:
            continue
        for axis in (None, *range(6)) if source == target else (None,):
            tally: Counter[str] = Counter()
            smallest = []
            for own, views in parts[target]:
                c = own.calibration if source == target else watched[source].calibration
                for sign in (1.0,) if axis is None else (-1.0, 1.0):
                    step = np.zeros(6) if axis is None else sign * _SIZES[0] * np.eye(6)[axis]
                    pair = own.drift(views, replace(c, T_cam_lidar=perturb(c.T_cam_lidar, step)))
                    tally[pair.state] += 1
                    board = () if pair.board is None else pair.board.axes
                    tally["board"] += bool(board) and all(each.state == "unchanged" for each in board)
                    smallest += [[each.smallest for each in board]] if board else []
                    tally["axis"] += axis is not None and pair.states[MOTIONS[axis]] == "changed"
            size = "nothing" if axis is None else f"{MOTIONS[axis]} {_SIZES[0][axis] * _UNIT[axis]:g}"
            n, states = sum(tally[each] for each in _STATES), [tally[each] for each in _STATES[1:]]
            told = _figures(np.median(smallest, axis=0), 3) if smallest else ""
            print_row(source, target, size, n, tally["changed"], tally["axis"], *states, tally["board"], told)
