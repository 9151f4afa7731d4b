"""The report of a calibration: its verdict, its effect on a point, and the evidence, on one page."""

import hashlib
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from markupsafe import Markup

from lce_rig.core.board import Board
from lce_rig.core.calibration import Calibration, ResultFile
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, perturb, sigma_sizes
from lce_rig.core.phrasing import as_line, significant
from lce_rig.detect.detection import Pair
from lce_rig.export.writing import T_BODY_OPTICAL, rpy
from lce_rig.judge.findings import cause_words, weakest_words
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.show.report import calibration_drawings as drawings
from lce_rig.show.report.calibration_drawings import Evidence, gather
from lce_rig.show.report.page import as_markup, render, style
from lce_rig.show.report.thumbnails import picture_of, worst_first

Overlays = Callable[[Calibration, str], Sequence[str]]
"""Gives the paths of a capture's overlays, from the folder of the page."""

Pictures = Callable[[Calibration, str], str]
"""Gives the picture of a capture as a data URI; "" for none."""

Row = Sequence[object]
_STEP = 1e-6
_AXES = {"x": "x right", "y": "y down", "z": "z forward"}
_LENS_CODES = ("verdict.intrinsics", "verdict.scale")
# The statement names the expected error at this distance.
_USUAL_M = 10.0
# Captures with more than this many times the median residual are marked. A page holds so many pictures.
_STANDS_OUT, _MOST_PICTURES = 2.0, 96


def report_text(
    session: Session,
    file: ResultFile,
    text: str,
    overlays: str,
    *,
    has_previous: bool = False,
) -> str:
    """Write the report of a result; the same result gives the same bytes.

    Args:
        session: whose result it is.
        file: the result; text: the same as it is written.
        overlays: the folder of overlays beside the report.
        has_previous: whether `previous/` beside the report holds a usable result.
    """
    n_pairs = sum(len(c.channels) for c in file.pairs)

    def paths(c: Calibration, capture: str) -> list[str]:
        """Name a capture's overlays as `verify` of the session does."""
        held = session.capture(capture)
        paths = []
        for channel in c.channels:
            if held.has_image(c.camera, channel) or (channel == "events" and c.camera in held.event_cameras):
                folder = f"{Pair(c.camera, channel, c.lidar).folder_name}/" if n_pairs > 1 else ""
                paths.append(f"{overlays}/{folder}{capture}.png")
        return paths

    origin = file.provenance
    facts = [
        ("rig", file.rig),
        ("robot", origin.robot),
        ("date of the captures", origin.date_words),
        *((f"serial number of {name}", serial) for name, serial in sorted(origin.serials.items())),
        ("method", ", ".join(dict.fromkeys(c.method for c in file.pairs))),
        ("made by", file.made_by),
        ("SHA-256 of the session", origin.session_sha256),
        ("SHA-256 of result.json", hashlib.sha256(text.encode()).hexdigest()),
    ]
    facts = [(name, value) for name, value in facts if value]

    def picture(c: Calibration, capture: str) -> str:
        with suppress(LceRigError):
            board, lens = session.rig.board.to_board(), session.rig.cameras[c.camera].to_intrinsics()
            return picture_of(session.capture(capture), c, board, lens)
        return ""

    def rejecting(capture: str) -> str:
        return f"lce-rig calibrate {shlex.quote(session.path.resolve().name)} --without {capture}"

    return calibration_page(
        session.rig,
        file.pairs,
        facts=facts,
        overlays=paths,
        pictures=picture,
        rejecting=rejecting,
        folder=session.path.resolve().name,
        has_previous=has_previous,
    )


def calibration_page(
    rig: Rig,
    calibrations: Sequence[Calibration],
    *,
    facts: Sequence[Row],
    overlays: Overlays,
    pictures: Pictures = lambda _c, _capture: "",
    rejecting: Callable[[str], str] = lambda capture: f"lce-rig calibrate SESSION --without {capture}",
    folder: str = "SESSION",
    has_previous: bool = False,
) -> str:
    """Write the report of a result as one HTML file: the same result gives the same bytes.

    Args:
        rig: the profile.
        calibrations: one for each camera and LiDAR.
        facts: names and values that identify the result, for the end of the page.
        overlays: gives the images of a capture; the page shows them once they are drawn.
        pictures: gives the small picture of a capture.
        rejecting: gives the command that rejects a capture.
        folder: of the session, for commands.
        has_previous: as of `report_text`.
    """
    pairs = []
    for k, c in enumerate(calibrations):
        with style(f"pair-{k}"):
            pair = _pair(rig, c, f"pair-{k}", overlays)
            # As many of each camera, so that the whole page stays small.
            pair["gallery"] = _gallery(c, pair["captures"], pictures, _MOST_PICTURES // len(calibrations))
            pair["steps"] = _next_steps(c, folder, has_previous)
            worst = pair["gallery"][:1]
            pair["rejecting"] = rejecting(worst[0]["name"]) if worst else ""
            pairs.append(pair)
    return render("calibration.html", rig=rig.name, pairs=pairs, facts=facts)


def _pair(rig: Rig, c: Calibration, anchor: str, overlays: Overlays) -> dict[str, Any]:
    """List the content of one camera and one LiDAR's part of the page, by the template's names."""
    board, lens = rig.board.to_board(), rig.lens_of(c)
    evidence = gather(c, board, lens)
    captures = []
    for k, residual in enumerate(c.residuals):
        figures = [
            ("planes", 1000 * residual.plane_mean_m, "mm"),
            ("edges", 1000 * residual.edge_mean_m, "mm"),
        ]
        figures += [
            ("held out", 1000 * residual.held_out_m, "mm"),
            ("corners", residual.reprojection_px, "px"),
        ]
        captures.append(
            {
                "name": residual.capture,
                "anchor": f"{anchor}-capture-{k}",
                "figures": [
                    (name, f"{value:.{1 if unit == 'mm' else 2}f} {unit}" if math.isfinite(value) else "")
                    for name, value, unit in figures
                ],
                "overlays": overlays(c, residual.capture),
            }
        )
    return {
        "calibration": c,
        "anchor": anchor,
        "statement": _statement(c),
        "body_frames": (rig.lidars[c.lidar].frame, rig.cameras[c.camera].frame),
        "pose": _pose_rows(c),
        "uncertainty": [
            (
                f"{p.distance_m:g} m",
                f"{p.centre_px:.1f} px, {100 * p.centre_m:.1f} cm",
                f"{p.corner_px:.1f} px, {100 * p.corner_m:.1f} cm",
            )
            for p in c.uncertainty
        ],
        "axes": [*_axis_rows(c.cov[3:, 3:], "deg", "about"), *_axis_rows(c.cov[:3, :3], "mm", "along")],
        "weakest": "" if c.weakest is None else weakest_words(c.weakest),
        "causes": [
            (
                cause_words(cause.source),
                f"{cause.sigma_rotation_deg:.3f}",
                f"{1000 * cause.sigma_translation_m:.1f}",
            )
            for cause in c.contributions
        ],
        "captures": captures,
        "clocks": _clock_rows(c),
        "lens": [finding.sentence for finding in c.findings if finding.code in _LENS_CODES],
        "scene": _scene_rows(c),
        "cameras": _camera_rows(c),
        "refused": [(name, why.stage, as_markup(why.sentence)) for name, why in c.captures_refused.items()],
        "drawings": _drawings(c, board, lens, evidence, anchor),
    }


def _gallery(
    c: Calibration, captures: Sequence[Mapping[str, Any]], pictures: Pictures, n_most: int
) -> list[dict[str, Any]]:
    """List captures with their pictures, those with the largest residuals first."""
    order = worst_first([r.plane_mean_m for r in c.residuals], [r.edge_mean_m for r in c.residuals])
    return [
        {
            **captures[k],
            "picture": pictures(c, c.residuals[k].capture),
            "stands_out": f"{ratio:.1f} x the median" if ratio > _STANDS_OUT else "",
        }
        for k, ratio in order[: max(n_most, 1)]
    ]


def _drawings(
    c: Calibration, board: Board, lens: Intrinsics, evidence: Evidence | None, anchor: str
) -> dict[str, Markup]:
    """Draw a result; without its boards its uncertainty alone."""
    drawn = {"by_distance": drawings.draw_by_distance(c, lens)}
    if c.contributions:
        drawn["causes"] = drawings.draw_causes(c)
    if evidence is not None:
        links = {r.capture: f"#{anchor}-capture-{k}" for k, r in enumerate(c.residuals)}
        drawn |= {
            "in_image": drawings.draw_in_image(evidence, board, lens, links),
            "from_above": drawings.draw_from_above(c, evidence, board, lens, links),
            "by_capture": drawings.draw_by_capture(c, links),
            "by_ring": drawings.draw_by_ring(evidence),
            "by_range": drawings.draw_by_range(evidence, links),
            "corners": drawings.draw_corners(evidence, lens),
        }
    return drawn


def _statement(c: Calibration) -> str:
    """Sum a result up in one paragraph that anyone can sign, with its figures."""
    known = (
        f"The pose of camera {c.camera} relative to {c.lidar} has a standard deviation of "
        f"{significant(c.sigma_rotation_deg)} deg and {significant(1000 * c.sigma_translation_m)} mm, from "
        f"{len(c.captures_used)} of {c.n_captures} captures of the board"
    )
    if c.verdict == "fail":
        return "Do not use this result: " + _reason(c) + _others(c, "error")
    passed = "every check passed" if c.verdict == "pass" else "use it with care: " + _reason(c) + _others(c)
    text = f"{known}; {passed.rstrip('.')}."
    if not c.uncertainty:
        return text
    at = min(c.uncertainty, key=lambda point: abs(point.distance_m - _USUAL_M))
    return (
        f"{text} A LiDAR point {at.distance_m:g} m away falls onto the image with an expected error of "
        f"{at.centre_px:.1f} px ({100 * at.centre_m:.1f} cm) in the middle and {at.corner_px:.1f} px "
        f"({100 * at.corner_m:.1f} cm) in the corners."
    )


def _reason(c: Calibration) -> str:
    reasons = [finding for finding in c.findings if finding.severity != "note"]
    return f"{reasons[0].text}." if reasons else "its checks failed."


def _others(c: Calibration, severity: str = "warning") -> str:
    n = sum(finding.severity == severity for finding in c.findings) - 1
    return f" {n} other reason{'s' if n > 1 else ''} below." if n > 0 else ""


def _next_steps(c: Calibration, folder: str, has_previous: bool) -> list[str]:
    """List the next steps, the most urgent first: the findings' actions, then the checks before use."""
    asked = [finding.advice_at(folder) for finding in sorted(c.findings, key=lambda f: f.severity != "error")]
    steps = [as_line(text) for text in dict.fromkeys(asked) if text]
    if c.verdict == "fail":
        earlier = " The last usable result is in `previous/`." if has_previous else ""
        return [*steps, f"Then run `lce-rig calibrate {shlex.quote(folder)}` again.{earlier}"]
    return [
        *steps,
        f"Look at the overlays (`lce-rig verify {shlex.quote(folder)}`): "
        "ring ends must lie on the board's outline on all sides.",
        "Collect a second session on another day and compare both: "
        f"`lce-rig repeat {shlex.quote(folder)} OTHER_SESSION`.",
    ]


def _pose_rows(c: Calibration) -> list[Row]:
    """State the pose of the camera's body in the LiDAR's frame, with standard deviations."""

    def pose(tangent: Array) -> Array:
        T_lidar_body = invert(perturb(c.T_cam_lidar, tangent)) @ invert(T_BODY_OPTICAL)
        return np.concatenate([T_lidar_body[:3, 3], rpy(T_lidar_body[:3, :3])])

    moved = np.array([pose(step) - pose(-step) for step in _STEP * np.eye(6)]).T
    moved[3:] = (moved[3:] + np.pi) % (2 * np.pi) - np.pi
    J = moved / (2 * _STEP)
    values, sigmas = pose(np.zeros(6)), np.sqrt(np.diag(J @ c.cov @ J.T))
    rows: list[Row] = [
        (name, f"{value:+.4f} m", f"{1000 * sigma:.1f} mm")
        for name, value, sigma in zip(("x", "y", "z"), values[:3], sigmas[:3], strict=True)
    ]
    rows += [
        (name, f"{value:+.3f} deg", f"{sigma:.3f} deg")
        for name, value, sigma in zip(
            ("roll", "pitch", "yaw"), np.degrees(values[3:]), np.degrees(sigmas[3:]), strict=True
        )
    ]
    return rows


def _axis_rows(cov: Array, unit: str, kind: str) -> list[Row]:
    """State the principal axes of a covariance (3, 3) in rad^2 or m^2."""
    sigmas, directions = drawings.principal_axes(cov)
    sizes = [f"{np.degrees(s):.3f} deg" if unit == "deg" else f"{1000 * s:.1f} mm" for s in sigmas]
    return [
        (kind, "(" + ", ".join(f"{value + 0.0:+.2f}" for value in direction) + ")", size)
        for size, direction in zip(sizes, directions.T, strict=True)
    ]


def _clock_rows(c: Calibration) -> list[Row]:
    """List figures of the channels, a column each."""
    offsets = [
        "boards stood still"
        if r.time_offset_s is None or r.time_offset_sigma_s is None
        else f"{1000 * r.time_offset_s:+.0f} ± {1000 * r.time_offset_sigma_s:.0f} ms"
        for r in c.channel_results
    ]
    return [
        ("captures", *(r.n_captures for r in c.channel_results)),
        ("corner noise", *(f"{r.noise_px:.2f} px" for r in c.channel_results)),
        ("time offset", *offsets),
        ("depth scatter", *(f"{1000 * r.depth_scatter_m:.1f} mm" for r in c.channel_results)),
        ("  without compensation", *(f"{1000 * r.depth_scatter_still_m:.1f} mm" for r in c.channel_results)),
    ]


def _scene_rows(c: Calibration) -> list[Row]:
    states = {"agrees": "agrees", "contradicts": "contradicts", "unknown": "cannot tell"}
    rows: list[Row] = []
    for axis in () if c.scene is None else c.scene.axes:
        scale, digits, unit = (1.0, 2, "deg") if axis.unit == "deg" else (1000.0, 0, "mm")
        smallest = "none" if axis.smallest is None else f"{scale * axis.smallest:.{digits}f} {unit}"
        change = f"{scale * axis.change:+.{digits}f} ± {scale * axis.sigma:.{digits}f} {unit}"
        kind = "about" if axis.unit == "deg" else "along"
        rows.append((f"{kind} {_AXES[axis.axis[-1]]}", states[axis.state], change, smallest))
    return rows


def _camera_rows(c: Calibration) -> list[Row]:
    rows: list[Row] = []
    for other in c.other_cameras:
        sigma = apart = ""
        if other.cov is not None:
            rotation_deg, translation_m = sigma_sizes(other.cov)
            sigma = f"{rotation_deg:.3f} deg, {1000 * translation_m:.1f} mm"
        if other.apart_rotation_deg is not None and other.apart_translation_m is not None:
            apart = f"{other.apart_rotation_deg:.3f} deg, {1000 * other.apart_translation_m:.1f} mm"
        rows.append((other.camera, other.n_captures, sigma, apart, f"{1000 * other.board_rms_m:.1f} mm"))
    return rows
