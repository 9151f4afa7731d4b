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
from lce_rig.core.geometry import invert
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines
from lce_rig.export.rotations import quaternion_wxyz

_MODELS = {"radtan": "plumb_bob", "equidistant": "fisheye"}


def export_koide3(job: ExportJob) -> list[Path]:
    """Write calib_CAMERA.json of each camera and LiDAR."""
    paths = []
    for calibration in job.chosen:
        lens = lens_for(job, "koide3", calibration.camera, 5)
        text = json.dumps(_document(calibration, lens, job), indent=2, ensure_ascii=False, allow_nan=False)
        paths.append(job.write(f"calib_{job.name_of(calibration)}.json", [text]))
    return paths


def _document(calibration: Calibration, lens: FittedLens, job: ExportJob) -> dict[str, Any]:
    lidar = job.rig.lidars[calibration.lidar]
    T_lidar_cam = invert(calibration.T_cam_lidar)
    xyzw = np.roll(quaternion_wxyz(T_lidar_cam[:3, :3]), -1)
    head = job.head("calib.json", calibration, of_one_camera=True)
    intrinsics = lens.intrinsics
    values = [*T_lidar_cam[:3, 3].tolist(), *xyzw.tolist()]
    return {
        "about": [*head, *lens_lines(lens)],
        "camera": {
            "camera_model": _MODELS[intrinsics.model],
            "distortion_coeffs": list(intrinsics.distortion),
            "intrinsics": [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px],
        },
        "meta": {
            "image_topic": job.image_topic(calibration),
            "points_topic": lidar.topic or f"/{calibration.lidar}/points",
            "image_size": [intrinsics.width_px, intrinsics.height_px],
        },
        "results": {
            "T_lidar_camera": values,
            "init_T_lidar_camera": values,
        },
    }
