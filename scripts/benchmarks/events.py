"""The simulated rig with an event camera and boards moved by hand: frames, events and both against truth."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

import lce_rig as lce
from benchmarks.measured import DEG_MM, measure
from benchmarks.tables import compare, print_head, print_row, rms
from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.geometry import Array, difference, transform
from lce_rig.core.results import ImageBoard
from lce_rig.detect.detection import Detections, ImageDetection
from lce_rig.judge.reach import covariance_alone
from lce_rig.pipeline.calibration import calibrate_detections
from lce_rig.rig import Rig, load_rig
from lce_rig.session import Session
from lce_rig.simulate import (
    HandMotion,
    SimulatedCapture,
    SimulationOptions,
    simulate_captures,
    truth_extrinsics,
)

CAMERA, LIDAR = "davis", "lidar"
# By how much more stamps read than the LiDAR's clock, unknown to the calibration.
FRAME_OFFSET_S, EVENT_OFFSET_S = 0.012, -0.008
CHOICES: tuple[tuple[str, ...], ...] = (("frames",), ("events",), ("events", "frames"))


@dataclass(frozen=True)
class ChannelRun:
    """Result of one choice of channels in one session."""

    deg: float
    mm: float
    sigma_deg: float
    sigma_mm: float
    nees: float


@dataclass
class SessionRun:
    """Results of one simulated session: errors by choice of channels, and corners by channel."""

    runs: dict[str, ChannelRun] = field(default_factory=dict)
    corner_px: dict[str, list[float]] = field(default_factory=dict)
    n_captures: int = 0
    clock_error_s: dict[str, float] = field(default_factory=dict)


def bench_events(n_seeds: int, n_captures: int = 30) -> None:
    """Tabulate frames, events and both."""
    work = partial(_session, n_captures=n_captures)
    with ProcessPoolExecutor(2) as pool:
        sessions = list(pool.map(work, range(n_seeds)))
    head = "channels, sessions, boards found, corner rms px, rms deg, rms mm, reported deg / mm, NEES"
    print_head(*head.split(", "), "clock rms ms")
    for name in ("frames", "events", "events+frames"):
        print_row(*_row(name, sessions))


def _row(name: str, sessions: Sequence[SessionRun]) -> tuple[object, ...]:
    runs = [session.runs[name] for session in sessions if name in session.runs]
    corners = [px for session in sessions for px in session.corner_px.get(name, [])]
    n = sum(session.n_captures for session in sessions)
    clocks = [session.clock_error_s[name] for session in sessions if name in session.clock_error_s]
    key = f"events.{name}"
    if corners:
        measure(f"{key}.found", "{} of {}", len(corners), n)
        measure(f"{key}.corners", "{:.2f} px", rms(np.array(corners)))
    if runs:
        measure(f"{key}.rms", DEG_MM, rms([run.deg for run in runs]), rms([run.mm for run in runs]))
        claimed = rms([run.sigma_deg for run in runs]), rms([run.sigma_mm for run in runs])
        measure(f"{key}.claim", DEG_MM, *claimed)
    if clocks:
        measure(f"{key}.clock", "{:.1f} ms", 1000 * rms(np.array(clocks)))
    errors = (
        ("-",) * 4
        if not runs
        else (
            f"{rms(np.array([run.deg for run in runs])):.3f}",
            f"{rms(np.array([run.mm for run in runs])):.2f}",
            f"{rms(np.array([run.sigma_deg for run in runs])):.3f} / "
            f"{rms(np.array([run.sigma_mm for run in runs])):.2f}",
            f"{np.mean([run.nees for run in runs]):.1f}",
        )
    )
    return (
        name,
        len(runs),
        "-" if "+" in name else f"{len(corners)} of {n}",
        f"{rms(np.array(corners)):.3f}" if corners else "-",
        *errors,
        f"{1000 * rms(np.array(clocks)):.1f}" if clocks else "-",
    )


def _session(seed: int, n_captures: int) -> SessionRun:
    """Simulate, detect and calibrate one session."""
    rig = load_rig("rles")
    options = replace(
        SimulationOptions.for_rig("rles", "moving"),
        hand=HandMotion(speed_mps=(0.08, 0.3)),
        frame_offset_s=FRAME_OFFSET_S,
        event_offset_s=EVENT_OFFSET_S,
    )
    truth = truth_extrinsics(rig, seed, options)[CAMERA, LIDAR]
    with tempfile.TemporaryDirectory() as scratch:
        captures: dict[str, SimulatedCapture] = {}
        with Session.create(Path(scratch) / "session", rig) as session:
            for capture in simulate_captures(rig, n_captures=n_captures, seed=seed, options=options):
                name = session.add_capture(capture.images, capture.scans, {}, events=capture.events)
                captures[name] = capture
            return _assess(rig, lce.detect_boards(session, n_threads=1), captures, truth)


def _assess(
    rig: Rig,
    detections: Detections,
    captures: dict[str, SimulatedCapture],
    truth: Array,
) -> SessionRun:
    run = SessionRun(n_captures=len(captures))
    for channel in ("frames", "events"):
        found = detections.images.get((CAMERA, channel), {})
        run.corner_px[channel] = list(_corner_errors(rig, channel, found, captures))
    for channels in CHOICES:
        try:
            (calibration, *_), _ = calibrate_detections(rig, detections, channels=channels)
        except NotEnoughDataError:
            continue
        deg, mm = compare(calibration.T_cam_lidar, truth)
        off = difference(calibration.T_cam_lidar, truth)
        nees = float(off @ np.linalg.solve(covariance_alone(calibration), off))
        sigmas = calibration.sigma_rotation_deg, 1000 * calibration.sigma_translation_m
        run.runs["+".join(sorted(channels))] = ChannelRun(deg, mm, *sigmas, nees)
        for result in calibration.channel_results:
            expected_s = -(FRAME_OFFSET_S if result.channel == "frames" else EVENT_OFFSET_S)
            if result.time_offset_s is not None:
                run.clock_error_s[result.channel] = result.time_offset_s - expected_s
    return run


def _corner_errors(
    rig: Rig, channel: str, found: Mapping[str, ImageDetection], captures: dict[str, SimulatedCapture]
) -> Iterator[float]:
    """Return the rms corner error of each image with a detected board, px per coordinate."""
    intrinsics, corners = rig.cameras[CAMERA].to_intrinsics(), rig.board.to_board().corners()
    offset_s = FRAME_OFFSET_S if channel == "frames" else EVENT_OFFSET_S
    for name, board in found.items():
        if isinstance(board, ImageBoard) and board.stamp_ns is not None:
            T = captures[name].T_sensor_board(CAMERA, board.stamp_ns - round(1e9 * offset_s))
            true_px, _ = intrinsics.project(transform(T, corners))
            yield min(rms(board.corners_px - true_px), rms(board.corners_px[::-1] - true_px))
