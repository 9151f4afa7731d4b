"""FAST-LIVO2's extrinsics `Rcl`, `Pcl`, and its camera file.

References:
    https://github.com/hku-mars/FAST-LIVO2 (config/, p_cam = Rcl p_lidar + Pcl)
    https://github.com/xuankuzcr/rpg_vikit (camera_loader.h: the keys of each camera model)
"""

from pathlib import Path
from typing import Any

import numpy as np

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import pose
from lce_rig.export.files import header, number, numbers, quoted, reads_back
from lce_rig.export.job import ExportJob
from lce_rig.export.lens import FittedLens, lens_for, lens_lines
from lce_rig.export.probes import check_projection
from lce_rig.session.durable import write_atomically

_KEYS = {"radtan": ("cam_d0", "cam_d1", "cam_d2", "cam_d3"), "equidistant": ("k1", "k2", "k3", "k4")}
_MODELS = {"radtan": "Pinhole", "equidistant": "EquidistantCamera"}


def export_fast_livo2(job: ExportJob) -> list[Path]:
    """Write fast_livo2_CAMERA.yaml and fast_livo2_camera_CAMERA.yaml of each camera, and read them back.

    Raises:
        LceRigError: a file reads back differently.
    """
    paths = []
    for calibration in job.chosen:
        lens = lens_for(job, "fast_livo2", calibration.camera, 4)
        name = job.name_of(calibration)
        main = job.folder / f"fast_livo2_{name}.yaml"
        camera = job.folder / f"fast_livo2_camera_{name}.yaml"
        write_atomically(main, _main_text(calibration, job))
        write_atomically(camera, _camera_text(calibration, lens, job))
        _check(main, camera, calibration, lens, job)
        paths += [main, camera]
    return paths


def _main_text(calibration: Calibration, job: ExportJob) -> str:
    camera, lidar = job.rig.cameras[calibration.camera], job.rig.lidars[calibration.lidar]
    lines = [
        f"# {line}" for line in header("FAST-LIVO2 extrinsics", job.rig, [calibration], of_one_camera=True)
    ]
    lines += [
        "# p_cam = Rcl p_lidar + Pcl. Put these keys into your own config: extrinsic_T and extrinsic_R, the",
        "# LiDAR on the IMU, are not known here, and the driver's settings stay yours",
        "common:",
        f"  img_topic: {quoted(camera.channels[calibration.channels[0]].topic or f'/{calibration.camera}')}",
        f"  lid_topic: {quoted(lidar.topic or f'/{calibration.lidar}/points')}",
        "extrin_calib:",
        f"  Rcl: {numbers(calibration.T_cam_lidar[:3, :3].ravel())}",
        f"  Pcl: {numbers(calibration.T_cam_lidar[:3, 3])}",
    ]
    return "\n".join(lines) + "\n"


def _camera_text(calibration: Calibration, lens: FittedLens, job: ExportJob) -> str:
    intrinsics = lens.intrinsics
    head = header("FAST-LIVO2 camera", job.rig, [calibration], of_one_camera=True)
    lines = [f"# {line}" for line in (*head, *lens_lines(lens))]
    lines += [
        f"cam_model: {_MODELS[intrinsics.model]}",
        f"cam_width: {intrinsics.width_px}",
        f"cam_height: {intrinsics.height_px}",
        "scale: 1.0  # below 1, images are made smaller before use",
        f"cam_fx: {number(intrinsics.fx_px)}",
        f"cam_fy: {number(intrinsics.fy_px)}",
        f"cam_cx: {number(intrinsics.cx_px)}",
        f"cam_cy: {number(intrinsics.cy_px)}",
    ]
    keys = _KEYS[intrinsics.model]
    lines += [f"{key}: {number(value)}" for key, value in zip(keys, intrinsics.distortion, strict=True)]
    return "\n".join(lines) + "\n"


@reads_back
def _check(main: Path, camera: Path, calibration: Calibration, lens: FittedLens, job: ExportJob) -> None:
    import yaml

    block = yaml.safe_load(main.read_text(encoding="utf-8"))["extrin_calib"]
    T_cam_lidar = pose(np.array(block["Rcl"]).reshape(3, 3), np.array(block["Pcl"]))
    data = yaml.safe_load(camera.read_text(encoding="utf-8"))
    model: Any = next(model for model, name in _MODELS.items() if name == data["cam_model"])
    fx, fy, cx, cy = (float(data[f"cam_{key}"]) for key in ("fx", "fy", "cx", "cy"))
    distortion = tuple(float(data[key]) for key in _KEYS[model])
    read = Intrinsics(fx, fy, cx, cy, data["cam_width"], data["cam_height"], model, distortion)
    check_projection(main, "Rcl, Pcl", T_cam_lidar, read, calibration, job.rig, lens.intrinsics)
