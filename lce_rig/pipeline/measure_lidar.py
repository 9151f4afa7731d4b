"""Estimate a LiDAR's constant errors from the boards of one or several sessions, for its profile."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.calibrate import (
    CalibrateOptions,
    CalibrationEstimate,
    Clocks,
    EstimateSettings,
    estimate_extrinsics,
)
from lce_rig.calibrate.algorithm_1.algorithm import solve
from lce_rig.calibrate.lidar_errors import LidarErrors, estimate_lidar
from lce_rig.calibrate.options import Tolerances
from lce_rig.core.board import Board
from lce_rig.core.calibration import MADE_BY
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, UsageError
from lce_rig.core.progress import Progress, silent
from lce_rig.core.results import Observation
from lce_rig.detect.detection import Detections
from lce_rig.judge.causes import MAX_PLANE_MISFIT_M
from lce_rig.pipeline.camera_intrinsics import write_profile
from lce_rig.pipeline.comparison import name_sessions, require_independent, require_one_board
from lce_rig.pipeline.detect_session import detect_boards
from lce_rig.rig import as_yaml, set_value
from lce_rig.session import Session

# Minimum ratio of a laser's range deviation before and after, for its new value to be written.
_LEAST_GAIN = 2.0
_FEWEST_CAPTURES = 8
_STILL = "Give sessions whose board stood still, on a stand. Omit this one."


def measure_lidar(
    sessions: Sequence[Session],
    lidar: str | None = None,
    *,
    found: Sequence[Detections] | None = None,
    progress: Progress = silent,
) -> LidarErrors:
    """Estimate the constant errors of a LiDAR from sessions of still boards seen by it and a frame camera.

    Args:
        sessions: at least one; the extrinsics may differ between them, the LiDAR and the board do not.
        lidar: the LiDAR's name in the profiles; None for the only one.
        found: detections of each session; None to detect the board first.
        progress: called with (done, total) while a session is read.

    Raises:
        UsageError: no such LiDAR, one without rings or with other range offsets, or a session given twice.
        SessionError: sessions of different boards, or with the same captures.
        NotEnoughDataError: too few captures that agree.
        ResultRefusedError: a session's boards moved; the captures determine neither the lasers' ranges nor an
            offset of them all.
    """
    rig = sessions[0].rig
    if not rig.lidars:
        raise UsageError(f"{sessions[0].path}: the rig has no LiDAR to measure", "Give a session of one.")
    name, named = lidar or next(iter(rig.lidars)), name_sessions(sessions)
    require_one_board(named)
    require_independent(named)
    for session in sessions:
        if name not in session.rig.lidars:
            raise UsageError(
                f"{session.path}: no LiDAR {name}", f"Choose of: {', '.join(session.rig.lidars)}."
            )
        if session.rig.lidars[name].range_offset_m != rig.lidars[name].range_offset_m:
            raise UsageError(
                f"{session.path} has another range_offset_m of {name} than {sessions[0].path}",
                "Calibrate all sessions with one profile first: `lce-rig calibrate SESSION --rig FILE`.",
            )
    board, settings = rig.board.to_board(), rig.lidars[name]
    if not settings.has_rings:
        raise UsageError(f"{name} ({settings.model}) has no lasers of its own", "Calibrate it as it is.")
    options = EstimateSettings.of(CalibrateOptions("paper"), settings)
    used, starts, of_session, scale_sigma = [], [], [], 0.0
    for k, session in enumerate(sessions):
        detections = detect_boards(session, progress=progress) if found is None else found[k]
        for pair in detections.pairs:
            channel = session.rig.cameras[pair.camera].channels[pair.channel]
            if pair.lidar != name or channel.kind != "frames":
                continue
            candidates, _ = detections.candidates(pair, board)
            clocks = Clocks.of(session.rig, pair.camera, pair.lidar)
            tolerances = Tolerances.of(session.rig.cameras[pair.camera], rig.board)
            # A lens error would displace the boards in the same way as range errors.
            with_lens = replace(options, tolerances=tolerances)
            estimate = estimate_extrinsics({pair.channel: candidates}, board, with_lens, clocks)
            _require_still(session, estimate)
            scale_sigma = max(
                scale_sigma, float(np.hypot(tolerances.lens.focal_length, tolerances.square_size))
            )
            of_session.append(session)
            used.append([estimate.observations[capture] for capture in estimate.used])
            starts.append(estimate.T_cam_lidar)
    n_captures = sum(map(len, used))
    if n_captures < _FEWEST_CAPTURES:
        raise NotEnoughDataError(
            f"{n_captures} captures of {name} agree with a frame camera (minimum {_FEWEST_CAPTURES})",
            "Collect more captures of a still board, or give more sessions of this LiDAR.",
        )
    errors = estimate_lidar(used, board, starts, options, scale_sigma or None, settings.range_offset_m)
    excess_m = 0.0 if errors.offset_m is None else errors.offset_m - settings.range_offset_m
    for session, observations in zip(of_session, used, strict=True):
        _require_planes_meet(session, observations, board, excess_m)
    if errors.gain[0] < _LEAST_GAIN:
        if errors.offset_m is not None:
            return replace(errors, has_lasers=False)
        after_mm, before_mm = 1e3 * np.median(errors.found.lasers_sigma[0]), 1e3 * errors.prior_sigma[0]
        raise ResultRefusedError(
            f"{n_captures} captures do not determine the lasers' ranges: standard deviation {after_mm:.1f}, "
            f"without them {before_mm:.1f} mm ({before_mm / _LEAST_GAIN:.1f} mm at most)",
            "Collect more captures, with the board at several heights, so that each laser hits it in many.",
        )
    return errors


def _require_still(session: Session, estimate: CalibrationEstimate) -> None:
    """Refuse boards that moved during captures: lens and lasers would absorb the motion."""
    if any(channel.time_offset_s is not None for channel in estimate.channels):
        raise ResultRefusedError(f"{session.path}: the board moved while it was captured", _STILL)


def _require_planes_meet(
    session: Session, observations: Sequence[Observation], board: Board, excess_m: float
) -> None:
    """Refuse boards that moved between image and scan, from their planes after range correction."""
    nearer = [replace(o, surface=o.lidar.corrected(excess_m)) if excess_m else o for o in observations]
    rms_m, limit_m = solve(nearer, board).diagnostics.fit_plane_rms_m, MAX_PLANE_MISFIT_M
    if rms_m > limit_m:
        what = f"{session.path}: camera and LiDAR board planes differ by {1e3 * rms_m:.0f} mm rms"
        raise ResultRefusedError(f"{what} (still boards: under {1e3 * limit_m:.0f} mm)", _STILL)


# Range, azimuth and elevation of each laser, and their standard deviations.
_OF_LASER = ("range_m", "azimuth_deg", "elevation_deg")
_SIGMAS = ("range_sigma_m", "azimuth_sigma_deg", "elevation_sigma_deg")


def lidar_document(errors: LidarErrors) -> dict[str, Any]:
    """Return a LiDAR's errors by profile key; only the range offset if lasers are undetermined."""
    estimate = errors.found
    in_degrees = np.array([1.0, np.degrees(1.0), np.degrees(1.0)])
    figures = np.hstack([estimate.lasers.T * in_degrees, estimate.lasers_sigma.T * in_degrees]).round(7)
    offset = {"range_offset_m": errors.offset_m, "range_offset_sigma_m": errors.offset_sigma_m}
    shown = {name: None if value is None else round(value, 5) for name, value in offset.items()}
    if not errors.has_lasers:
        return {"n_captures": list(errors.n_captures), **shown}
    lens, lens_sigma = estimate.lens.round(7).tolist(), estimate.lens_sigma.round(7).tolist()
    return {
        "n_captures": list(errors.n_captures),
        **shown,
        "lens_lateral_m": lens[0],
        "lens_lateral_sigma_m": lens_sigma[0],
        "lens_vertical_m_per_rad": lens[1],
        "lens_vertical_sigma_m_per_rad": lens_sigma[1],
        "lasers": [
            {"ring": ring, "n_points": int(n), **dict(zip((*_OF_LASER, *_SIGMAS), row, strict=True))}
            for ring, n, row in zip(estimate.rings.tolist(), errors.n_points, figures.tolist(), strict=True)
        ],
    }


def save_lidar(session: Session, lidar: str | None, errors: LidarErrors, path: Path) -> None:
    """Write a session's profile with measured errors of a LiDAR to a new file.

    Raises:
        UsageError: the file exists already.
    """
    name, block = lidar or next(iter(session.rig.lidars)), lidar_document(errors)
    n = sum(block.pop("n_captures"))
    offset = {key: block.pop(key) for key in ("range_offset_m", "range_offset_sigma_m")}
    for row in block.get("lasers", ()):
        del row["n_points"]
    stated = {key: value for key, value in offset.items() if value is not None}
    text = session.profile_text()
    for key, value in (stated | ({"intrinsics": block} if block else {})).items():
        text = set_value(text, f"lidars.{name}.{key}", as_yaml(value))
    write_profile(f"# intrinsics of LiDAR {name}, measured by {MADE_BY} from {n} captures\n" + text, path)
