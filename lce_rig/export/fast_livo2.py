"""FAST-LIVO2's extrinsics `Rcl`, `Pcl`, and its camera file.

References:
    https://github.com/hku-mars/FAST-LIVO2 (config/, p_cam = Rcl p_lidar + Pcl)
    https://github.com/xuankuzcr/rpg_vikit (camera_loader.h: the keys of each camera model)
"""

from pathlib import Path

from lce_rig.core.calibration import Calibration
from lce_rig.export.files import number, numbers, quoted
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines

_KEYS = {"radtan": ("cam_d0", "cam_d1", "cam_d2", "cam_d3"), "equidistant": ("k1", "k2", "k3", "k4")}
_MODELS = {"radtan": "Pinhole", "equidistant": "EquidistantCamera"}


def export_fast_livo2(job: ExportJob) -> list[Path]:
    """Write fast_livo2_CAMERA.yaml and fast_livo2_camera_CAMERA.yaml of each camera."""
    paths = []
    for calibration in job.chosen:
        lens = lens_for(job, "fast_livo2", calibration.camera, 4)
        name = job.name_of(calibration)
        paths.append(job.write(f"fast_livo2_{name}.yaml", _main(calibration, job)))
        paths.append(job.write(f"fast_livo2_camera_{name}.yaml", _camera(calibration, lens, job)))
    return paths


def _main(calibration: Calibration, job: ExportJob) -> list[str]:
    lidar = job.rig.lidars[calibration.lidar]
    head = job.head("FAST-LIVO2 extrinsics", calibration, of_one_camera=True)
    return [
        *(f"# {line}" for line in head),
        "# p_cam = Rcl p_lidar + Pcl. Put these keys into your own config: extrinsic_T and extrinsic_R, the",
        "# LiDAR on the IMU, are not known here, and the driver's settings stay yours",
        "common:",
        f"  img_topic: {quoted(job.image_topic(calibration))}",
        f"  lid_topic: {quoted(lidar.topic or f'/{calibration.lidar}/points')}",
        "extrin_calib:",
        f"  Rcl: {numbers(calibration.T_cam_lidar[:3, :3].ravel())}",
        f"  Pcl: {numbers(calibration.T_cam_lidar[:3, 3])}",
    ]


def _camera(calibration: Calibration, lens: FittedLens, job: ExportJob) -> list[str]:
    intrinsics = lens.intrinsics
    head = job.head("FAST-LIVO2 camera", calibration, of_one_camera=True)
    coefficients = zip(_KEYS[intrinsics.model], intrinsics.distortion, strict=True)
    return [
        *(f"# {line}" for line in (*head, *lens_lines(lens))),
        f"cam_model: {_MODELS[intrinsics.model]}",
        f"cam_width: {intrinsics.width_px}",
        f"cam_height: {intrinsics.height_px}",
        "scale: 1.0  # below 1, images are made smaller before use",
        f"cam_fx: {number(intrinsics.fx_px)}",
        f"cam_fy: {number(intrinsics.fy_px)}",
        f"cam_cx: {number(intrinsics.cx_px)}",
        f"cam_cy: {number(intrinsics.cy_px)}",
        *(f"{key}: {number(value)}" for key, value in coefficients),
    ]
