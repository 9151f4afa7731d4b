"""calib.json of direct_visual_lidar_calibration, for its viewer and as its initial guess.

References:
    https://github.com/koide3/direct_visual_lidar_calibration (calib.json; `T_lidar_camera` takes points from
    the camera to the LiDAR, as x y z qx qy qz qw)
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import invert, pose
from lce_rig.export.files import header, reads_back
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines
from lce_rig.export.probes import check_projection
from lce_rig.export.rotations import quaternion_wxyz, rotation_from_quaternion
from lce_rig.session.durable import write_atomically

_MODELS = {"radtan": "plumb_bob", "equidistant": "fisheye"}


def export_koide3(job: ExportJob) -> list[Path]:
    """Write calib_CAMERA.json of each camera and LiDAR and check it by reading it back.

    Raises:
        LceRigError: a file reads back differently.
    """
    paths = []
    for calibration in job.chosen:
        lens = lens_for(job, "koide3", calibration.camera, 5)
        path = job.folder / f"calib_{job.name_of(calibration)}.json"
        text = json.dumps(_document(calibration, lens, job), indent=2, ensure_ascii=False, allow_nan=False)
        write_atomically(path, text + "\n")
        _check(path, calibration, lens, job)
        paths.append(path)
    return paths


def _document(calibration: Calibration, lens: FittedLens, job: ExportJob) -> dict[str, Any]:
    camera, lidar = job.rig.cameras[calibration.camera], job.rig.lidars[calibration.lidar]
    T_lidar_cam = invert(calibration.T_cam_lidar)
    xyzw = np.roll(quaternion_wxyz(T_lidar_cam[:3, :3]), -1)
    head = header("calib.json", job.rig, [calibration], of_one_camera=True)
    intrinsics = lens.intrinsics
    values = (*T_lidar_cam[:3, 3], *xyzw)
    return {
        "about": [*head, *lens_lines(lens)],
        "camera": {
            "camera_model": _MODELS[intrinsics.model],
            "distortion_coeffs": list(intrinsics.distortion),
            "intrinsics": [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px],
        },
        "meta": {
            "image_topic": camera.channels[calibration.channels[0]].topic or f"/{calibration.camera}",
            "points_topic": lidar.topic or f"/{calibration.lidar}/points",
            "image_size": [intrinsics.width_px, intrinsics.height_px],
        },
        "results": {
            "T_lidar_camera": [float(value) for value in values],
            "init_T_lidar_camera": [float(value) for value in values],
        },
    }


@reads_back
def _check(path: Path, calibration: Calibration, lens: FittedLens, job: ExportJob) -> None:
    data = json.loads(path.read_text(encoding="utf-8"))
    x, y, z, qx, qy, qz, qw = data["results"]["T_lidar_camera"]
    T_lidar_cam = pose(rotation_from_quaternion(np.array([qw, qx, qy, qz])), np.array([x, y, z]))
    width, height = data["meta"]["image_size"]
    model: Any = next(model for model, name in _MODELS.items() if name == data["camera"]["camera_model"])
    fx, fy, cx, cy = data["camera"]["intrinsics"]
    distortion = tuple(data["camera"]["distortion_coeffs"])
    read = Intrinsics(fx, fy, cx, cy, width, height, model, distortion)
    check_projection(path, "T_lidar_camera", invert(T_lidar_cam), read, calibration, job.rig, lens.intrinsics)
