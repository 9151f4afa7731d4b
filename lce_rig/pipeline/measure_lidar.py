"""A LiDAR's constant errors from the boards of one or several sessions, and a profile that states them."""

from collections.abc import Sequence
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
from lce_rig.calibrate.together import LidarErrors, estimate_lidar
from lce_rig.core.calibration import MADE_BY
from lce_rig.core.errors import NotEnoughDataError, ResultRefusedError, UsageError
from lce_rig.core.progress import Progress, silent
from lce_rig.detect.detection import Detections
from lce_rig.judge.verdict import MAX_PLANE_MISFIT_M
from lce_rig.pipeline.camera_intrinsics import write_profile
from lce_rig.pipeline.detect_session import candidates_of, detect
from lce_rig.rig import as_yaml, set_value
from lce_rig.session import Session

# A laser's range must be known so much better than before for a profile to state it.
_LEAST_GAIN = 2.0
_FEWEST_CAPTURES = 8


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
        lidar: its name in the profiles; None for the only one.
        found: detections of each session; None detects the board first.
        progress: called with (done, total) while a session is read.

    Raises:
        UsageError: sessions of different boards or LiDARs, or a LiDAR without rings.
        NotEnoughDataError: too few captures that agree.
        ResultRefusedError: a session's boards moved; the captures do not determine the lasers' ranges.
    """
    rig = sessions[0].rig
    name = lidar or next(iter(rig.lidars))
    for session in sessions:
        if name not in session.rig.lidars:
            raise UsageError(
                f"{session.path}: no LiDAR {name}", f"Choose of: {', '.join(session.rig.lidars)}."
            )
        if session.rig.board != rig.board:
            raise UsageError(
                f"{session.path} has another board than {sessions[0].path}", "Give sessions of one board."
            )
    board, settings = rig.board.to_board(), rig.lidars[name]
    if not settings.has_rings:
        raise UsageError(f"{name} ({settings.model}) has no lasers of its own", "Calibrate it as it is.")
    options = EstimateSettings.of(CalibrateOptions("paper"), settings)
    used, starts = [], []
    for k, session in enumerate(sessions):
        detections = detect(session, progress=progress) if found is None else found[k]
        for pair in detections.pairs:
            channel = session.rig.cameras[pair.camera].channels[pair.channel]
            if pair.lidar != name or channel.kind != "frames":
                continue
            candidates, _ = candidates_of(detections, pair)
            clocks = Clocks.of(session.rig, pair.camera, pair.lidar)
            estimate = estimate_extrinsics({pair.channel: candidates}, board, options, clocks)
            _require_still(session, estimate)
            used.append([estimate.observations[capture] for capture in estimate.used])
            starts.append(estimate.T_cam_lidar)
    n_captures = sum(map(len, used))
    if n_captures < _FEWEST_CAPTURES:
        raise NotEnoughDataError(
            f"{n_captures} captures of {name} agree with a frame camera ({_FEWEST_CAPTURES} needed)",
            "Collect more captures of a still board, or give more sessions of this LiDAR.",
        )
    errors = estimate_lidar(used, board, starts, options)
    if errors.gain[0] < _LEAST_GAIN:
        after_mm, before_mm = 1e3 * np.median(errors.found.lasers_sigma[0]), 1e3 * errors.prior_sigma[0]
        raise ResultRefusedError(
            f"{n_captures} captures do not determine the lasers' ranges: standard deviation {after_mm:.1f}, "
            f"without them {before_mm:.1f} mm ({before_mm / _LEAST_GAIN:.1f} mm at most)",
            "Collect more captures, with the board at several heights, so that each laser meets it in many.",
        )
    return errors


def _require_still(session: Session, estimate: CalibrationEstimate) -> None:
    """Refuse boards that moved between image and scan: the lens and the lasers would absorb the motion."""
    if any(channel.time_offset_s is not None for channel in estimate.channels):
        what = f"{session.path}: the board moved while it was captured"
    else:
        rms_m, limit_m = estimate.diagnostics.fit_plane_rms_m, MAX_PLANE_MISFIT_M
        if rms_m <= limit_m:
            return
        what = (
            f"{session.path}: camera and LiDAR board planes differ by {1e3 * rms_m:.0f} mm rms "
            f"(still boards: under {1e3 * limit_m:.0f} mm)"
        )
    raise ResultRefusedError(what, "Give sessions whose board stood still, on a stand. Leave this one out.")


# Of each laser: range, azimuth and elevation, and their standard deviations.
_OF_LASER = ("range_m", "azimuth_deg", "elevation_deg")
_SIGMAS = ("range_sigma_m", "azimuth_sigma_deg", "elevation_sigma_deg")


def lidar_document(errors: LidarErrors) -> dict[str, Any]:
    """List a LiDAR's errors by the keys that they have in a profile."""
    estimate = errors.found
    in_degrees = np.array([1.0, np.degrees(1.0), np.degrees(1.0)])
    figures = np.hstack([estimate.lasers.T * in_degrees, estimate.lasers_sigma.T * in_degrees]).round(7)
    lens, lens_sigma = estimate.lens.round(7).tolist(), estimate.lens_sigma.round(7).tolist()
    return {
        "n_captures": list(errors.n_captures),
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
    for row in block["lasers"]:
        del row["n_points"]
    text = set_value(session.profile_text(), f"lidars.{name}.intrinsics", as_yaml(block))
    write_profile(f"# intrinsics of LiDAR {name}, measured by {MADE_BY} from {n} captures\n" + text, path)
