"""Does guidance help? A simulated person who follows it, against the same number of random placements."""

import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.kept import kept_folder
from benchmarks.tables import print_head, print_row, rms
from lce_rig import pipeline
from lce_rig.calibrate import CalibrateOptions
from lce_rig.collect.guidance import (
    HeldPose,
    Person,
    Planner,
    SensorPlace,
    build_pose,
    combine,
    model_sensors,
    sigmas,
    weigh_placements,
)
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, difference, fit_plane
from lce_rig.core.results import ImageBoard, LidarBoard
from lce_rig.detect.finder import BoardFinder
from lce_rig.rig import Rig, load_rig
from lce_rig.simulate import SimulatedCapture, SimulationOptions, simulate_captures, truth_extrinsics
from lce_rig.simulate.captures import capture_at
from lce_rig.simulate.poses import can_be_held, count_rings
from lce_rig.simulate.stage import Stage, set_stage

RIGS = ("rlfs", "rles")
#: Sessions of lower seeds served to choose what guidance assumes of the sensors' errors.
FIRST_SEED = 20
#: Simulated sessions are kept here: to calibrate them again takes seconds.
FOLDER = Path("build/guidance")
# Packages that decide where a simulated board is held.
_MAKERS = ("simulate", "collect/guidance")
# After so many tries a person gives a placement up: a wall is in the way, or the board is never seen whole.
_TRIES = 8
_PERSON, _OFFSET = 101, 102


@dataclass(frozen=True, eq=False)
class Visit:
    """One capture of a session: what both sensors found, and where the board truly was."""

    image: pipeline.ImageDetection
    scan: pipeline.LidarDetection
    T_cam_board: Array


@dataclass(frozen=True)
class Outcome:
    """Errors of one session (6,), as calibrated and as predicted before."""

    error: Array
    predicted: tuple[float, float]
    claimed: tuple[float, float]


def bench_guidance(n_seeds: int, n_captures: int = 15, rigs: Sequence[str] = RIGS) -> None:
    """Tabulate the errors of random and guided sessions, and of guided ones a third shorter."""
    head = "rig, placements, seeds, captures, offset, rms deg, rms mm, predicted deg / mm, reported deg / mm"
    print_head(*head.split(", "))
    seeds = range(FIRST_SEED, FIRST_SEED + n_seeds)
    for name in rigs:
        random = [kept("random", name, seed, n_captures) for seed in seeds]
        guided = [kept("guided", name, seed, n_captures) for seed in seeds]
        fewer = [visits[: 2 * n_captures // 3] for visits in guided]
        for offset in ("none", "drawn"):
            for kind, sessions in (("random", random), ("guided", guided), ("guided", fewer)):
                print_outcomes(name, kind, len(sessions[0]), offset, seeds, sessions)


def bench_prediction(n_seeds: int, n_captures: int = 15, rigs: Sequence[str] = ("rles",)) -> None:
    """Tabulate the errors of guided sessions against what was predicted."""
    print_head("rig", "seeds", "offset", "rms deg / mm", "predicted deg / mm", "predicted over actual")
    seeds = range(FIRST_SEED, FIRST_SEED + n_seeds)
    for name in rigs:
        sessions = [kept("guided", name, seed, n_captures) for seed in seeds]
        for offset in ("none", "drawn"):
            outcomes = judge_sessions(name, seeds, sessions, is_offset=offset == "drawn")
            errors = np.array([each.error for each in outcomes])
            predicted = np.array([each.predicted for each in outcomes])
            actual = rms(np.linalg.norm(errors[:, 3:], axis=1)), rms(np.linalg.norm(errors[:, :3], axis=1))
            said = rms(predicted[:, 0]), rms(predicted[:, 1])
            print_row(
                name,
                len(outcomes),
                offset,
                f"{np.degrees(actual[0]):.4f} / {1000 * actual[1]:.2f}",
                f"{np.degrees(said[0]):.4f} / {1000 * said[1]:.2f}",
                f"{said[0] / actual[0]:.2f} / {said[1] / actual[1]:.2f}",
            )


def kept(kind: str, name: str, seed: int, n_captures: int) -> list[Visit]:
    """Simulate a session, or take it from the folder of those simulated before."""
    path = kept_folder(FOLDER, load_rig(name), packages=_MAKERS) / f"{kind}_{seed}_{n_captures}.pkl"
    if not path.exists():
        simulate = guided_session if kind == "guided" else random_session
        visits = simulate(name, seed, n_captures)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(visits))
    known: list[Visit] = pickle.loads(path.read_bytes())
    return known


def judge_sessions(
    name: str, seeds: Sequence[int], sessions: Sequence[list[Visit]], *, is_offset: bool
) -> list[Outcome]:
    """Calibrate sessions and hold them against the truth."""
    return [
        outcome
        for seed, visits in zip(seeds, sessions, strict=True)
        for outcome in judge_session(name, seed, visits, is_offset=is_offset)
    ]


def print_outcomes(
    name: str,
    kind: str,
    n_captures: int,
    offset: str,
    seeds: Sequence[int],
    sessions: Sequence[list[Visit]],
) -> None:
    """Calibrate sessions and print a row."""
    outcomes = judge_sessions(name, seeds, sessions, is_offset=offset == "drawn")
    errors = np.array([each.error for each in outcomes])
    predicted, claimed = (
        np.array([getattr(each, key) for each in outcomes]) for key in ("predicted", "claimed")
    )
    pairs = [
        f"{rms(np.degrees(both[:, 0])):.4f} / {rms(1000 * both[:, 1]):.2f}" for both in (predicted, claimed)
    ]
    print_row(
        name,
        kind,
        len(outcomes),
        n_captures,
        offset,
        f"{rms(np.degrees(np.linalg.norm(errors[:, 3:], axis=1))):.4f}",
        f"{rms(1000 * np.linalg.norm(errors[:, :3], axis=1)):.2f}",
        *pairs,
    )


def random_session(name: str, seed: int, n_captures: int) -> list[Visit]:
    """Capture boards wherever the simulator's own placements put them."""
    rig = load_rig(name)
    options = SimulationOptions.for_rig(name)
    captures = simulate_captures(rig, n_captures=n_captures, seed=seed, options=options)
    return [_visit(rig, capture) for capture in captures]


def guided_session(name: str, seed: int, n_captures: int, person: Person | None = None) -> list[Visit]:
    """Capture boards where a person puts them who is told where to go."""
    person = person or Person()
    rig = load_rig(name)
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    nominal = rig.nominal(camera, lidar)
    assert nominal is not None
    view = SensorPlace.upright(model_sensors(rig, camera, lidar), nominal.to_matrix())
    planner = Planner(view)
    stage = set_stage(rig, seed, SimulationOptions.for_rig(name))
    rng = stage.rng(_PERSON)
    present = build_pose(view, HeldPose(0.0, 2.5, 0.0, 0.0, 0.0, 45.0))
    held, avoid = np.zeros((0, 4, 4)), np.zeros((0, 4, 4))
    visits: list[Visit] = []
    while len(visits) < n_captures:
        present, avoid = _go(planner, stage, person, held, present, avoid, rng)
        visit = _visit(rig, capture_at(stage, len(visits), stage.views[0].T_world_cam @ present))
        # As on a rig: nothing is captured while either sensor does not find the board.
        if isinstance(visit.image, ImageBoard) and isinstance(visit.scan, list):
            visits.append(visit)
            held = np.concatenate([held, visit.image.T_cam_board[None]])
        else:
            avoid = np.concatenate([avoid, present[None]])
    return visits


def _go(
    planner: Planner,
    stage: Stage,
    person: Person,
    held: Array,
    present: Array,
    avoid: Array,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Follow the guidance until both sensors see the board; give up what cannot be reached."""
    view = stage.views[0]
    while True:
        wanted = planner.guide(held, present, avoid).T_cam_board
        assert wanted is not None
        for _ in range(_TRIES):
            reached = person.follow(planner.view, present, wanted, rng)
            T_world_board = view.T_world_cam @ reached
            is_free = can_be_held(view, stage.board, stage.room, T_world_board)
            if is_free and count_rings(view, stage.board, T_world_board) >= stage.rig.quality.min_rings:
                return reached, avoid
        avoid = np.concatenate([avoid, wanted[None]])


def _visit(rig: Rig, capture: SimulatedCapture) -> Visit:
    image, scan = capture.images[0], capture.scans[0]
    truth = capture.T_cam_board[image.sensor]
    return Visit(BoardFinder(rig).image(image), BoardFinder(rig).scan(scan), truth)


def judge_session(name: str, seed: int, visits: list[Visit], *, is_offset: bool) -> Iterator[Outcome]:
    """Calibrate a session and hold it against the truth; nothing where there are too few captures.

    Args:
        name: of the rig.
        seed: of the session.
        visits: its captures.
        is_offset: whether all ranges are off by one error of the size that the profile states, which the
            simulator does not have by itself; the prediction allows for it only then.
    """
    rig = load_rig(name)
    camera, lidar = next(iter(rig.cameras)), next(iter(rig.lidars))
    sigma_m = rig.lidars[lidar].range_offset_sigma_m
    offset_m = sigma_m * np.random.default_rng([seed, _OFFSET]).standard_normal() if is_offset else 0.0
    names = [f"{k:06d}" for k in range(len(visits))]
    images = {name: visit.image for name, visit in zip(names, visits, strict=True)}
    scans = {name: lengthen(visit.scan, offset_m) for name, visit in zip(names, visits, strict=True)}
    detections = pipeline.Detections({(camera, "frames"): images}, {lidar: scans})
    try:
        (result, *_), _ = pipeline.calibrate_detections(rig, detections, CalibrateOptions(seed=seed))
    except NotEnoughDataError:
        return
    used = np.array([v.T_cam_board for n, v in zip(names, visits, strict=True) if n in result.captures_used])
    model = model_sensors(rig, camera, lidar)
    figures = result.diagnostics
    errors = model.errors.learned(figures.fit_plane_rms_m, figures.fit_edge_rms_m, len(used))
    errors = errors if is_offset else replace(errors, range_offset_m=0.0)
    nominal = rig.nominal(camera, lidar)
    assert nominal is not None
    evidence = weigh_placements(model.with_errors(errors), used, nominal.to_matrix())
    rotation, translation = sigmas(combine(evidence, errors).cov)
    truth = truth_extrinsics(rig, seed, SimulationOptions.for_rig(name))[camera, lidar]
    yield Outcome(
        difference(result.T_cam_lidar, truth),
        (float(rotation), float(translation)),
        (float(np.radians(result.sigma_rotation_deg)), result.sigma_translation_m),
    )


def lengthen(scan: pipeline.LidarDetection, offset_m: float) -> pipeline.LidarDetection:
    """Add an offset to all ranges of the boards found in a scan."""
    if not isinstance(scan, list) or offset_m == 0:
        return scan
    return [_lengthen(board, offset_m) for board in scan]


def _lengthen(board: LidarBoard, offset_m: float) -> LidarBoard:
    points, ends = (
        p * (1 + offset_m / np.linalg.norm(p, axis=1, keepdims=True))
        for p in (board.points, board.edge_points)
    )
    centre = board.T_lidar_board[:3, 3]
    moved = board.T_lidar_board.copy()
    moved[:3, 3] += offset_m * centre / np.linalg.norm(centre)
    return replace(board, points=points, edge_points=ends, plane=fit_plane(points)[0], T_lidar_board=moved)
