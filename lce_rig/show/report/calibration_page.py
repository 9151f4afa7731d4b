"""The report of a calibration: its verdict, its effect on a point, and the evidence, on one page."""

import base64
import hashlib
import os
import shlex
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import cv2
import numpy as np
from markupsafe import Markup

from lce_rig.collect.findings import GUIDE_ADD
from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration, ResultFile
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array
from lce_rig.core.phrasing import as_line, significant
from lce_rig.detect.detection import Pair
from lce_rig.detect.events.figures import outline_px
from lce_rig.judge.findings import advice_of
from lce_rig.judge.reach import USUAL_M
from lce_rig.rig import Rig
from lce_rig.session import Capture, Session
from lce_rig.show.overlays.canvas import Thumbnail, Thumbnails, accumulated, reduced
from lce_rig.show.page import render
from lce_rig.show.report import calibration_drawings as drawings
from lce_rig.show.report.calibration_drawings import Evidence, gather
from lce_rig.show.tables import result_tables, rig_table, scene_words

_LENS_CODES, _PLAN = ("verdict.intrinsics", "verdict.scale"), GUIDE_ADD.code
# Ratio to the median residual from which captures are marked; maximum number of images on a page.
_STANDS_OUT, _MOST_PICTURES = 2.0, 96


def report_page(
    session: Session,
    file: ResultFile,
    overlays: str,
    thumbnails: Thumbnails | None = None,
    *,
    has_previous: bool = False,
) -> str:
    """Write the report of a result as one HTML file: the same result gives the same bytes.

    Args:
        session: session of the result.
        file: the result.
        overlays: the folder of overlays beside the report, which shows them once they are drawn.
        thumbnails: available thumbnails of the session; the page is the same without them.
        has_previous: whether `previous/` beside the report holds a usable result.
    """
    origin, folder = file.provenance, session.path.resolve().name
    facts = [
        ("rig", file.rig),
        ("robot", origin.robot),
        ("date of the captures", origin.date_words),
        *((f"serial number of {name}", serial) for name, serial in sorted(origin.serials.items())),
        ("method", ", ".join(dict.fromkeys(c.method for c in file.pairs))),
        ("made by", file.made_by),
        ("SHA-256 of the session", origin.session_sha256),
        ("SHA-256 of result.json", hashlib.sha256(file.text().encode()).hexdigest()),
    ]
    has_folders = sum(max(len(c.channels), 1) for c in file.pairs) > 1
    pairs = []
    for k, c in enumerate(file.pairs):
        pair = _pair(session.rig, c, f"pair-{k}")
        for capture in pair["captures"]:
            capture["overlays"] = _overlays(session.capture(capture["name"]), c, overlays, has_folders)
        # Equal numbers for each camera, so that the page stays small.
        n_most = _MOST_PICTURES // len(file.pairs)
        pair["gallery"] = _gallery(session, c, pair["captures"], n_most, thumbnails or {})
        pair["steps"] = _next_steps(c, folder, has_previous)
        pair["rejecting"] = ""
        for worst in pair["gallery"][:1]:
            pair["rejecting"] = f"lce-rig calibrate {shlex.quote(folder)} --without {worst['name']}"
        pairs.append(pair)
    facts = [(name, value) for name, value in facts if value]
    on_base = None if file.on_base is None else rig_table(file.on_base, session.rig.cameras)
    return render("calibration.html", rig=session.rig.name, pairs=pairs, facts=facts, on_base=on_base)


def _overlays(capture: Capture, c: Calibration, folder: str, has_folders: bool) -> list[str]:
    """Return the names of a capture's overlays, as written by `verify` of the session."""
    return [
        "/".join([folder, *([Pair(c.camera, channel, c.lidar).folder_name] if has_folders else []), name])
        for channel in c.channels or ("",)
        if not channel
        or capture.has_image(c.camera, channel)
        or (channel == "events" and c.camera in capture.event_cameras)
        for name in (f"{capture.name}.png",)
    ]


def _pair(rig: Rig, c: Calibration, anchor: str) -> dict[str, Any]:
    """List the content of one camera and one LiDAR's part of the page, by the template's names."""
    board, lens = rig.board.to_board(), None if c.is_of_peers else rig.lens_of(c)
    evidence = None if lens is None else gather(c, board, lens)
    tables = result_tables(c)
    captures = [
        {
            "name": name,
            "anchor": f"{anchor}-capture-{k}",
            "figures": list(zip(tables["captures"].headings[1:], figures, strict=True)),
        }
        for k, (name, *figures) in enumerate(tables["captures"].rows)
    ]
    return {
        "calibration": c,
        "anchor": anchor,
        "statement": _statement(c),
        "reasons": _reasons(c),
        "body_frames": (rig.frame_of(c.lidar), rig.frame_of(c.camera)),
        "tables": tables,
        "captures": captures,
        "lens": [finding.text for finding in c.findings if finding.code in _LENS_CODES],
        "scene": "" if c.scene is None else as_line(scene_words(c.scene)),
        "drawings": _drawings(c, board, lens, evidence, anchor),
    }


def _gallery(
    session: Session,
    c: Calibration,
    captures: Sequence[Mapping[str, Any]],
    n_most: int,
    thumbnails: Thumbnails,
) -> list[dict[str, Any]]:
    """List captures with their images, those with the largest residuals first."""
    board, lens = session.rig.board.to_board(), None
    if not c.is_of_lidars:
        lens = session.rig.cameras[c.camera].to_intrinsics()
    order = worst_first([r.plane_mean_m for r in c.residuals], [r.edge_mean_m for r in c.residuals])
    order = order[: max(n_most, 1)]

    def picture(k: int) -> str:
        if lens is None:
            return ""
        return picture_of(session.capture(c.residuals[k].capture), c, board, lens, thumbnails)

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # most of the time goes into decoding
        pictures = list(pool.map(picture, (k for k, _ in order)))
    return [
        {
            **captures[k],
            "picture": shown,
            "stands_out": f"{ratio:.1f} x the median" if ratio > _STANDS_OUT else "",
        }
        for (k, ratio), shown in zip(order, pictures, strict=True)
    ]


def _drawings(
    c: Calibration, board: Board, lens: Intrinsics | None, evidence: Evidence | None, anchor: str
) -> dict[str, Markup]:
    """Draw a result's figures by name; none without its boards or intrinsics."""
    if evidence is None or lens is None:
        return {}
    links = {r.capture: f"#{anchor}-capture-{k}" for k, r in enumerate(c.residuals)}
    drawn = {
        "in_image": (
            drawings.draw_in_image(evidence, board, lens, links),
            "Outlines of the boards in the image",
        ),
        "from_above": (
            drawings.draw_from_above(c, evidence, board, lens, links),
            "Boards around the LiDAR, from above",
        ),
        "by_ring": (drawings.draw_by_ring(evidence), "Residuals by ring"),
        "by_range": (drawings.draw_by_range(evidence, links), "Residuals by range"),
        "corners": (drawings.draw_corners(evidence, lens), "Residuals of the corners in the image"),
    }
    return {name: axes.markup(label, f"{anchor}-{name}") for name, (axes, label) in drawn.items()}


def _statement(c: Calibration) -> str:
    """Summarise a result in one paragraph, with its figures."""
    sensor = c.camera if c.is_of_peers else f"camera {c.camera}"
    known = (
        f"The pose of {sensor} relative to {c.lidar} has a standard deviation of "
        f"{significant(c.sigma_rotation_deg)} deg and {significant(1000 * c.sigma_translation_m)} mm, from "
        f"{len(c.captures_used)} of {c.n_captures} captures of the board"
    )
    if c.verdict == "fail":
        return "Do not use this result."
    text = f"{known}; {'every check passed' if c.verdict == 'pass' else 'use it with care'}."
    if not c.uncertainty:
        return text
    at = min(c.uncertainty, key=lambda point: abs(point.distance_m - USUAL_M))
    return (
        f"{text} A LiDAR point {at.distance_m:g} m away falls onto the image with an expected error of "
        f"{at.centre_px:.1f} px ({100 * at.centre_m:.1f} cm) in the middle and {at.corner_px:.1f} px "
        f"({100 * at.corner_m:.1f} cm) in the corners."
    )


def _reasons(c: Calibration) -> list[tuple[str, str]]:
    """List severity and text of the findings: causes, consequences, notes."""
    rows = []
    for finding in c.findings:
        if finding.follows:
            rows.append(("note", f"Follows: {finding.text}"))
        elif finding.code != _PLAN:
            rows.append((finding.severity, f"{'Note: ' * (finding.severity == 'note')}{finding.text}"))
    return rows


def _next_steps(c: Calibration, folder: str, has_previous: bool) -> list[str]:
    """List the next steps, the most urgent first: the causes' actions, then the checks before use."""
    plan = next((finding.advice for finding in c.findings if finding.code == _PLAN), "")
    asked, optional = [], []
    for finding in sorted(c.findings, key=lambda f: f.severity != "error"):
        advice = advice_of(finding, plan, folder)
        if finding.severity != "note" and not finding.follows:
            asked.append(advice)
        elif advice and advice != plan and finding.action.startswith("measure"):
            optional.append(f"For less uncertainty, {advice}.")
    steps = [as_line(text) for text in dict.fromkeys([*asked, plan]) if text]
    if c.verdict == "fail":
        earlier = " The last usable result is in `previous/`." if has_previous else ""
        return [*steps, f"Then run `lce-rig calibrate {shlex.quote(folder)}` again.{earlier}"]
    look_for = "ring ends must lie on the board's outline on all sides."
    if c.is_of_lidars:
        look_for = "both point clouds must show the board at the same place."
    elif c.is_of_cameras:
        look_for = f"corners by {c.lidar} must lie on those of the pattern."
    return [
        *steps,
        f"Look at the overlays (`lce-rig verify {shlex.quote(folder)}`): {look_for}",
        "Collect a second session on another day, calibrate it and compare both: "
        f"`lce-rig repeat {shlex.quote(folder)} OTHER_SESSION`.",
        *optional,
    ]


_QUALITY, _OUTLINE_BGR = 60, (0, 140, 255)
# Length of the events shown in an image, ns: enough to show the board's edges.
_EVENTS_NS = 20_000_000


def picture_of(
    capture: Capture, c: Calibration, board: Board, lens: Intrinsics, thumbnails: Thumbnails
) -> str:
    """Draw a capture's image with the board's outline; raw events if the capture has no image.

    Args:
        capture: capture with the data.
        c: the result; its channels are tried in their order.
        board: board of the outline.
        lens: intrinsics of the camera.
        thumbnails: images that need no decoding.

    Returns:
        A data URI; "" if the capture has neither image nor events, or damaged ones.
    """
    observation = c.observations.get(capture.name)
    outline, stamp_ns = np.empty((0, 2)), None
    if observation is not None:
        outline = outline_px(observation.pose.T_cam_board, board, lens)
        stamp_ns = observation.image.stamp_ns
    with suppress(LceRigError):
        for channel in c.channels:
            if capture.has_image(c.camera, channel):
                known = thumbnails.get((capture.name, c.camera, channel))
                return data_uri(known or reduced(capture.image(c.camera, channel).pixels), outline)
        if c.camera in capture.event_cameras:
            events = capture.events(c.camera)
            if stamp_ns is None:  # the last ones
                stamp_ns = (int(events.t_ns[-1]) if len(events) else 0) - _EVENTS_NS // 2
            near = events.between(stamp_ns - _EVENTS_NS // 2, stamp_ns + _EVENTS_NS // 2)
            return data_uri(reduced(accumulated(near)), outline)
    return ""


def data_uri(thumbnail: Thumbnail, outline: Array) -> str:
    """Draw an outline into a reduced image.

    Args:
        thumbnail: thumbnail of the image, shown unchanged.
        outline: (N, 2) px of the image; points that are not finite are skipped.

    Returns:
        A JPEG as a data URI.
    """
    small = thumbnail.pixels
    drawn = small.copy() if small.ndim == 3 else cv2.cvtColor(small, cv2.COLOR_GRAY2BGR)
    line = outline[np.isfinite(outline).all(axis=1)]
    if len(line):
        # Pixel centres are at whole numbers, before and after; 4 bits of fraction.
        at = (line + 0.5) * small.shape[1] / thumbnail.width_px - 0.5
        points = np.round(16 * np.clip(at, -1e4, 1e4)).astype(np.int32)
        cv2.polylines(drawn, [points], True, _OUTLINE_BGR, 2, cv2.LINE_AA, 4)
    content = cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
    return "data:image/jpeg;base64," + base64.b64encode(content).decode()


def worst_first(planes_m: Sequence[float], edges_m: Sequence[float]) -> list[tuple[int, float]]:
    """Order captures by their residuals, the largest first.

    Returns:
        The index of each, and the ratio of its plane or edge residuals to the median.
    """
    ratios = np.zeros(len(planes_m))
    for values in (np.nan_to_num(np.array(planes_m)), np.nan_to_num(np.array(edges_m))):
        middle = float(np.median(values)) if len(values) else 0.0
        if middle > 0:
            ratios = np.maximum(ratios, values / middle)
    return [(int(k), float(ratios[k])) for k in np.argsort(-ratios, kind="stable")]
