"""Check deployed extrinsics on recordings without a board: the edges of the scene decide."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lce_rig.core.data import Image, Scan
from lce_rig.core.errors import SessionError, SourceError
from lce_rig.core.geometry import transform
from lce_rig.core.results import Calibration, ImageBoard, Refusal
from lce_rig.detect.events.figures import outline_px
from lce_rig.detect.finder import BoardFinder
from lce_rig.detect.lidar.measurement import Beam
from lce_rig.export.result import SavedResult, read_result
from lce_rig.pipeline.detect_session import Progress, silent
from lce_rig.pipeline.result_files import RESULT, result_parts
from lce_rig.recordings import open_recordings
from lce_rig.recordings.protocol import PairedRecording
from lce_rig.rig import Rig
from lce_rig.scene.alignment import SceneView
from lce_rig.scene.depth_edges import find_depth_edges
from lce_rig.scene.drift import AxisDrift, Drift, watch
from lce_rig.scene.edge_field import build_edge_field
from lce_rig.session import Session
from lce_rig.verify.drift_picture import draw_drift
from lce_rig.verify.overlay_files import write_picture
from lce_rig.words import as_json

MAX_CAPTURES = 60
"""More captures add time and memory but, of one place, no information: they are thinned out evenly."""
_BOARD_MARGIN_RAD = 0.04  # Extrinsics may be off by as much.


@dataclass(frozen=True, eq=False)
class PairDrift:
    """What a scene says about one camera and LiDAR.

    Attributes:
        calibration: the deployed extrinsics.
        drift: the verdict.
        example: the capture drawn by `write`; None without any.
    """

    calibration: Calibration
    drift: Drift
    example: tuple[str, Image, SceneView] | None

    def document(self) -> dict[str, Any]:
        """List everything as plain types for JSON."""
        return {
            "camera": self.calibration.camera,
            "lidar": self.calibration.lidar,
            "state": self.drift.state,
            "n_captures": self.drift.n_captures,
            "n_edges": self.drift.n_edges,
            "axes": [_axis(axis) for axis in self.drift.axes],
            "T_cam_lidar": self.drift.T_cam_lidar.tolist(),
            "T_cam_lidar_best": self.drift.T_best.tolist(),
            "covariance_best": None if self.drift.cov_best is None else self.drift.cov_best.tolist(),
            "findings": [as_json(finding) for finding in self.drift.findings],
        }


def _axis(axis: AxisDrift) -> dict[str, Any]:
    unit = "deg" if axis.is_rotation else "m"
    figures = {"change": axis.change, "sigma": axis.sigma, "smallest": axis.smallest}
    finite = {f"{name}_{unit}": value if np.isfinite(value) else None for name, value in figures.items()}
    return {"axis": axis.axis, "state": axis.state, **finite, "instead": list(axis.instead)}


@dataclass(frozen=True, eq=False)
class DriftReport:
    """What a scene says about the extrinsics of a result.

    Attributes:
        rig: the profile.
        pairs: one for each camera and LiDAR of the result.
    """

    rig: Rig
    pairs: tuple[PairDrift, ...]

    def write(self, folder: Path) -> list[Path]:
        """Draw each pair: edges under the deployed and the best extrinsics, and the score along each axis.

        Raises:
            SessionError: a file cannot be written.
        """
        files = []
        for pair in self.pairs:
            if pair.example is None:
                continue
            name, image, view = pair.example
            c = pair.calibration
            lens = self.rig.cameras[c.camera].to_intrinsics()
            picture = draw_drift(pair.drift, image, view.edges, lens, f"{c.camera}, {c.lidar}  {name}")
            files.append(write_picture(folder / f"drift_{c.camera}_{c.lidar}.png", picture))
        return files


def drift(
    source: Path,
    result: SavedResult | None = None,
    *,
    rig: Rig | None = None,
    ignore_board: bool = False,
    progress: Progress = silent,
) -> DriftReport:
    """Compare the extrinsics of a result with the scene of a session or of a recording.

    Args:
        source: a session, or a recording of pairs of images and scans.
        result: the deployed extrinsics; None for the session's own result.
        rig: the profile of a recording; a session has its own.
        ignore_board: leave out the edges at the board of a session, where its images show one.
        progress: called with (done, total) captures.

    Raises:
        SessionError: there is no result, it belongs to another rig, or the session cannot be read.
        SourceError: the recording cannot be read, or holds no pairs of images and scans.
    """
    session = Session.open(source) if rig is None else None
    rig = rig or (session.rig if session else None)
    assert rig is not None
    if result is None:
        if session is None:
            raise SessionError(f"{source} is not a session and has no result", "Name one with --result FILE.")
        result = read_result(session.path.joinpath(*result_parts(None), RESULT))
    if result.rig != rig.name or not result.pairs:
        what = f"the result belongs to rig {result.rig!r}" if result.pairs else "the result holds no pair"
        raise SessionError(f"{what}; {source} belongs to rig {rig.name!r}")
    pairs = []
    for calibration in result.pairs:
        if rig.cameras[calibration.camera].first_channel("frames") is None:
            raise SourceError(
                f"camera {calibration.camera} has no channel of frames", "`drift` does not use events yet."
            )
        pairs.append(_watch_pair(rig, session, source, calibration, ignore_board, progress))
    return DriftReport(rig, tuple(pairs))


def _watch_pair(
    rig: Rig,
    session: Session | None,
    source: Path,
    calibration: Calibration,
    ignore_board: bool,
    progress: Progress,
) -> PairDrift:
    lens = rig.cameras[calibration.camera].to_intrinsics()
    views: list[SceneView] = []
    example: tuple[str, Image, SceneView] | None = None
    samples = (
        _session_samples(session, calibration, progress)
        if session is not None
        else _recorded_samples(source, rig, calibration, progress)
    )
    for name, image, scan in samples:
        view = build_view(rig, calibration, name, image, scan)
        if ignore_board:
            view = without_board(view, BoardFinder(rig).image(image), rig, calibration)
        views.append(view)
        if example is None or len(view.edges) > len(example[2].edges):
            example = name, image, view
    return PairDrift(calibration, watch(views, lens, calibration.T_cam_lidar, calibration.cov), example)


def build_view(rig: Rig, calibration: Calibration, name: str, image: Image, scan: Scan) -> SceneView:
    """Find the edges of one capture's scan and image."""
    lidar, lens = rig.lidars[calibration.lidar], rig.cameras[calibration.camera].to_intrinsics()
    edges = find_depth_edges(scan, Beam(lidar.beam_aperture_m, lidar.beam_divergence_rad))
    return SceneView(name, edges, build_edge_field(image.grey, lens.fx_px))


def without_board(
    view: SceneView, found: ImageBoard | Refusal, rig: Rig, calibration: Calibration
) -> SceneView:
    """Leave out the edges at and near the board, if the image shows one."""
    if isinstance(found, Refusal):
        return view
    lens = rig.cameras[calibration.camera].to_intrinsics()
    outline = outline_px(found.T_cam_board, rig.board.to_board(), lens)
    hull = cv2.convexHull(outline[np.isfinite(outline).all(axis=1)].astype(np.float32))
    pixels, _ = lens.project(transform(calibration.T_cam_lidar, view.edges.points))
    margin_px = _BOARD_MARGIN_RAD * lens.fx_px
    is_apart = [cv2.pointPolygonTest(hull, pixel, True) < -margin_px for pixel in pixels.tolist()]
    return replace(view, edges=view.edges.select(np.array(is_apart, dtype=bool)))


def _session_samples(
    session: Session, calibration: Calibration, progress: Progress
) -> Iterator[tuple[str, Image, Scan]]:
    """Read the image and the scan of the captures that have both; damaged ones are skipped."""
    camera, lidar = calibration.camera, calibration.lidar
    channel = session.rig.cameras[camera].first_channel("frames") or ""
    captures = [c for c in session.captures if c.has_image(camera, channel) and lidar in c.lidars]
    chosen = _thinned(captures)
    for done, capture in enumerate(chosen, start=1):
        with suppress(SessionError):
            sample = capture.name, capture.image(camera, channel), capture.scan(lidar)
            yield sample
        progress(done, len(chosen))


def _recorded_samples(
    source: Path, rig: Rig, calibration: Calibration, progress: Progress
) -> Iterator[tuple[str, Image, Scan]]:
    """Read the pairs of a folder of images and point clouds.

    Raises:
        SourceError: there are none, or one cannot be read.
    """
    recordings = [each for each in open_recordings([source], rig) if isinstance(each, PairedRecording)]
    pairs = _thinned([pair for recording in recordings for pair in recording.pairs])
    if not pairs:
        raise SourceError(
            f"{source} holds no pairs of images and scans", "Build a session from it with `lce-rig collect`."
        )
    for done, files in enumerate(pairs, start=1):
        pair = files.read()
        images = [image for image in pair.images if image.sensor == calibration.camera]
        scans = [scan for scan in pair.scans if scan.sensor == calibration.lidar]
        if images and scans:
            yield pair.label, images[0], scans[0]
        progress(done, len(pairs))


def _thinned(items: Sequence[Any]) -> list[Any]:
    if len(items) <= MAX_CAPTURES:
        return list(items)
    return [items[k] for k in np.linspace(0, len(items) - 1, MAX_CAPTURES).round().astype(int)]
