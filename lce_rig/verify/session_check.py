"""An extrinsic held against every capture of a session: residuals, one picture each, one sheet for all."""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lce_rig.calibrate.estimate import CaptureResidual
from lce_rig.calibrate.matching import match_candidates
from lce_rig.calibrate.metrics import capture_residual, summarise
from lce_rig.calibrate.options import CaptureCandidates
from lce_rig.calibrate.verdict import residuals_beyond
from lce_rig.core.errors import SessionError
from lce_rig.core.results import Calibration, ImageBoard, Metrics, Observation
from lce_rig.detect.detection import Detections, Pair
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.verify.canvas import Picture
from lce_rig.verify.overlay import camera_part, draw_overlay
from lce_rig.verify.writing import write_overlays

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SessionCheck:
    """How an extrinsic fits the captures of a session.

    Attributes:
        pair: the sensors.
        verdict: of the calibration that is checked.
        doubts: why these captures contradict it; empty where they agree.
        residuals: of each capture in which both sensors see the board.
        metrics: their summary; None without any.
        used: captures that the calibration was fitted to.
        pictures: one a capture.
        contact_sheet: all of them on one sheet.
    """

    pair: Pair
    verdict: str
    doubts: tuple[str, ...]
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
            "doubts": list(self.doubts),
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
    pair = Pair.of(calibration)
    if pair not in detections.pairs:
        hint = "The result belongs to another session."
        raise SessionError(f"{session.path} holds no captures of {pair}", hint)
    board = session.rig.board.to_board()
    residuals: list[CaptureResidual] = []

    def overlays() -> Iterator[tuple[str, Picture, Picture]]:
        names = detections.captures(pair)
        for done, name in enumerate(names, start=1):
            observation = _observe(session.rig, detections, pair, name, calibration)
            residual = None
            if observation is not None:
                residual = capture_residual(calibration.T_cam_lidar, observation, board)
                residuals.append(residual)
            yield from _draw(session.capture(name), session.rig, calibration, observation, residual)
            progress(done, len(names))

    files = write_overlays(folder, overlays())
    metrics = summarise(residuals) if residuals else None
    used = calibration.captures_used
    sheet = files[-1] if files else None
    return SessionCheck(
        pair,
        calibration.verdict,
        contradictions(metrics, session.rig),
        tuple(residuals),
        metrics,
        used,
        tuple(files[:-1]),
        sheet,
    )


def contradictions(metrics: Metrics | None, rig: Rig) -> tuple[str, ...]:
    """Say where captures contradict an extrinsic: residuals beyond the limits, or no board at all."""
    if metrics is None:
        return ("no capture shows the board to both sensors",)
    return tuple(residuals_beyond(metrics, rig.quality))


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
    residual: CaptureResidual | None,
) -> Iterator[tuple[str, Picture, Picture]]:
    """Draw one capture; nothing where it cannot be read."""
    try:
        image = capture.image(calibration.camera, calibration.channel)
        scan = capture.scan(calibration.lidar)
    except SessionError:
        return
    picture = draw_overlay(
        image,
        scan,
        rig.cameras[calibration.camera].to_intrinsics(),
        calibration.T_cam_lidar,
        lidar_board=None if observation is None else observation.lidar,
        image_board=None if observation is None else observation.image,
        board=rig.board.to_board(),
        residuals=_legend(capture.name, residual, calibration),
        title=f"{rig.name}  {Pair.of(calibration)}  {capture.name}",
    )
    yield capture.name, picture, camera_part(picture, image)


def _legend(name: str, residual: CaptureResidual | None, calibration: Calibration) -> dict[str, float | str]:
    figures: dict[str, float | str] = {}
    if residual is not None:
        figures = {
            "planes (mm)": round(1000 * residual.plane_mean_m, 1),
            "edges (mm)": round(1000 * residual.edge_mean_m, 1),
            "corners (px)": round(residual.reprojection_px, 2),
        }
    refusal = calibration.captures_refused.get(name)
    is_used = name in calibration.captures_used
    figures["capture"] = "used" if is_used else f"refused, {refusal.stage}" if refusal else "not used"
    figures["sigma"] = (
        f"{calibration.sigma_rotation_deg:.2g} deg, {1000 * calibration.sigma_translation_m:.2g} mm"
    )
    figures["verdict"] = calibration.verdict
    return figures
