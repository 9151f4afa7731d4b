"""Formats of other tools: Kalibr, direct_visual_lidar_calibration, FAST-LIVO2, OpenCV and Autoware.

A camera model with more coefficients than a format has is replaced by the one that draws most alike.

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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lce_rig.core.calibration import Calibration
from lce_rig.core.camera import Intrinsics
from lce_rig.core.geometry import Array, invert, pose
from lce_rig.core.phrasing import significant
from lce_rig.export import LENS_FITTED, NO_FRAME, ExportJob
from lce_rig.export.robot_tree import FrameTree, RobotTree
from lce_rig.export.writing import number, numbers, quaternion_wxyz, quoted, rows, rpy

# Points of the grid over the image to which another model is fitted.
_GRID = 24
# A pixel that a trial model cannot draw counts as this far off.
_UNDRAWN_PX = 100.0
# Above this the error is visible in matching and colouring.
_COARSE_PX = 0.5
_KOIDE3_MODELS = {"radtan": "plumb_bob", "equidistant": "fisheye"}
_LIVO2_KEYS = {"radtan": ("cam_d0", "cam_d1", "cam_d2", "cam_d3"), "equidistant": ("k1", "k2", "k3", "k4")}
_LIVO2_MODELS = {"radtan": "Pinhole", "equidistant": "EquidistantCamera"}


@dataclass(frozen=True)
class FittedLens:
    """A camera model that stands for another one.

    Attributes:
        intrinsics: the model.
        rms_px, max_px: its distance from the other over the image; 0 if it is the same.
    """

    intrinsics: Intrinsics
    rms_px: float = 0.0
    max_px: float = 0.0


def fit_coefficients(intrinsics: Intrinsics, n_coefficients: int) -> FittedLens:
    """Find the model with four or five radtan coefficients that draws the whole image as another does.

    Minimises the sum over a grid of pixels of |project(ray) - pixel|^2 over camera matrix and coefficients.

    Args:
        intrinsics: any model; one that needs no more coefficients is returned as it is, filled with zeros.
        n_coefficients: 4 (k1 k2 p1 p2) or 5 (and k3).
    """
    coefficients = intrinsics.distortion
    if intrinsics.model == "equidistant":
        return FittedLens(intrinsics)
    if not any(coefficients[n_coefficients:]):
        filled = (*coefficients, *(0.0,) * n_coefficients)[:n_coefficients]
        return FittedLens(replace(intrinsics, distortion=filled))
    from scipy.optimize import least_squares

    u = np.linspace(0.0, intrinsics.width_px - 1.0, _GRID)
    v = np.linspace(0.0, intrinsics.height_px - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    rays = intrinsics.unproject(pixels)
    is_seen = np.isfinite(rays).all(axis=1)
    pixels, rays = pixels[is_seen], rays[is_seen]

    def off(x: Array) -> Array:
        drawn, _ = _model(intrinsics, x).project(rays)
        return np.nan_to_num(drawn - pixels, nan=_UNDRAWN_PX).ravel()

    start = np.array(
        [intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px, *(0.0,) * n_coefficients]
    )
    scale = np.array([intrinsics.fx_px] * 4 + [0.1, 0.1, 0.01, 0.01, 0.1][:n_coefficients])
    x = least_squares(off, start, x_scale=scale, method="trf", xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    miss_px = np.linalg.norm(off(x).reshape(-1, 2), axis=1)
    return FittedLens(_model(intrinsics, x), float(np.sqrt(np.mean(miss_px**2))), float(miss_px.max()))


def _model(intrinsics: Intrinsics, x: Array) -> Intrinsics:
    fx, fy, cx, cy, *distortion = (float(value) for value in x)
    return replace(intrinsics, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=tuple(distortion))


def lens_for(job: ExportJob, name: str, camera: str, n_coefficients: int) -> FittedLens:
    """Give a camera's model with the coefficients of a format, and say so where it had to be fitted.

    Args:
        job: which notes it.
        name: the format.
        camera: its name.
        n_coefficients: of radtan that the format has room for.
    """
    lens = fit_coefficients(job.rig.cameras[camera].to_intrinsics(), n_coefficients)
    if lens.max_px:
        fitted = LENS_FITTED(
            camera,
            severity="note" if lens.max_px < _COARSE_PX else "warning",
            format=name,
            n_coefficients=n_coefficients,
            rms_px=lens.rms_px,
            max_px=lens.max_px,
        )
        job.findings.append(fitted)
    return lens


def lens_lines(lens: FittedLens) -> list[str]:
    """Say at the head of a file that its camera model is a fit; empty where it is not."""
    if not lens.max_px:
        return []
    return [
        "camera model fitted to that of the profile, which has more coefficients: "
        f"{significant(lens.rms_px, 3)} px rms, {significant(lens.max_px, 3)} px at most over the image"
    ]


def export_kalibr(job: ExportJob) -> list[Path]:
    """Write camchain_LIDAR.yaml for each LiDAR.

    Kalibr has four radtan coefficients; a camera with more gets the four that fit best.
    """
    lenses = {
        name: lens_for(job, "kalibr", name, 4) for name in dict.fromkeys(c.camera for c in job.of_cameras)
    }
    chains = {lidar: [c for c in job.of_cameras if c.lidar == lidar] for lidar in job.rig.lidars}
    return [
        job.write(f"camchain_{lidar}.yaml", _camchain(chain, lenses, job))
        for lidar, chain in chains.items()
        if chain
    ]


def _camchain(chain: Sequence[Calibration], lenses: dict[str, FittedLens], job: ExportJob) -> list[str]:
    lines = [f"# {line}" for line in job.head("Kalibr camchain", *chain)]
    lines += ["# T_cam_lidar, which Kalibr ignores, takes points from the LiDAR to the camera"]
    before: Calibration | None = None
    for index, calibration in enumerate(chain):
        lens = lenses[calibration.camera]
        intrinsics = lens.intrinsics
        model = "equidistant" if intrinsics.model == "equidistant" else "radtan"
        camera_matrix = (intrinsics.fx_px, intrinsics.fy_px, intrinsics.cx_px, intrinsics.cy_px)
        lines += [*(f"# cam{index}: {line}" for line in lens_lines(lens)), f"cam{index}:"]
        if before is not None:
            lines += ["  T_cn_cnm1:", *rows(calibration.T_cam_lidar @ invert(before.T_cam_lidar), "    ")]
        lines += [
            "  T_cam_lidar:",
            *rows(calibration.T_cam_lidar, "    "),
            f"  cam_overlaps: [{', '.join(str(i) for i in range(len(chain)) if i != index)}]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {numbers(intrinsics.distortion)}",
            f"  distortion_model: {model}",
            f"  intrinsics: {numbers(camera_matrix)}",
            f"  resolution: [{intrinsics.width_px}, {intrinsics.height_px}]",
            f"  rostopic: {quoted(job.image_topic(calibration))}",
        ]
        before = calibration
    return lines


def export_koide3(job: ExportJob) -> list[Path]:
    """Write calib_CAMERA.json of each camera and LiDAR."""
    paths = []
    for calibration in job.of_cameras:
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
            "camera_model": _KOIDE3_MODELS[intrinsics.model],
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


def export_fast_livo2(job: ExportJob) -> list[Path]:
    """Write fast_livo2_CAMERA.yaml and fast_livo2_camera_CAMERA.yaml of each camera."""
    paths = []
    for calibration in job.of_cameras:
        lens = lens_for(job, "fast_livo2", calibration.camera, 4)
        name = job.name_of(calibration)
        paths.append(job.write(f"fast_livo2_{name}.yaml", _livo2_extrinsics(calibration, job)))
        paths.append(job.write(f"fast_livo2_camera_{name}.yaml", _livo2_camera(calibration, lens, job)))
    return paths


def _livo2_extrinsics(calibration: Calibration, job: ExportJob) -> list[str]:
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


def _livo2_camera(calibration: Calibration, lens: FittedLens, job: ExportJob) -> list[str]:
    intrinsics = lens.intrinsics
    head = job.head("FAST-LIVO2 camera", calibration, of_one_camera=True)
    coefficients = zip(_LIVO2_KEYS[intrinsics.model], intrinsics.distortion, strict=True)
    return [
        *(f"# {line}" for line in (*head, *lens_lines(lens))),
        f"cam_model: {_LIVO2_MODELS[intrinsics.model]}",
        f"cam_width: {intrinsics.width_px}",
        f"cam_height: {intrinsics.height_px}",
        "scale: 1.0  # below 1, images are made smaller before use",
        f"cam_fx: {number(intrinsics.fx_px)}",
        f"cam_fy: {number(intrinsics.fy_px)}",
        f"cam_cx: {number(intrinsics.cx_px)}",
        f"cam_cy: {number(intrinsics.cy_px)}",
        *(f"{key}: {number(value)}" for key, value in coefficients),
    ]


def export_opencv(job: ExportJob) -> list[Path]:
    """Write opencv_CAMERA.yaml of each camera and LiDAR."""
    return [job.write(f"opencv_{job.name_of(c)}.yaml", _content(c, job)) for c in job.of_cameras]


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


KIT, BASE = "sensor_kit_base_link", "base_link"
KIT_FILE, BASE_FILE = "sensor_kit_calibration.yaml", "sensors_calibration.yaml"
_POSE_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
# Height of the points' origin above the base of the housing in the LiDAR's description, m.
_CENTRE_M = {"VLP-16": 0.0377, "VLP16": 0.0377}


class _Entry(NamedTuple):
    """A sensor of the kit.

    Attributes:
        key: its name in the file.
        frame: of the LiDAR's points or the camera's body.
        T_key_frame: (4, 4), which Autoware's description of the sensor adds.
    """

    key: str
    frame: str
    T_key_frame: Array


def export_autoware(job: ExportJob) -> list[Path]:
    """Write the sensors' poses in the kit, and the kit's on the vehicle where that is known.

    Without a frame `sensor_kit_base_link` in the robot's tree, the kit is where the first sensor's entry is.
    """
    paths = []
    for index, tree in enumerate(job.trees):
        robot = RobotTree.of_joints("the tree", tree.joints)
        entries = _entries(tree, robot, job)
        if KIT in tree.frames:
            T_root_kit = robot.find_pose(tree.root, KIT)
        else:
            first = min(entries, key=lambda entry: len(robot.chain(entry.frame)))
            T_root_kit = robot.find_pose(tree.root, first.frame) @ invert(first.T_key_frame)
        T_kit_root = invert(T_root_kit)
        poses = {
            entry.key: T_kit_root @ robot.find_pose(tree.root, entry.frame) @ invert(entry.T_key_frame)
            for entry in entries
        }
        suffix = f"-{tree.root.replace('/', '_')}" if index else ""
        lines = _autoware_lines("Autoware sensor kit calibration", KIT, poses, entries, job)
        paths.append(job.write(KIT_FILE.replace(".yaml", f"{suffix}.yaml"), lines))
        if tree.root == BASE or BASE in tree.frames:
            T_base_kit = invert(robot.find_pose(tree.root, BASE)) @ T_root_kit
            lines = _autoware_lines("Autoware sensors calibration", BASE, {KIT: T_base_kit}, (), job)
            paths.append(job.write(BASE_FILE, lines))
        else:
            figures = {"format": "autoware", "file": BASE_FILE, "frame": BASE, "root": tree.root}
            job.findings.append(NO_FRAME(tree.root, severity="note", **figures))
    return paths


def _entries(tree: FrameTree, robot: RobotTree, job: ExportJob) -> list[_Entry]:
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
            entries.append(_below_kit(robot, job, lidar.frame) or entry)
    for name, camera in job.rig.cameras.items():
        if camera.frame in tree.frames:
            key = camera.frame if "/" in camera.frame else f"{name}/camera_link"
            entry = _Entry(key, camera.frame, np.eye(4))
            entries.append(_below_kit(robot, job, camera.frame) or entry)
    return entries


def _below_kit(robot: RobotTree, job: ExportJob, frame: str) -> _Entry | None:
    """Find the sensor's frame directly below the kit in the robot's own tree, with the robot's way to it."""
    if job.robot is None or frame not in job.robot.frames or KIT not in robot.chain(frame)[1:]:
        return None
    chain = robot.chain(frame)
    between = chain[1 : chain.index(KIT)]
    bodies = {lidar.frame for lidar in job.rig.lidars.values()}
    bodies |= {camera.frame for camera in job.rig.cameras.values()}
    if bodies.intersection(between):
        return None
    key = [frame, *between][-1]
    # What lies between is the sensor's description, which stays as the robot has it.
    return _Entry(key, frame, job.robot.find_pose(key, frame))


def _autoware_lines(
    content: str, root: str, poses: Mapping[str, Array], entries: Sequence[_Entry], job: ExportJob
) -> list[str]:
    lines = [f"# {line}" for line in job.head(content, *job.chosen)]
    for entry in entries:
        place = "the frame of the profile"
        if entry.key != entry.frame:
            x, y, z = entry.T_key_frame[:3, 3]
            is_same = np.allclose(entry.T_key_frame, np.eye(4))
            at = f"lies at ({x:.4f}, {y:.4f}, {z:.4f}) m in it, as its description must say"
            place = f"{entry.frame} {'of the profile' if is_same else at}"
        lines.append(f"# {entry.key}: {place}")
    lines.append(f"{root}:")
    for frame, T in poses.items():
        values = (*T[:3, 3], *rpy(T[:3, :3]))
        lines.append(f"  {quoted(frame)}:")
        lines += [f"    {key}: {number(value)}" for key, value in zip(_POSE_KEYS, values, strict=True)]
    return lines
