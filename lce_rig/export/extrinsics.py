"""extrinsics.yaml: pose and inverse, with meaning, example point and uncertainty; references."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.bounds import MAX_BYTES
from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import SessionError, reading
from lce_rig.core.files import read_json
from lce_rig.core.geometry import ROUNDING, Array, invert, parse_pose, transform
from lce_rig.export import ExportJob
from lce_rig.export.writing import quaternion_xyzw
from lce_rig.rig import Rig


def export_extrinsics(job: ExportJob) -> list[Path]:
    """Write extrinsics.yaml: pose, inverse, example point, covariance."""
    pairs = [_pair(calibration, job.rig) for calibration in job.calibrations]
    document = {"format_version": 1, "rig": job.rig.name, "made_by": MADE_BY, "pairs": pairs}
    return [job.write_yaml("extrinsics.yaml", job.head("extrinsics", *job.calibrations), document)]


def _pair(c: Calibration, rig: Rig) -> dict[str, Any]:
    """List the sensors, the verdict, the pose with its inverse and its covariance."""
    lidar, inverse = rig.frame_of(c.lidar), invert(c.T_cam_lidar)
    points: tuple[dict[str, Any], dict[str, Any]] = {}, {}
    if c.is_of_lidars:
        first = rig.lidars[c.camera].frame
        axes = f"the axes of {first}"
        names = {"lidar": c.camera, "other_lidar": c.lidar, "lidar_frame": first, "other_lidar_frame": lidar}
        poses = "T_lidar_other", "T_other_lidar"
        forward = f"takes points from {lidar} to {first}: p_lidar = R p_other + t"
        forward += f"; the pose of {lidar} in {first}"
        backward = f"takes points from {first} to {lidar}: p_other = R p_lidar + t"
    elif c.is_of_cameras:
        first, second = rig.cameras[c.camera].optical_frame, rig.cameras[c.lidar].optical_frame
        axes = f"the axes of {first}"
        names = {"camera": c.camera, "channel": c.channel, "other_camera": c.lidar}
        names |= {"camera_frame": first, "other_camera_frame": second}
        poses = "T_cam_other", "T_other_cam"
        forward = f"takes points from {second} to {first} (both x right, y down, z forward): "
        forward += f"p_cam = R p_other + t; the pose of {second} in {first}"
        backward = f"takes points from {first} to {second}: p_other = R p_cam + t"
    else:
        camera, axes = rig.cameras[c.camera], "the optical frame's axes"
        names = {"camera": c.camera, "channel": c.channel, "lidar": c.lidar}
        names |= {"camera_frame": camera.optical_frame, "lidar_frame": lidar}
        poses, points = ("T_cam_lidar", "T_lidar_cam"), _worked_point(c, inverse, camera.to_intrinsics())
        in_lidar = f"the LiDAR's frame {lidar} (x forward, y left, z up)"
        in_camera = f"the camera's optical frame {camera.optical_frame} (x right, y down, z forward)"
        forward = f"takes points from {in_lidar} to {in_camera}: p_cam = R p_lidar + t"
        backward = f"takes points from {in_camera} to {in_lidar}: p_lidar = R p_cam + t"
        backward += "; the camera's pose on the LiDAR"
    # Subtract this from the points' ranges before use.
    at = {"lidar": c.camera, "other_lidar": c.lidar} if c.is_of_lidars else {"lidar": c.lidar}
    offsets_m = {key: rig.lidars[name].range_offset_m for key, name in at.items() if name in rig.lidars}
    subtracted = {f"{name}_range_offset_m": value for name, value in offsets_m.items() if value}
    proven = "start_is_globally_optimal" if c.is_start_certified else "is_globally_optimal"
    return {
        **names,
        **subtracted,
        "verdict": c.verdict,
        "reasons": [finding.sentence for finding in c.findings],
        poses[0]: _pose_block(forward, c.T_cam_lidar) | points[0],
        poses[1]: _pose_block(backward, inverse) | points[1],
        "covariance": {
            "meaning": f"of {poses[0]}: translation in m, then rotation vector in rad, both along {axes}, "
            "with R = exp(phi) R0 and t = t0 + tau, as in ROS PoseWithCovariance",
            "matrix": c.cov,
        },
        "sigma_rotation_deg": c.sigma_rotation_deg,
        "sigma_translation_m": c.sigma_translation_m,
        proven: c.certificate.is_optimal,
        "n_captures": c.n_captures,
        "captures_used": c.captures_used,
    }


def _worked_point(
    c: Calibration, T_lidar_cam: Array, lens: Intrinsics
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a point in front of the camera, rounded in the LiDAR's frame, to check pose and inverse."""
    point_lidar = np.round(transform(T_lidar_cam, np.array([[0.3, 0.2, 3.0]])), 2)
    point_camera = transform(c.T_cam_lidar, point_lidar)
    pixel, _ = lens.project(point_camera)
    there = {"p_lidar_m": point_lidar[0], "p_cam_m": point_camera[0]}
    back = {"p_cam_m": point_camera[0], "p_lidar_m": point_lidar[0]}
    if np.isfinite(pixel).all():
        there["pixel"] = pixel[0]
    return {"worked_point": there}, {"worked_point": back}


def _pose_block(meaning: str, T: Array) -> dict[str, Any]:
    xyzw = quaternion_xyzw(T[:3, :3])
    return {
        "meaning": meaning,
        "matrix": T,
        "translation_m": T[:3, 3],
        "quaternion_wxyz": np.roll(xyzw, 1),
        "quaternion_xyzw": xyzw,
    }


@dataclass(frozen=True, eq=False)
class Reference:
    """T_cam_lidar (4, 4) by (camera, lidar), and a default for other pairs."""

    by_pair: Mapping[tuple[str, str], Array]
    default: Array | None

    def of(self, camera: str, lidar: str) -> Array | None:
        """Return the reference of a pair of sensors; None if the file has none."""
        return self.by_pair.get((camera, lidar), self.default)


def read_reference(path: Path | str) -> Reference:
    """Read truth.json, result.json or any JSON with a 4x4 `T_cam_lidar`, at the top or in a list `pairs`.

    Raises:
        SessionError: the file has none, or it is not a rigid transform.
    """
    path = Path(path)
    with reading(path, SessionError, most_bytes=MAX_BYTES):
        document = read_json(path)
    if not isinstance(document, dict):
        raise SessionError(f"{path}: holds no T_cam_lidar")
    pairs = document.get("pairs")
    by_pair = {
        (str(pair.get("camera")), str(pair.get("lidar"))): _pose(path, f"pairs[{i}].T_cam_lidar", pair)
        for i, pair in enumerate(pairs if isinstance(pairs, list) else [])
        if isinstance(pair, dict) and "T_cam_lidar" in pair
    }
    default = None if by_pair else _pose(path, "T_cam_lidar", document)
    return Reference(by_pair, default)


def _pose(path: Path, key: str, holder: Mapping[str, Any]) -> Array:
    try:
        return parse_pose(holder.get("T_cam_lidar"), ROUNDING)
    except ValueError as error:
        raise SessionError(
            f"{path}: {key} {error}",
            "Give T_cam_lidar as a 4x4 rigid transform from the LiDAR to the camera.",
        ) from error
