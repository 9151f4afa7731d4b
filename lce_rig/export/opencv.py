"""opencv_CAMERA.yaml: camera matrix, distortion and extrinsics for cv::FileStorage."""

from pathlib import Path

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.errors import LceRigError
from lce_rig.core.geometry import Array, pose
from lce_rig.export.files import header, numbers, quoted, reads_back
from lce_rig.export.job import ExportJob
from lce_rig.export.probes import check_projection
from lce_rig.session.durable import write_atomically


def export_opencv(job: ExportJob) -> list[Path]:
    """Write opencv_CAMERA.yaml of each camera and LiDAR and check it by reading it back.

    Raises:
        LceRigError: a file reads back differently.
    """
    paths = []
    for calibration in job.chosen:
        path = job.folder / f"opencv_{job.name_of(calibration)}.yaml"
        write_atomically(path, _text(calibration, job))
        _check(path, calibration, job)
        paths.append(path)
    return paths


def _text(calibration: Calibration, job: ExportJob) -> str:
    import cv2

    camera, lidar = job.rig.cameras[calibration.camera], job.rig.lidars[calibration.lidar]
    intrinsics = camera.to_intrinsics()
    R, t = calibration.T_cam_lidar[:3, :3], calibration.T_cam_lidar[:3, 3]
    given = intrinsics.distortion or (0.0,) * 4
    function = "cv::fisheye::projectPoints" if intrinsics.model == "equidistant" else "cv::projectPoints"
    lines = ["%YAML:1.0", "---"]
    lines += [
        f"# {line}" for line in header("OpenCV calibration", job.rig, [calibration], of_one_camera=True)
    ]
    lines += [
        f"# {function}(points_lidar, rvec, tvec, camera_matrix, distortion_coefficients)",
        f"camera: {quoted(calibration.camera)}",
        f"lidar: {quoted(calibration.lidar)}",
        f"camera_frame: {quoted(camera.optical_frame)}",
        f"lidar_frame: {quoted(lidar.frame)}",
        f"distortion_model: {quoted('fisheye' if intrinsics.model == 'equidistant' else 'radtan')}",
        f"image_width: {intrinsics.width_px}",
        f"image_height: {intrinsics.height_px}",
        *_matrix("camera_matrix", intrinsics.matrix),
        *_matrix("distortion_coefficients", np.array([given])),
        *_matrix("T_cam_lidar", calibration.T_cam_lidar),
        *_matrix("R", R),
        *_matrix("rvec", np.asarray(cv2.Rodrigues(R)[0], dtype=np.float64)),
        *_matrix("tvec", t[:, None]),
    ]
    return "\n".join(lines) + "\n"


def _matrix(key: str, matrix: Array) -> list[str]:
    n_rows, n_cols = matrix.shape
    return [
        f"{key}: !!opencv-matrix",
        f"   rows: {n_rows}",
        f"   cols: {n_cols}",
        "   dt: d",
        f"   data: {numbers(matrix.ravel())}",
    ]


@reads_back
def _check(path: Path, calibration: Calibration, job: ExportJob) -> None:
    import cv2

    try:
        file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        K, d, T, R, rvec, t = (
            np.array(file.getNode(key).mat(), dtype=np.float64)
            for key in ("camera_matrix", "distortion_coefficients", "T_cam_lidar", "R", "rvec", "tvec")
        )
        size = tuple(int(file.getNode(key).real()) for key in ("image_width", "image_height"))
        model = file.getNode("distortion_model").string()
    except cv2.error as error:
        raise LceRigError(f"{path}: cannot be read back: {' '.join(str(error).split())[:120]}") from error
    ros_model = "equidistant" if model == "fisheye" else "plumb_bob" if d.size <= 5 else "rational_polynomial"
    read = Intrinsics.from_ros(ros_model, K, tuple(d.ravel()), (size[0], size[1]))
    by_vector = pose(np.asarray(cv2.Rodrigues(rvec)[0]), t.ravel())
    for what, T_cam_lidar in (("T_cam_lidar", T), ("R, tvec", pose(R, t.ravel())), ("rvec, tvec", by_vector)):
        check_projection(path, what, T_cam_lidar, read, calibration, job.rig)
