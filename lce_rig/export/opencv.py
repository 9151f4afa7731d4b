"""opencv_CAMERA.yaml: camera matrix, distortion and extrinsics for cv::FileStorage."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lce_rig.core.calibration import Calibration
from lce_rig.core.geometry import Array
from lce_rig.export.files import numbers, quoted
from lce_rig.export.job import ExportJob


def export_opencv(job: ExportJob) -> list[Path]:
    """Write opencv_CAMERA.yaml of each camera and LiDAR."""
    return [job.write(f"opencv_{job.name_of(c)}.yaml", _content(c, job)) for c in job.chosen]


def _content(calibration: Calibration, job: ExportJob) -> list[str]:
    camera, lidar = job.rig.cameras[calibration.camera], job.rig.lidars[calibration.lidar]
    intrinsics = camera.to_intrinsics()
    R, t = calibration.T_cam_lidar[:3, :3], calibration.T_cam_lidar[:3, 3]
    is_fisheye = intrinsics.model == "equidistant"
    return [
        "%YAML:1.0",
        "---",
        *(f"# {line}" for line in job.head("OpenCV calibration", calibration, of_one_camera=True)),
        f"# {'cv::fisheye' if is_fisheye else 'cv'}::projectPoints(points_lidar, rvec, tvec, camera_matrix, "
        "distortion_coefficients)",
        f"camera: {quoted(calibration.camera)}",
        f"lidar: {quoted(calibration.lidar)}",
        f"camera_frame: {quoted(camera.optical_frame)}",
        f"lidar_frame: {quoted(lidar.frame)}",
        f"distortion_model: {quoted('fisheye' if is_fisheye else 'radtan')}",
        f"image_width: {intrinsics.width_px}",
        f"image_height: {intrinsics.height_px}",
        *_matrix("camera_matrix", intrinsics.matrix),
        *_matrix("distortion_coefficients", np.array([intrinsics.distortion or (0.0,) * 4])),
        *_matrix("T_cam_lidar", calibration.T_cam_lidar),
        *_matrix("R", R),
        *_matrix("rvec", Rotation.from_matrix(R).as_rotvec()[:, None]),
        *_matrix("tvec", t[:, None]),
    ]


def _matrix(key: str, matrix: Array) -> list[str]:
    n_rows, n_cols = matrix.shape
    return [
        f"{key}: !!opencv-matrix",
        f"   rows: {n_rows}",
        f"   cols: {n_cols}",
        "   dt: d",
        f"   data: {numbers(matrix.ravel())}",
    ]
