"""extrinsics.yaml: the pose and its inverse, each with its meaning, an example point and its uncertainty."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, invert, pose, transform
from lce_rig.export.files import header, number, numbers, quoted, reads_back, rows, texts
from lce_rig.export.job import ExportJob
from lce_rig.export.probes import TOLERANCE, check_pose
from lce_rig.export.rotations import quaternion_wxyz, rotation_from_quaternion
from lce_rig.rig import Rig
from lce_rig.session.durable import write_atomically

FILE_NAME = "extrinsics.yaml"


def export_extrinsics(job: ExportJob) -> list[Path]:
    """Write extrinsics.yaml and check it by reading it back.

    Raises:
        LceRigError: the file reads back differently.
    """
    rig, calibrations = job.rig, job.calibrations
    lines = [f"# {line}" for line in header("extrinsics", rig, calibrations)]
    lines += ["format_version: 1", f"rig: {quoted(rig.name)}", f"made_by: {quoted(MADE_BY)}", "pairs:"]
    for calibration in calibrations:
        lines += _pair(calibration, rig)
    path = job.folder / FILE_NAME
    write_atomically(path, "\n".join(lines) + "\n")
    _check(path, calibrations, rig)
    return [path]


def _pair(calibration: Calibration, rig: Rig) -> list[str]:
    camera, lidar = rig.cameras[calibration.camera], rig.lidars[calibration.lidar]
    in_lidar = f"the LiDAR's frame {lidar.frame} (x forward, y left, z up)"
    in_camera = f"the camera's optical frame {camera.optical_frame} (x right, y down, z forward)"
    T_lidar_cam = invert(calibration.T_cam_lidar)
    # A point in front of the camera with round coordinates in the LiDAR's frame, easy to check by hand.
    point_lidar = np.round(transform(T_lidar_cam, np.array([[0.3, 0.2, 3.0]])), 2)
    point_camera = transform(calibration.T_cam_lidar, point_lidar)
    pixel, _ = camera.to_intrinsics().project(point_camera)
    forward = f"takes points from {in_lidar} to {in_camera}: p_cam = R p_lidar + t"
    backward = (
        f"takes points from {in_camera} to {in_lidar}: p_lidar = R p_cam + t; the camera's pose on the LiDAR"
    )
    lines = [
        f"  - camera: {quoted(calibration.camera)}",
        f"    channel: {quoted(calibration.channel)}",
        f"    lidar: {quoted(calibration.lidar)}",
        f"    camera_frame: {quoted(camera.optical_frame)}",
        f"    lidar_frame: {quoted(lidar.frame)}",
        f"    verdict: {calibration.verdict}",
        f"    reasons: {texts(finding.sentence for finding in calibration.findings)}",
    ]
    lines += _pose_block("T_cam_lidar", forward, calibration.T_cam_lidar)
    lines += [
        "      worked_point:",
        f"        p_lidar_m: {numbers(point_lidar[0])}",
        f"        p_cam_m: {numbers(point_camera[0])}",
    ]
    if np.isfinite(pixel).all():
        lines.append(f"        pixel: {numbers(pixel[0])}")
    lines += _pose_block("T_lidar_cam", backward, T_lidar_cam)
    lines += [
        "      worked_point:",
        f"        p_cam_m: {numbers(point_camera[0])}",
        f"        p_lidar_m: {numbers(point_lidar[0])}",
    ]
    return lines + _judgement(calibration)


def _pose_block(name: str, meaning: str, T: Array) -> list[str]:
    wxyz = quaternion_wxyz(T[:3, :3])
    return [
        f"    {name}:",
        f"      meaning: {quoted(meaning)}",
        "      matrix:",
        *rows(T, "        "),
        f"      translation_m: {numbers(T[:3, 3])}",
        f"      quaternion_wxyz: {numbers(wxyz)}",
        f"      quaternion_xyzw: {numbers(np.roll(wxyz, -1))}",
    ]


def _judgement(calibration: Calibration) -> list[str]:
    meaning = (
        "of T_cam_lidar: translation in m, then rotation vector in rad, both along the optical frame's axes, "
        "with R = exp(phi) R0 and t = t0 + tau, as in ROS PoseWithCovariance"
    )
    what = "start_is_globally_optimal" if calibration.is_start_certified else "is_globally_optimal"
    return [
        "    covariance:",
        f"      meaning: {quoted(meaning)}",
        "      matrix:",
        *rows(calibration.cov, "        "),
        f"    sigma_rotation_deg: {number(calibration.sigma_rotation_deg)}",
        f"    sigma_translation_m: {number(calibration.sigma_translation_m)}",
        f"    {what}: {'true' if calibration.certificate.is_optimal else 'false'}",
        f"    n_captures: {calibration.n_captures}",
        f"    captures_used: {texts(calibration.captures_used)}",
    ]


@reads_back
def _check(path: Path, calibrations: Sequence[Calibration], rig: Rig) -> None:
    import yaml

    pairs = yaml.safe_load(path.read_text(encoding="utf-8"))["pairs"]
    if len(pairs) != len(calibrations):
        raise LceRigError(f"{path}: {len(pairs)} pairs read back, {len(calibrations)} written")
    for pair, calibration in zip(pairs, calibrations, strict=True):
        for way, T in _poses(pair["T_cam_lidar"]):
            check_pose(path, f"T_cam_lidar.{way}", T, calibration, rig)
        for way, T in _poses(pair["T_lidar_cam"]):
            check_pose(path, f"T_lidar_cam.{way}", invert(T), calibration, rig)
        worked = pair["T_cam_lidar"]["worked_point"]
        point_camera = transform(calibration.T_cam_lidar, np.array([worked["p_lidar_m"]]))
        if not np.abs(point_camera - worked["p_cam_m"]).max() <= TOLERANCE:
            raise LceRigError(f"{path}: the example point of T_cam_lidar is wrong")


def _poses(block: Mapping[str, Any]) -> list[tuple[str, Array]]:
    """List the pose in each representation of the block."""
    t = np.array(block["translation_m"], dtype=np.float64)
    wxyz = np.array(block["quaternion_wxyz"], dtype=np.float64)
    x, y, z, w = block["quaternion_xyzw"]
    return [
        ("matrix", np.array(block["matrix"], dtype=np.float64)),
        ("quaternion_wxyz", pose(rotation_from_quaternion(wxyz), t)),
        ("quaternion_xyzw", pose(rotation_from_quaternion(np.array([w, x, y, z])), t)),
    ]
