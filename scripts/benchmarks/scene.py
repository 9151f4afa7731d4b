"""The scene as a witness: false alarms, changes seen, truth of the smallest change."""

import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lce_rig as lce
from benchmarks.measured import measure
from benchmarks.recordings import SETS, RecordedSet
from benchmarks.tables import print_head, print_row
from lce_rig.core.calibration import MOTIONS, Calibration, ResultFile
from lce_rig.core.data import Image
from lce_rig.core.geometry import difference, perturb, sigma_sizes, tangent_sizes
from lce_rig.detect.finder import BoardFinder
from lce_rig.judge.findings import RANGE_OFFSET
from lce_rig.judge.scene_drift import SceneDrift, watch_scene
from lce_rig.pipeline.pair_drift import PairDrift, Seen
from lce_rig.pipeline.scene_calibration import calibrate_scene
from lce_rig.pipeline.watch_drift import SceneCaptures
from lce_rig.rig import NominalExtrinsic, Rig
from lce_rig.scene.outline_score import OutlineView
from lce_rig.scene.views import build_view, without_board, without_movers
from lce_rig.session import Session

_NAMES = ("rlfs01", "rlfs02", "acfr_vlp16", "os1_64")
_ALONE = (*_NAMES, "vlp32c_left", "os1_gen1", "livox_avia")
_SIZE = "{:.2f} deg, {:.0f} mm"
_OF_ONE_RIG = (("rlfs01", "rlfs02"), ("rlfs02", "rlfs01"))
_PART = 5
_STATES = ("changed", "unchanged", "unknown")
_SIZES = np.array([0.1, 0.1, 0.1, *np.radians([1.0, 1.0, 1.0])])
_UNIT = np.repeat([1000.0, np.degrees(1.0)], 3)


@dataclass(frozen=True, eq=False)
class _Watched:
    """The views of one recorded set, and its board calibration."""

    rig: Rig
    calibration: Calibration
    samples: list[Seen]
    views: list[OutlineView]

    @classmethod
    def recorded(cls, recorded: RecordedSet) -> "_Watched":
        """Calibrate a recorded set and find its edges, without those at the board."""
        with tempfile.TemporaryDirectory() as folder:
            recorded.collect(Path(folder) / "session")
            session = Session.open(Path(folder) / "session")
            (c,) = lce.calibrate_session(session).pairs
            samples, finder = _samples(session, c), BoardFinder(session.rig)
        views = [
            without_board(
                build_view(session.rig, c, each.name, each.image, each.scan),
                finder.image(each.image),
                session.rig,
                c,
            )
            for each in samples
            if isinstance(each.image, Image)
        ]
        return cls(session.rig, c, samples, views)

    def parts(self, n_splits: int) -> list["_Part"]:
        """Split the captures at random into parts of five, several times."""
        rng = np.random.default_rng(0)
        orders = [rng.permutation(len(self.views)) for _ in range(n_splits)]
        return [
            (self, [self.views[k] for k in order[first : first + _PART]])
            for order in orders
            for first in range(0, len(order) - _PART + 1, _PART)
        ]

    def scene(self, views: list[OutlineView], deployed: Calibration) -> SceneDrift:
        """Judge a result by the scene alone, without moving objects."""
        return watch_scene(without_movers(views), self.rig.lens_of(deployed), deployed)

    def drift(self, views: list[OutlineView], deployed: Calibration) -> PairDrift:
        """Judge a result by some captures as `lce-rig drift` does, by scene and boards."""
        result = ResultFile(rig=self.rig.name, pairs=(deployed,))
        captures = SceneCaptures(self.rig, result, "a part")
        names = {view.capture for view in views}
        for each in self.samples:
            if each.name in names:
                captures.kept[0].take(each)
        return captures.judge().pairs[0]


def _samples(session: Session, c: Calibration) -> list[Seen]:
    return [Seen(s.name, s.image(c.camera, "frames"), s.scan(c.lidar), None) for s in session.captures]


# Five captures, and the result they are compared with.
_Part = tuple[_Watched, list[OutlineView]]


def bench_scene(n_splits: int, only: str = "") -> None:
    """Tabulate extrinsics of scenes against boards, and answers to results that hold and to changed ones."""
    if only in "boards":
        _print_against_boards()
    if only in "answers":
        _print_answers(n_splits)


def _print_answers(n_splits: int) -> None:
    sets = [each for each in SETS if each.name in _NAMES and each.is_there]
    watched = {each.name: _Watched.recorded(each) for each in sets}
    parts = {name: own.parts(n_splits) for name, own in watched.items()}
    for title, is_alone in (("Scene alone, without the board's edges", True), ("Boards and scene", False)):
        print(f"\n### {title}\n")
        print_head("calibrated on", "watched", "changed by", "trials", "changed", "holds", "cannot tell")
        for source, target in [*((name, name) for name in parts), *_OF_ONE_RIG]:
            if source not in parts or target not in parts:
                continue
            for axis in (None, *range(6)) if source == target else (None,):
                states: Counter[str] = Counter()
                for own, views in parts[target]:
                    c = own.calibration if source == target else watched[source].calibration
                    for sign in (1.0,) if axis is None else (-1.0, 1.0):
                        step = np.zeros(6) if axis is None else sign * _SIZES * np.eye(6)[axis]
                        moved = replace(c, T_cam_lidar=perturb(c.T_cam_lidar, step))
                        judged = own.scene(views, moved) if is_alone else own.drift(views, moved)
                        states[judged.state] += 1
                size = "nothing" if axis is None else f"{MOTIONS[axis]} {_SIZES[axis] * _UNIT[axis]:g}"
                print_row(source, target, size, states.total(), *(states[each] for each in _STATES))


def _print_against_boards() -> None:
    """Calibrate by the scene, from a nominal pose off by 1 deg and 10 cm, and compare with the boards."""
    print("\nextrinsics of the scene, boards in it, from nominal poses 1 deg and 10 cm off\n")
    print_head("set", "views", "difference from the boards' result", "reported", "chi-squared (95 %: 12.6)",
               "verdict or cause")  # fmt: skip
    for recorded in (each for each in SETS if each.name in _ALONE and each.is_there):
        with tempfile.TemporaryDirectory() as folder:
            session = Path(folder) / "session"
            recorded.collect(session)
            c, rig = _by_boards(session)
            found = calibrate_scene([session], "", rig=_with_nominal(rig, c)).result
            key = f"scene.{recorded.name}"
            if not found.pairs:
                cells: tuple[str, ...] = ("-", "*cannot tell*", "-", "-")
                print_row(recorded.name, *cells, found.shortages[0].code)
            else:
                (scene,) = found.pairs
                apart = difference(scene.T_cam_lidar, c.T_cam_lidar)
                chi2 = float(apart @ np.linalg.solve(scene.cov + c.cov, apart))
                sizes = (
                    _SIZE.format(angle_deg, 1000 * distance_m)
                    for angle_deg, distance_m in (tangent_sizes(apart), sigma_sizes(scene.cov))
                )
                cells = (str(len(scene.captures_used)), *sizes, f"{chi2:.1f}")
                print_row(recorded.name, *cells, scene.verdict)
            for name, cell in zip(("views", "difference", "claim", "chi2"), cells, strict=True):
                measure(f"{key}.{name}", "{}", cell)


def _by_boards(path: Path) -> tuple[Calibration, Rig]:
    """Calibrate a session by its boards; ranges that its verdict finds wrong are entered, as it advises."""
    session = Session.open(path)
    for _ in range(2):
        (c,) = lce.calibrate_session(session).pairs
        entered = next((f.figures["enter_m"] for f in c.findings if f.code == RANGE_OFFSET.code), None)
        if entered is None:
            break
        lidar = session.rig.lidars[c.lidar].model_copy(update={"range_offset_m": entered})
        session = session.with_profile(session.rig.model_copy(update={"lidars": {c.lidar: lidar}}))
    return c, session.rig


def _with_nominal(rig: Rig, c: Calibration) -> Rig:
    """Enter the lens of a result, and a nominal pose off by 1 deg and 10 cm in random directions."""
    rng = np.random.default_rng(0)
    shift, turn = (each / np.linalg.norm(each) for each in rng.normal(size=(2, 3)))
    T = perturb(c.T_cam_lidar, np.r_[0.1 * shift, np.radians(1.0) * turn])
    nominal = NominalExtrinsic(
        camera=c.camera,
        lidar=c.lidar,
        matrix=T[:3, :3].tolist(),
        translation_m=T[:3, 3].tolist(),
        tolerance_m=0.2,
    )
    return rig.with_lenses([c]).model_copy(update={"nominal_extrinsics": (nominal,)})
