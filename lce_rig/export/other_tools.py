"""Formats of other tools: Kalibr, direct_visual_lidar_calibration, FAST-LIVO2, OpenCV and Autoware.

A camera model with more coefficients than a format supports is replaced by the best-fitting supported one.

Autoware's kit frame is `sensor_kit_base_link`. A LiDAR's entry there is the base of its housing, from which
its description leads to the frame of the points; a camera's is its body, `NAME/camera_link`.

References:
    https://github.com/koide3/direct_visual_lidar_calibration (calib.json; `T_lidar_camera` takes points from
    the camera to the LiDAR, as x y z qx qy qz qw)
    https://github.com/hku-mars/FAST-LIVO2 (config/, p_cam = Rcl p_lidar + Pcl)
    https://github.com/xuankuzcr/rpg_vikit (camera_loader.h: the keys of each camera model)
    https://autowarefoundation.github.io/autoware-documentation (creating a sensor model)
    https://github.com/ros-drivers/velodyne (velodyne_description: from the base to the centre)
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.phrasing import significant
from lce_rig.export import LENS_FITTED, NO_FRAME, ExportJob
from lce_rig.export.robot_tree import RobotTree
from lce_rig.export.writing import quaternion_xyzw, rpy
from lce_rig.lens.models import MODELS, convert, grid_rays

# Error assigned to a pixel that a model cannot project, px.
_UNDRAWN_PX = 100.0
# Above this the error is visible in matching and colouring.
_COARSE_PX = 0.5
_KOIDE3_MODELS = {"radtan": "plumb_bob", "equidistant": "fisheye"}
_LIVO2_KEYS = {"radtan": ("cam_d0", "cam_d1", "cam_d2", "cam_d3"), "equidistant": ("k1", "k2", "k3", "k4")}
_LIVO2_MODELS = {"radtan": "Pinhole", "equidistant": "EquidistantCamera"}


def fit_lens(given: Intrinsics, name: str) -> tuple[Intrinsics, float, float]:
    """Fit a model with fewer coefficients to given intrinsics over the whole image.

    Args:
        given: the intrinsics; with no more coefficients than the model, they are only padded with zeros.
        name: "radtan4" or "radtan5"; a fisheye stays a fisheye.

    Returns:
        The fit, and its distance from the given ones over the image, px, rms and maximum; 0 if identical.
    """
    model = MODELS[name if given.model == "radtan" else "equidistant"]
    n = len(model.coefficients)
    if not any(given.distortion[n:]):
        given = replace(given, distortion=given.distortion[:n])
    lens = model.intrinsics(convert(given, model), given.width_px, given.height_px)
    if len(given.distortion) <= n:
        return lens, 0.0, 0.0
    pixels, rays = grid_rays(given)
    off_px = np.nan_to_num(lens.project(rays)[0] - pixels, nan=_UNDRAWN_PX)
    miss_px = np.linalg.norm(off_px, axis=1)
    return lens, float(np.sqrt(np.mean(miss_px**2))), float(miss_px.max())


def lens_for(job: ExportJob, format_name: str, camera: str, model: str) -> tuple[Intrinsics, list[str]]:
    """Return a camera's model with the coefficients of a format; a refit is noted in file and finding.

    Args:
        job: the export, which receives the finding.
        format_name: name of the format, for the finding.
        camera: the camera's name.
        model: model that the format supports, see `fit_lens`.

    Returns:
        The model, and lines of the head.
    """
    lens, rms_px, max_px = fit_lens(job.rig.cameras[camera].to_intrinsics(), model)
    if not max_px:
        return lens, []
    severity = "note" if max_px < _COARSE_PX else "warning"
    figures = {"n_coefficients": len(lens.distortion), "rms_px": rms_px, "max_px": max_px}
    job.findings.append(LENS_FITTED(camera, severity=severity, format=format_name, **figures))
    return lens, [
        "camera model fitted to that of the profile, which has more coefficients: "
        f"{significant(rms_px, 3)} px rms, {significant(max_px, 3)} px at most over the image"
    ]


def _matrix(lens: Intrinsics) -> list[float]:
    return [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px]


def export_kalibr(job: ExportJob) -> list[Path]:
    """Write camchain_LIDAR.yaml, Kalibr's camera chain.

    Kalibr has four radtan coefficients; a camera with more gets the four that fit best.
    """
    lenses = {
        name: lens_for(job, "kalibr", name, "radtan4")
        for name in dict.fromkeys(c.camera for c in job.of_cameras)
    }
    paths = []
    for lidar in job.rig.lidars:
        chain = [c for c in job.of_cameras if c.lidar == lidar]
        head = job.head("Kalibr camchain", *chain)
        head.append("T_cam_lidar, which Kalibr ignores, takes points from the LiDAR to the camera")
        document: dict[str, Any] = {}
        for index, c in enumerate(chain):
            lens, lines = lenses[c.camera]
            head += [f"cam{index}: {line}" for line in lines]
            link = {"T_cn_cnm1": c.T_cam_lidar @ invert(chain[index - 1].T_cam_lidar)} if index else {}
            document[f"cam{index}"] = {
                **link,
                "T_cam_lidar": c.T_cam_lidar,
                **_kalibr_lens(lens, index, len(chain)),
                "rostopic": job.image_topic(c),
            }
        if chain:
            paths.append(job.write_yaml(f"camchain_{lidar}.yaml", head, document))
    return paths or _stereo_chain(job)


def _stereo_chain(job: ExportJob) -> list[Path]:
    """Write camchain.yaml of cameras without a LiDAR."""
    pairs = [c for c in job.calibrations if c.is_of_cameras]
    if not pairs:
        return []
    first = pairs[0].camera
    T_first = {first: np.eye(4)} | {c.lidar: c.T_cam_lidar for c in pairs if c.camera == first}
    names, document = list(T_first), {}
    head = job.head("Kalibr camchain", *pairs)
    for index, name in enumerate(names):
        lens, lines = lens_for(job, "kalibr", name, "radtan4")
        head += [f"cam{index}: {line}" for line in lines]
        link = {"T_cn_cnm1": invert(T_first[name]) @ T_first[names[index - 1]]} if index else {}
        document[f"cam{index}"] = link | _kalibr_lens(lens, index, len(names))
    return [job.write_yaml("camchain.yaml", head, document)]


def _kalibr_lens(lens: Intrinsics, index: int, n_cameras: int) -> dict[str, Any]:
    """List a camera of the chain."""
    return {
        "cam_overlaps": [i for i in range(n_cameras) if i != index],
        "camera_model": "pinhole",
        "distortion_coeffs": lens.distortion,
        "distortion_model": lens.model,
        "intrinsics": _matrix(lens),
        "resolution": [lens.width_px, lens.height_px],
    }


def export_koide3(job: ExportJob) -> list[Path]:
    """Write calib_CAMERA.json of direct_visual_lidar_calibration."""
    paths = []
    for c in job.of_cameras:
        lens, lines = lens_for(job, "koide3", c.camera, "radtan5")
        T_lidar_cam = invert(c.T_cam_lidar)
        values = [*T_lidar_cam[:3, 3].tolist(), *quaternion_xyzw(T_lidar_cam[:3, :3]).tolist()]
        document = {
            "about": [*job.head("calib.json", c, of_one_camera=True), *lines],
            "camera": {
                "camera_model": _KOIDE3_MODELS[lens.model],
                "distortion_coeffs": lens.distortion,
                "intrinsics": _matrix(lens),
            },
            "meta": {
                "image_topic": job.image_topic(c),
                "points_topic": job.points_topic(c),
                "image_size": [lens.width_px, lens.height_px],
            },
            "results": {"T_lidar_camera": values, "init_T_lidar_camera": values},
        }
        text = json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)
        paths.append(job.write(f"calib_{job.name_of(c)}.json", [text]))
    return paths


def export_fast_livo2(job: ExportJob) -> list[Path]:
    """Write FAST-LIVO2's fast_livo2_CAMERA.yaml (Rcl, Pcl) and fast_livo2_camera_CAMERA.yaml."""
    paths = []
    for c in job.of_cameras:
        head = [
            *job.head("FAST-LIVO2 extrinsics", c, of_one_camera=True),
            "p_cam = Rcl p_lidar + Pcl. Put these keys into your own config: extrinsic_T and extrinsic_R,",
            "the LiDAR on the IMU, are not known here, and the driver's settings stay yours",
        ]
        extrinsics = {
            "common": {"img_topic": job.image_topic(c), "lid_topic": job.points_topic(c)},
            "extrin_calib": {"Rcl": c.T_cam_lidar[:3, :3].ravel(), "Pcl": c.T_cam_lidar[:3, 3]},
        }
        paths.append(job.write_yaml(f"fast_livo2_{job.name_of(c)}.yaml", head, extrinsics))
        lens, lines = lens_for(job, "fast_livo2", c.camera, "radtan4")
        head = [*job.head("FAST-LIVO2 camera", c, of_one_camera=True), *lines]
        head.append("scale below 1: images are made smaller before use")
        camera = {"cam_model": _LIVO2_MODELS[lens.model], "cam_width": lens.width_px}
        camera |= {"cam_height": lens.height_px, "scale": 1.0}
        camera |= zip(("cam_fx", "cam_fy", "cam_cx", "cam_cy"), _matrix(lens), strict=True)
        camera |= zip(_LIVO2_KEYS[lens.model], lens.distortion, strict=True)
        paths.append(job.write_yaml(f"fast_livo2_camera_{job.name_of(c)}.yaml", head, camera))
    return paths


def export_opencv(job: ExportJob) -> list[Path]:
    """Write opencv_CAMERA.yaml for cv::FileStorage."""
    paths = []
    for c in job.of_cameras:
        camera, lidar = job.rig.cameras[c.camera], job.rig.lidars[c.lidar]
        intrinsics, R = camera.to_intrinsics(), c.T_cam_lidar[:3, :3]
        is_fisheye = intrinsics.model == "equidistant"
        file = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        project = "cv::fisheye::projectPoints" if is_fisheye else "cv::projectPoints"
        how = f"{project}(points_lidar, rvec, tvec, camera_matrix, distortion_coefficients)"
        for line in (*job.head("OpenCV calibration", c, of_one_camera=True), how):
            file.writeComment(line)
        content: dict[str, Any] = {
            "camera": c.camera,
            "lidar": c.lidar,
            "camera_frame": camera.optical_frame,
            "lidar_frame": lidar.frame,
            "distortion_model": "fisheye" if is_fisheye else "radtan",
            "image_width": intrinsics.width_px,
            "image_height": intrinsics.height_px,
            "camera_matrix": intrinsics.matrix,
            "distortion_coefficients": np.array([intrinsics.distortion or (0.0,) * 4]),
            "T_cam_lidar": c.T_cam_lidar,
            "R": R,
            "rvec": Rotation.from_matrix(R).as_rotvec()[:, None],
            "tvec": c.T_cam_lidar[:3, 3:],
        }
        for key, value in content.items():
            file.write(key, value)
        # OpenCV 5 writes "%YAML 1.2", which versions before 3.3 do not read.
        _, _, body = file.releaseAndGetString().rstrip("\n").partition("\n")
        paths.append(job.write(f"opencv_{job.name_of(c)}.yaml", ["%YAML:1.0", body]))
    return paths


KIT, BASE = "sensor_kit_base_link", "base_link"
KIT_FILE, BASE_FILE = "sensor_kit_calibration.yaml", "sensors_calibration.yaml"
_POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Height of the points' origin above the base of the housing in the LiDAR's description, m.
_CENTRE_M = {"VLP-16": 0.0377, "VLP16": 0.0377}


class _Entry(NamedTuple):
    """A sensor of the kit.

    Attributes:
        key: its name in the file.
        frame: frame of the LiDAR's points or the camera's body.
        T_key_frame: (4, 4), which Autoware's description of the sensor adds.
    """

    key: str
    frame: str
    T_key_frame: Array


def export_autoware(job: ExportJob) -> list[Path]:
    """Write Autoware's sensor_kit_calibration.yaml, and sensors_calibration.yaml if base_link is known.

    Without a frame `sensor_kit_base_link` in the robot's tree, the kit is at the first sensor's entry.
    """
    paths = []
    for index, tree in enumerate(job.trees):
        entries = _entries(tree, job)
        if KIT in tree.frames:
            T_root_kit = tree.find_pose(tree.root, KIT)
        else:
            first = min(entries, key=lambda entry: len(tree.chain(entry.frame)))
            T_root_kit = tree.find_pose(tree.root, first.frame) @ invert(first.T_key_frame)
        T_kit_root = invert(T_root_kit)
        poses = {
            entry.key: T_kit_root @ tree.find_pose(tree.root, entry.frame) @ invert(entry.T_key_frame)
            for entry in entries
        }
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        name = KIT_FILE.replace(".yaml", f"{suffix}.yaml")
        paths.append(_write_poses(job, name, "Autoware sensor kit calibration", {KIT: poses}, entries))
        if BASE in tree.frames:
            T_base_kit = invert(tree.find_pose(tree.root, BASE)) @ T_root_kit
            base = {BASE: {KIT: T_base_kit}}
            paths.append(_write_poses(job, BASE_FILE, "Autoware sensors calibration", base, ()))
        else:
            figures = {"format": "autoware", "file": BASE_FILE, "frame": BASE, "root": tree.root}
            job.findings.append(NO_FRAME(tree.root, **figures))
    return paths


def _entries(tree: RobotTree, job: ExportJob) -> list[_Entry]:
    """List the sensors of a tree with their names in Autoware."""
    entries = []
    for lidar in job.rig.lidars.values():
        if lidar.frame in tree.frames:
            # The base of the housing, where the LiDAR's description is known to begin.
            model = lidar.model.upper()
            heights_m = [height for name, height in _CENTRE_M.items() if model.startswith(name)]
            entry = _Entry(lidar.frame, lidar.frame, np.eye(4))
            if heights_m and not lidar.frame.endswith("_base_link"):
                T_base_lidar = pose(np.eye(3), np.array([0.0, 0.0, heights_m[0]]))
                entry = _Entry(f"{lidar.frame}_base_link", lidar.frame, T_base_lidar)
            entries.append(_below_kit(tree, job, lidar.frame) or entry)
    for name, camera in job.rig.cameras.items():
        if camera.frame in tree.frames:
            key = camera.frame if "/" in camera.frame else f"{name}/camera_link"
            entry = _Entry(key, camera.frame, np.eye(4))
            entries.append(_below_kit(tree, job, camera.frame) or entry)
    return entries


def _below_kit(tree: RobotTree, job: ExportJob, frame: str) -> _Entry | None:
    """Find the sensor's frame directly below the kit in the robot's tree, and the chain to the sensor."""
    if job.robot is None or frame not in job.robot.frames or KIT not in tree.chain(frame)[1:]:
        return None
    chain = tree.chain(frame)
    between = chain[1 : chain.index(KIT)]
    bodies = {lidar.frame for lidar in job.rig.lidars.values()}
    bodies |= {camera.frame for camera in job.rig.cameras.values()}
    if bodies.intersection(between):
        return None
    key = [frame, *between][-1]
    # The frames in between belong to the sensor's own description, which stays unchanged.
    return _Entry(key, frame, job.robot.find_pose(key, frame))


def _write_poses(
    job: ExportJob,
    name: str,
    content: str,
    poses: Mapping[str, Mapping[str, Array]],
    entries: Sequence[_Entry],
) -> Path:
    """Write poses by frame, under their parent frame."""
    head = job.head(content, *job.calibrations)
    for entry in entries:
        place = "the frame of the profile"
        if entry.key != entry.frame:
            x, y, z = entry.T_key_frame[:3, 3]
            is_same = np.allclose(entry.T_key_frame, np.eye(4))
            at = f"lies at ({x:.4f}, {y:.4f}, {z:.4f}) m in it, as its description must say"
            place = f"{entry.frame} {'of the profile' if is_same else at}"
        head.append(f"{entry.key}: {place}")
    document = {
        root: {
            frame: dict(zip(_POSE_KEYS, (*T[:3, 3].tolist(), *rpy(T[:3, :3]).tolist()), strict=True))
            for frame, T in below.items()
        }
        for root, below in poses.items()
    }
    return job.write_yaml(name, head, document)
