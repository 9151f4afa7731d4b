"""An extrinsic held against every capture of a session: residuals, one picture each, one sheet for all."""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.calibrate.estimate import CaptureResidual
from lce_rig.calibrate.matching import match_candidates
from lce_rig.calibrate.metrics import capture_residual, summarise
from lce_rig.calibrate.options import CaptureCandidates
from lce_rig.core.errors import SessionError
from lce_rig.core.results import Calibration, ImageBoard, Metrics, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.verify.canvas import Picture
from lce_rig.verify.contact_sheet import contact_sheet
from lce_rig.verify.overlay import draw_overlay
from lce_rig.verify.picture_file import write_picture

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SessionCheck:
    """How an extrinsic fits the captures of a session.

    Attributes:
        pair: the sensors.
        verdict: of the calibration that is checked.
        residuals: of each capture in which both sensors see the board.
        metrics: their summary; None without any.
        used: captures that the calibration was fitted to.
        pictures: one a capture.
        contact_sheet: all of them on one sheet.
    """

    pair: Pair
    verdict: str
    residuals: tuple[CaptureResidual, ...]
    metrics: Metrics | None
    used: tuple[str, ...]
    pictures: tuple[Path, ...]
    contact_sheet: Path | None

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "camera": self.pair.camera,
            "channel": self.pair.channel,
            "lidar": self.pair.lidar,
            "verdict": self.verdict,
            "metrics": None
            if self.metrics is None
            else {**asdict(self.metrics), "mge_m": self.metrics.mge_m},
            "captures": {r.capture: _figures(r, self.used) for r in self.residuals},
            "pictures": [str(path) for path in self.pictures],
        }


def _figures(residual: CaptureResidual, used: tuple[str, ...]) -> dict[str, Any]:
    names = ("plane_mean_m", "plane_rms_m", "edge_mean_m", "edge_rms_m", "reprojection_px")
    return {"was_used": residual.capture in used, **{name: getattr(residual, name) for name in names}}


def check_session(
    session: Session,
    detections: Detections,
    calibration: Calibration,
    folder: Path,
    progress: Progress,
) -> SessionCheck:
    """Measure and draw how an extrinsic fits every capture that both sensors have samples of.

    Args:
        session: whose captures are looked at; the calibration may come from another of the same rig.
        detections: of the session.
        calibration: the extrinsic.
        folder: receives `<capture>.png` and `contact_sheet.png`.
        progress: called with (done, total).

    Raises:
        SessionError: the session has no such sensors, or a picture cannot be written.
    """
    pair = Pair(calibration.camera, calibration.channel, calibration.lidar)
    if pair not in detections.pairs:
        raise SessionError(
            f"{session.path} holds no captures of {pair}", "The result belongs to another session."
        )
    names = detections.captures(pair)
    residuals: list[CaptureResidual] = []
    tiles: list[tuple[str, Picture]] = []
    pictures: list[Path] = []
    for done, name in enumerate(names, start=1):
        observation = _observe(session.rig, detections, pair, name, calibration)
        if observation is not None:
            residuals.append(
                capture_residual(calibration.T_cam_lidar, observation, session.rig.board.to_board())
            )
        picture = _draw(session.capture(name), session.rig, calibration, observation, residuals)
        if picture is not None:
            path = folder / f"{name}.png"
            write_picture(path, picture)
            pictures.append(path)
            tiles.append((name, picture))
        progress(done, len(names))
    sheet = folder / "contact_sheet.png" if tiles else None
    if sheet is not None:
        write_picture(sheet, contact_sheet(tiles))
    metrics = summarise(residuals) if residuals else None
    return SessionCheck(
        pair,
        calibration.verdict,
        tuple(residuals),
        metrics,
        calibration.captures_used,
        tuple(pictures),
        sheet,
    )


def _observe(
    rig: Rig, detections: Detections, pair: Pair, name: str, calibration: Calibration
) -> Observation | None:
    image, lidar = detections.of(pair, name)
    if not isinstance(image, ImageBoard) or not isinstance(lidar, list):
        return None
    candidates = CaptureCandidates(name, image, lidar)
    return match_candidates(candidates, rig.board.to_board(), calibration.T_cam_lidar)


def _draw(
    capture: Capture,
    rig: Rig,
    calibration: Calibration,
    observation: Observation | None,
    residuals: list[CaptureResidual],
) -> Picture | None:
    """Draw one capture; None where it cannot be read."""
    try:
        image = capture.image(calibration.camera, calibration.channel)
        scan = capture.scan(calibration.lidar)
    except SessionError:
        return None
    return draw_overlay(
        image,
        scan,
        rig.cameras[calibration.camera].to_intrinsics(),
        calibration.T_cam_lidar,
        lidar_board=None if observation is None else observation.lidar,
        image_board=None if observation is None else observation.image,
        board=rig.board.to_board(),
        residuals=_legend(None if observation is None else residuals[-1], calibration),
        title=f"{rig.name}  {calibration.camera}.{calibration.channel} and {calibration.lidar}  {capture.name}",
    )


def _legend(residual: CaptureResidual | None, calibration: Calibration) -> Mapping[str, float | str]:
    figures: dict[str, float | str] = {}
    if residual is not None:
        figures = {
            "planes (mm)": round(1000 * residual.plane_mean_m, 1),
            "edges (mm)": round(1000 * residual.edge_mean_m, 1),
            "corners (px)": round(residual.reprojection_px, 2),
        }
    name = "" if residual is None else residual.capture
    why = calibration.captures_refused.get(name)
    figures["capture"] = "used" if name in calibration.captures_used else why.cause if why else "not used"
    figures["sigma"] = (
        f"{calibration.sigma_rotation_deg:.2g} deg, {1000 * calibration.sigma_translation_m:.2g} mm"
    )
    figures["verdict"] = calibration.verdict
    return {
        key: value for key, value in figures.items() if not (isinstance(value, float) and np.isnan(value))
    }
