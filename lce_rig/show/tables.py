"""A result as tables: the report sets them as HTML, the terminal as text."""

import math
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np

from lce_rig.core.calibration import Calibration, RigPoses, SceneOpinion
from lce_rig.core.geometry import T_BODY_OPTICAL, Array, invert, perturb, sigma_sizes, tangent_sizes
from lce_rig.core.phrasing import sizes
from lce_rig.export.writing import rpy
from lce_rig.judge.findings import cause_words

Row = Sequence[str]
# Step of central differences, m and rad: near the cube root of double precision, where their error is least.
_STEP = 1e-6
_SCENE = {"agrees": "agree with the extrinsics", "contradicts": "contradict the extrinsics"}


class Table(NamedTuple):
    """A table; one without rows is not shown.

    Attributes:
        title: title above the table.
        headings: headings of the columns.
        rows: rows of cells.
        n_texts: number of leading columns with text; the others hold figures.
    """

    title: str
    headings: Sequence[str]
    rows: Sequence[Row]
    n_texts: int = 1


def result_tables(c: Calibration) -> dict[str, Table]:
    """List all tables of a result, in reading order."""
    first = c.camera if c.is_of_peers else "the camera"
    pose = f"Pose of {c.lidar} on {c.camera}" if c.is_of_peers else "Pose of the camera on the LiDAR"
    points = [
        (
            f"{p.distance_m:g} m",
            f"{p.centre_px:.1f} px, {100 * p.centre_m:.1f} cm",
            f"{p.corner_px:.1f} px, {100 * p.corner_m:.1f} cm",
        )
        for p in c.uncertainty
    ]
    axes = [*_axis_rows(c.cov[3:, 3:], "deg", "about"), *_axis_rows(c.cov[:3, :3], "mm", "along")]
    causes = [
        (cause_words(each.source), f"{each.sigma_rotation_deg:.3f}", f"{1000 * each.sigma_translation_m:.1f}")
        for each in c.contributions
    ]
    cameras = ("camera", "captures", "1 sigma", "images differ by", "boards apart")
    refused = [(name, why.stage, why.sentence) for name, why in c.captures_refused.items()]
    return {
        "pose": Table(pose, ("", "value", "1 sigma"), _pose_rows(c)),
        "points": Table("Error of a LiDAR point", ("distance", "middle of image", "worst corner"), points),
        "axes": Table(f"Principal axes in {first}", ("", "direction (x, y, z)", "1 sigma"), axes),
        "causes": Table("Causes", ("", "deg", "mm"), causes),
        "fit": Table("Fit", ("", ""), _fit_rows(c)),
        "captures": Table("Captures", ("capture", *_FIGURES), _capture_rows(c)),
        "refused": Table("Captures that were not used", ("capture", "stage", "cause and action"), refused, 3),
        "channels": Table("Channels", ("", *(r.channel for r in c.channel_results)), _channel_rows(c)),
        "cameras": Table("Other cameras that saw the same boards", cameras, _camera_rows(c)),
    }


def rig_table(poses: RigPoses, cameras: Collection[str]) -> Table:
    """List the pose of each sensor on the base; of the cameras, that of their body frames (x forward)."""
    rows = []
    for each in poses.sensors:
        T = each.T_base_sensor @ invert(T_BODY_OPTICAL) if each.sensor in cameras else each.T_base_sensor
        T = T_BODY_OPTICAL @ T if poses.base in cameras else T
        position = [f"{value:+.4f}" for value in T[:3, 3]]
        angles = [f"{value:+.3f}" for value in np.degrees(rpy(T[:3, :3]))]
        sigmas = f"{each.sigma_rotation_deg:.3f}", f"{1000 * each.sigma_translation_m:.1f}"
        rows.append((each.sensor, each.verdict.upper(), *position, *angles, *sigmas))
    headings = ("", "", "x m", "y m", "z m", "roll deg", "pitch", "yaw", "sigma deg", "mm")
    return Table(f"Rig on {poses.base}", headings, rows, 2)


def _pose_rows(c: Calibration) -> list[Row]:
    """State the pose of the camera's body in the LiDAR's frame, or of the second of a kind in the first's.

    Standard deviations belong to it.
    """

    def pose(tangent: Array) -> Array:
        T = perturb(c.T_cam_lidar, tangent)
        if c.is_of_cameras:
            T = T_BODY_OPTICAL @ T @ invert(T_BODY_OPTICAL)
        elif not c.is_of_lidars:
            T = invert(T) @ invert(T_BODY_OPTICAL)
        return np.concatenate([T[:3, 3], rpy(T[:3, :3])])

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
    """State the principal axes of a covariance (3, 3) in rad^2 or m^2, the largest first."""
    variances, directions = np.linalg.eigh(cov)
    rows: list[Row] = []
    for variance, direction in zip(variances[::-1], directions.T[::-1], strict=True):
        sigma = math.sqrt(max(variance, 0.0))
        # The sign of an eigenvector is arbitrary: make its largest component positive.
        direction = direction * np.sign(direction[np.abs(direction).argmax()])
        size = f"{math.degrees(sigma):.3f} deg" if unit == "deg" else f"{1000 * sigma:.1f} mm"
        rows.append((kind, "(" + ", ".join(f"{value + 0.0:+.2f}" for value in direction) + ")", size))
    return rows


def _fit_rows(c: Calibration) -> list[Row]:
    """State residuals and certificate; none without boards."""
    if not math.isfinite(c.metrics.mpe_m):
        return []
    first = c.camera if c.is_of_peers else "the camera"
    points = f"corners by {c.lidar}" if c.is_of_cameras else "LiDAR points"
    start = "start of the estimate (Algorithm 1)" if c.is_start_certified else "result"
    proof = f"{'proven' if c.certificate.is_optimal else 'not proven'}, gap {c.certificate.gap:.0e}"
    rows = [
        ("captures in which both sensors found the board", f"{c.n_detected} of {c.n_captures}"),
        (f"{points} from the board planes of {first}, mean", f"{1000 * c.metrics.mpe_m:.1f} mm"),
        ("the same without the LiDAR's estimated errors, mean", _without_errors(c)),
        ("ring ends from the board's edges, mean", _if_known(1000 * c.metrics.mee_m, ".1f", "mm")),
        ("held-out captures, mean of their rms", _if_known(1000 * c.diagnostics.held_out_m, ".1f", "mm")),
        (
            "corners from the board's best pose in each image, rms",
            _if_known(c.metrics.reprojection_px, ".2f", "px"),
        ),
        (f"{start} is the global minimum of its cost", "" if c.is_of_cameras else proof),
    ]
    return [row for row in rows if row[1]]


def _without_errors(c: Calibration) -> str:
    """State the plane residual without the LiDAR's estimated errors, "" where these hardly change it."""
    corrected_m = c.diagnostics.mpe_corrected_m
    is_lower = corrected_m < _NOTICEABLE * c.metrics.mpe_m
    return _if_known(1000 * corrected_m, ".1f", "mm") if is_lower else ""


def _if_known(value: float, digits: str, unit: str) -> str:
    return f"{value:{digits}} {unit}" if math.isfinite(value) else ""


# Ratio of a mean plane residual to that as measured below which it is listed.
_NOTICEABLE = 0.9
_FIGURES = ("planes", "edges", "held out", "corners")


def _capture_rows(c: Calibration) -> list[Row]:
    """List the residuals of each capture, "" for none."""
    rows: list[Row] = []
    for r in c.residuals:
        sizes_m = (r.plane_mean_m, r.edge_mean_m, r.held_out_m)
        in_mm = (_if_known(1000 * value, ".1f", "mm") for value in sizes_m)
        rows.append((r.capture, *in_mm, _if_known(r.reprojection_px, ".2f", "px")))
    return rows


def _channel_rows(c: Calibration) -> list[Row]:
    """List figures of the channels, a column each; none for one channel of still boards."""
    if len(c.channel_results) < 2 and all(r.time_offset_s is None for r in c.channel_results):
        return []
    offsets = [
        "boards stood still"
        if r.time_offset_s is None or r.time_offset_sigma_s is None
        else f"{1000 * r.time_offset_s:+.0f} +- {1000 * r.time_offset_sigma_s:.0f} ms"
        for r in c.channel_results
    ]
    return [
        ("captures", *(f"{r.n_captures}" for r in c.channel_results)),
        ("corner noise", *(f"{r.noise_px:.2f} px" for r in c.channel_results)),
        ("time offset", *offsets),
    ]


def scene_words(opinion: SceneOpinion) -> str:
    """State whether the edges of the room agree with extrinsics, and which change fits best."""
    data = f"{opinion.n_captures} captures, {opinion.n_edges} edges, without those of the board"
    fit = ""
    if opinion.change is not None and opinion.cov is not None:
        change, sigma = sizes(*tangent_sizes(opinion.change)), sizes(*sigma_sizes(opinion.cov))
        fit = f": they fit best {change} away, 1 sigma {sigma}"
    return f"the edges of the room {_SCENE.get(opinion.state, 'cannot tell')}{fit} ({data})"


def _camera_rows(c: Calibration) -> list[Row]:
    rows: list[Row] = []
    for other in c.other_cameras:
        sigma = apart = ""
        if other.cov is not None:
            sigma = sizes(*sigma_sizes(other.cov))
        if other.apart_rotation_deg is not None and other.apart_translation_m is not None:
            apart = sizes(other.apart_rotation_deg, other.apart_translation_m)
        boards = f"{1000 * other.board_rms_m:.1f} mm"
        rows.append((other.camera, f"{other.n_captures}", sigma, apart, boards))
    return rows
