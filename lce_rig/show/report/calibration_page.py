"""The report of a calibration: its verdict, what it means for a point, and the evidence, on one page."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from lce_rig.core.calibration import Calibration, CaptureResidual
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, perturb, sigma_sizes
from lce_rig.export.rotations import T_BODY_OPTICAL, rpy
from lce_rig.judge.findings import cause_words, weakest_words
from lce_rig.rig import Rig
from lce_rig.show.report.board_drawings import draw_from_above, draw_in_image, draw_ranges_and_angles
from lce_rig.show.report.drawing import style
from lce_rig.show.report.evidence import gather
from lce_rig.show.report.page import as_markup, render
from lce_rig.show.report.residual_drawings import (
    draw_by_capture,
    draw_by_place,
    draw_by_range,
    draw_by_ring,
    draw_corners,
)
from lce_rig.show.report.statement import next_steps, statement
from lce_rig.show.report.uncertainty_drawings import (
    draw_by_distance,
    draw_causes,
    draw_ellipsoid,
    principal_axes,
)
from lce_rig.show.report.worked_point import WorkedPoint, work_point
from lce_rig.words import describe, recommend, sentence

Overlays = Callable[[Calibration, str], Sequence[str]]
"""Gives the paths of a capture's overlays, from the folder of the page."""

Row = Sequence[object]
_STEP = 1e-6
_AXES = {"x": "x right", "y": "y down", "z": "z forward"}
_LENS_CODES = ("verdict.intrinsics", "verdict.known_better", "verdict.scale")


@dataclass(frozen=True)
class CaptureView:
    """One capture of a report.

    Attributes:
        name: of the capture.
        anchor: of its figures and overlays in the page.
        figures: residuals by name, with units.
        overlays: paths of its images.
    """

    name: str
    anchor: str
    figures: tuple[tuple[str, str], ...]
    overlays: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class PairView:
    """What the page shows of one camera and one LiDAR.

    Attributes:
        calibration: of the sensors.
        anchor: of its part of the page.
        statement: the paragraph to sign; steps: what to do next.
        findings: severity, what was found, what to do.
        body_frames: of the LiDAR and of the camera.
        pose, uncertainty, axes, causes, clocks, scene, cameras, refused: rows of tables.
        weakest: the least determined motion.
        worked: the worked point.
        captures: those used.
        lens: sentences about the profile's intrinsics.
        drawings: by name.
    """

    calibration: Calibration
    anchor: str
    statement: str
    steps: Sequence[str]
    findings: Sequence[tuple[str, str, str]]
    body_frames: tuple[str, str]
    pose: Sequence[Row]
    uncertainty: Sequence[Row]
    axes: Sequence[Row]
    weakest: str
    causes: Sequence[Row]
    worked: WorkedPoint | None
    captures: Sequence[CaptureView]
    clocks: Sequence[Row]
    lens: Sequence[str]
    scene: Sequence[Row]
    cameras: Sequence[Row]
    refused: Sequence[Row]
    drawings: Mapping[str, Markup]


def calibration_page(
    rig: Rig, calibrations: Sequence[Calibration], *, facts: Sequence[Row], overlays: Overlays
) -> str:
    """Write the report of a result as one HTML file: the same result gives the same bytes.

    Args:
        rig: the profile.
        calibrations: one for each camera and LiDAR.
        facts: name and value of what identifies the result, for the end of the page.
        overlays: gives the images of a capture; the page shows them once they are drawn.
    """
    pairs = []
    for k, c in enumerate(calibrations):
        with style(f"pair-{k}"):
            pairs.append(_pair_view(rig, c, f"pair-{k}", overlays))
    return render("calibration.html", rig=rig.name, pairs=pairs, facts=facts)


def _pair_view(rig: Rig, c: Calibration, anchor: str, overlays: Overlays) -> PairView:
    board, lens = rig.board.to_board(), rig.cameras[c.camera].to_intrinsics()
    evidence = gather(c, board, lens)
    captures = [
        CaptureView(r.capture, f"{anchor}-capture-{k}", _figures(r), tuple(overlays(c, r.capture)))
        for k, r in enumerate(c.residuals)
    ]
    links = {each.name: f"#{each.anchor}" for each in captures}
    drawings = _uncertainty_drawings(c, lens)
    if evidence is not None:
        drawings |= {
            "in_image": draw_in_image(evidence, board, lens, links),
            "from_above": draw_from_above(c, evidence, board, lens, links),
            "ranges": draw_ranges_and_angles(evidence, links),
            "by_capture": draw_by_capture(c, links),
            "by_ring": draw_by_ring(evidence),
            "by_range": draw_by_range(evidence, links),
            "by_place": draw_by_place(evidence, lens),
            "corners": draw_corners(evidence, lens),
        }
    return PairView(
        calibration=c,
        anchor=anchor,
        statement=statement(c),
        steps=next_steps(c),
        findings=[(f.severity, describe(f), recommend(f)) for f in c.findings],
        body_frames=(rig.lidars[c.lidar].frame, rig.cameras[c.camera].frame),
        pose=_pose_rows(c),
        uncertainty=[
            (
                f"{p.distance_m:g} m",
                f"{p.centre_px:.1f} px, {100 * p.centre_m:.1f} cm",
                f"{p.corner_px:.1f} px, {100 * p.corner_m:.1f} cm",
            )
            for p in c.uncertainty
        ],
        axes=[*_axis_rows(c.cov[3:, 3:], "deg", "about"), *_axis_rows(c.cov[:3, :3], "mm", "along")],
        weakest="" if c.weakest is None else weakest_words(c.weakest),
        causes=[
            (
                cause_words(each.source),
                f"{each.sigma_rotation_deg:.3f}",
                f"{1000 * each.sigma_translation_m:.1f}",
            )
            for each in c.contributions
        ],
        worked=None if evidence is None else work_point(c, lens, evidence),
        captures=captures,
        clocks=_clock_rows(c),
        lens=[sentence(f) for f in c.findings if f.code in _LENS_CODES],
        scene=_scene_rows(c),
        cameras=_camera_rows(c),
        refused=[(name, why.stage, as_markup(sentence(why))) for name, why in c.captures_refused.items()],
        drawings=drawings,
    )


def _uncertainty_drawings(c: Calibration, lens: Intrinsics) -> dict[str, Markup]:
    degrees = np.degrees(np.degrees(c.cov[3:, 3:]))
    drawings = {
        "rotation": draw_ellipsoid(degrees, "deg", "Uncertainty of the rotation"),
        "translation": draw_ellipsoid(1e6 * c.cov[:3, :3], "mm", "Uncertainty of the translation"),
        "by_distance": draw_by_distance(c, lens),
    }
    if c.contributions:
        drawings["causes"] = draw_causes(c)
    return drawings


def _figures(r: CaptureResidual) -> tuple[tuple[str, str], ...]:
    figures = [("planes", 1000 * r.plane_mean_m, "mm"), ("edges", 1000 * r.edge_mean_m, "mm")]
    figures += [("held out", 1000 * r.held_out_m, "mm"), ("corners", r.reprojection_px, "px")]
    return tuple(
        (name, f"{value:.{1 if unit == 'mm' else 2}f} {unit}" if math.isfinite(value) else "")
        for name, value, unit in figures
    )


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
    sigmas, directions = principal_axes(cov)
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
        sigma = "" if other.cov is None else "{:.3f} deg, {:.1f} mm".format(*_in_mm(sigma_sizes(other.cov)))
        apart = ""
        if other.apart_rotation_deg is not None and other.apart_translation_m is not None:
            apart = f"{other.apart_rotation_deg:.3f} deg, {1000 * other.apart_translation_m:.1f} mm"
        rows.append((other.camera, other.n_captures, sigma, apart, f"{1000 * other.board_rms_m:.1f} mm"))
    return rows


def _in_mm(sizes: tuple[float, float]) -> tuple[float, float]:
    return sizes[0], 1000 * sizes[1]
