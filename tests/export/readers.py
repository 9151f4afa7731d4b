"""Every output read by a program that is not ours: where it puts the points that the result projects.

A reader takes the folder of an export and returns the pixels (N, 2) of given LiDAR points, by the documented
conventions of the format, through its own parser and OpenCV's projection. Tests run all of them.
"""

import json
import shlex
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from lce_rig.core.calibration import Calibration, Metrics
from lce_rig.core.data import Image, Scan
from lce_rig.core.geometry import Array, exp_so3, invert, pose, transform
from lce_rig.export import EXPORTS, write_exports
from lce_rig.export.other_tools import fit_lens
from lce_rig.rig import Rig, load_rig
from lce_rig.rig.profile import Mount
from lce_rig.session import Session
from tests.saved_results import made_calibration

Lens = tuple[str, Array, Array]
"""Model ("fisheye" or another), camera matrix (3, 3), coefficients."""


@dataclass(frozen=True, eq=False)
class Case:
    """What was exported, and what readers may know beside the files: names, no figures of the result."""

    folder: Path
    rig: Rig
    calibration: Calibration
    points_lidar: Array
    lens: Lens

    @property
    def camera(self):
        """The camera's name."""
        return self.calibration.camera

    @property
    def frames(self):
        """The camera's optical frame and the LiDAR's frame."""
        camera, lidar = self.rig.cameras[self.camera], self.rig.lidars[self.calibration.lidar]
        return camera.optical_frame, lidar.frame


def project(points_lidar, T_cam_lidar, lens):
    """Draw points by OpenCV."""
    model, K, distortion = lens
    function = cv2.fisheye.projectPoints if model == "fisheye" else cv2.projectPoints
    points = transform(T_cam_lidar, points_lidar)[:, None]
    return np.asarray(function(points, np.zeros(3), np.zeros(3), K, distortion)[0].reshape(-1, 2))


def _matrix(xyz, R):
    return pose(np.asarray(R, dtype=np.float64).reshape(3, 3), np.asarray(xyz, dtype=np.float64))


def _chained(joints, optical, lidar):
    def from_root(frame):
        T = np.eye(4)
        while frame in joints:
            frame, T_parent_child = joints[frame]
            T = T_parent_child @ T
        return T

    return np.asarray(np.linalg.inv(from_root(optical)) @ from_root(lidar))


def _yaml(path):
    return yaml.safe_load(path.read_text(encoding="utf-8"))


def _extrinsics(case):
    (pair,) = _yaml(case.folder / "extrinsics.yaml")["pairs"]
    block = pair["T_cam_lidar"]
    R = Rotation.from_quat(block["quaternion_xyzw"]).as_matrix()
    return project(case.points_lidar, _matrix(block["translation_m"], R), case.lens)


def _urdf(case, name=None):
    from yourdfpy import URDF

    robot = URDF.load(str(case.folder / (name or f"{case.rig.name}.urdf")), load_meshes=False)
    optical, lidar = case.frames
    return project(case.points_lidar, np.asarray(robot.get_transform(lidar, optical)), case.lens)


def _info_lens(data):
    model = "fisheye" if data["distortion_model"] == "equidistant" else "radtan"
    K = np.reshape(data["camera_matrix"]["data"], (3, 3))
    return model, K, np.array(data["distortion_coefficients"]["data"])


def _camera_info(case):
    lens = _info_lens(_yaml(case.folder / f"camera_info_{case.camera}.yaml"))
    return project(case.points_lidar, case.calibration.T_cam_lidar, lens)


def _static_tf(case):
    """Parse the lines of ROS 2 as a shell and the publisher's options do."""
    lines = (case.folder / "static_transforms.txt").read_text(encoding="utf-8").splitlines()
    calls = [shlex.split(line)[4:] for line in lines if line.startswith("ros2 run tf2_ros static")]
    return _published(case, calls)


def _published(case, calls):
    joints = {}
    for words in calls:
        given = dict(zip(words[::2], words[1::2], strict=True))
        xyz = [float(given[f"--{axis}"]) for axis in "xyz"]
        quaternion = [float(given[f"--q{axis}"]) for axis in "xyzw"]
        T = _matrix(xyz, Rotation.from_quat(quaternion).as_matrix())
        joints[given["--child-frame-id"]] = given["--frame-id"], T
    return project(case.points_lidar, _chained(joints, *case.frames), case.lens)


def _ros2_launch(case):
    """Run the launch file as `ros2 launch` does, with classes that keep what they are given."""
    names = {"launch": "LaunchDescription", "launch_ros": "", "launch_ros.actions": "Node"}
    modules = {name: ModuleType(name) for name in names}
    modules["launch"].LaunchDescription = list  # type: ignore[attr-defined]
    modules["launch_ros.actions"].Node = dict  # type: ignore[attr-defined]
    before = {name: sys.modules.get(name) for name in names}
    sys.modules.update(modules)
    try:
        space = {}
        exec((case.folder / f"{case.rig.name}.launch.py").read_text(encoding="utf-8"), space)
        nodes = space["generate_launch_description"]()
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module
    if {(node["package"], node["executable"]) for node in nodes} != {
        ("tf2_ros", "static_transform_publisher")
    }:
        raise ValueError("another node is started")
    return _published(case, [node["arguments"] for node in nodes])


def _messages(path):
    """Read all messages of an mcap file by topic."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    found = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def _joints(messages):
    joints = {}
    for each in messages[0].transforms:
        t, q = each.transform.translation, each.transform.rotation
        T = _matrix((t.x, t.y, t.z), Rotation.from_quat((q.x, q.y, q.z, q.w)).as_matrix())
        joints[each.child_frame_id] = each.header.frame_id, T
    return joints


def _tf_static_rosbags(case):
    from rosbags.highlevel import AnyReader

    with AnyReader([case.folder / "tf_static"]) as reader:
        (connection,) = reader.connections
        qos = connection.ext.offered_qos_profiles[0]
        if (qos.durability.name, qos.reliability.name) != ("TRANSIENT_LOCAL", "RELIABLE"):
            raise ValueError(f"late subscribers miss it: {qos}")
        messages = [reader.deserialize(raw, connection.msgtype) for _, _, raw in reader.messages()]
    return project(case.points_lidar, _chained(_joints(messages), *case.frames), case.lens)


def _kalibr(case):
    block = _yaml(case.folder / f"camchain_{case.calibration.lidar}.yaml")["cam0"]
    fx, fy, cx, cy = block["intrinsics"]
    model = "fisheye" if block["distortion_model"] == "equidistant" else "radtan"
    lens = model, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array(block["distortion_coeffs"])
    return project(case.points_lidar, np.array(block["T_cam_lidar"]), lens)


def _autoware(case):
    """Compose as Autoware's xacro does: kit, housing and its centre; kit, body and its optical frame."""

    def matrix(block):
        R = Rotation.from_euler("xyz", [block[angle] for angle in ("roll", "pitch", "yaw")]).as_matrix()
        return _matrix([block[axis] for axis in "xyz"], R)

    kit = _yaml(case.folder / "sensor_kit_calibration.yaml")["sensor_kit_base_link"]
    base = _yaml(case.folder / "sensors_calibration.yaml")["base_link"]["sensor_kit_base_link"]
    joints = {"kit": ("base_link", matrix(base))}
    joints |= {key: ("kit", matrix(block)) for key, block in kit.items()}
    optical, lidar = case.frames
    joints[lidar] = f"{lidar}_base_link", _matrix([0, 0, 0.0377], np.eye(3))  # Velodyne's VLP-16.urdf.xacro
    turn = Rotation.from_euler("xyz", [-np.pi / 2, 0, -np.pi / 2]).as_matrix()
    joints[optical] = f"{case.camera}/camera_link", _matrix(np.zeros(3), turn)
    return project(case.points_lidar, _chained(joints, optical, lidar), case.lens)


def _fast_livo2(case):
    given = _yaml(case.folder / f"fast_livo2_{case.camera}.yaml")["extrin_calib"]
    camera = _yaml(case.folder / f"fast_livo2_camera_{case.camera}.yaml")
    fx, fy, cx, cy = (camera[f"cam_{key}"] * camera["scale"] for key in ("fx", "fy", "cx", "cy"))
    is_fisheye = camera["cam_model"] == "EquidistantCamera"
    keys = [f"k{i}" for i in range(1, 5)] if is_fisheye else [f"cam_d{i}" for i in range(4)]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    lens = "fisheye" if is_fisheye else "radtan", K, np.array([camera[key] for key in keys])
    return project(case.points_lidar, _matrix(given["Pcl"], given["Rcl"]), lens)


def _koide3(case):
    data = json.loads((case.folder / f"calib_{case.camera}.json").read_text(encoding="utf-8"))
    *xyz, qx, qy, qz, qw = data["results"]["T_lidar_camera"]
    T_lidar_cam = _matrix(xyz, Rotation.from_quat([qx, qy, qz, qw]).as_matrix())
    fx, fy, cx, cy = data["camera"]["intrinsics"]
    model = "fisheye" if data["camera"]["camera_model"] == "fisheye" else "radtan"
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    lens = model, K, np.array(data["camera"]["distortion_coeffs"])
    return project(case.points_lidar, np.linalg.inv(T_lidar_cam), lens)


def _opencv(case):
    file = cv2.FileStorage(str(case.folder / f"opencv_{case.camera}.yaml"), cv2.FILE_STORAGE_READ)
    names = ("rvec", "tvec", "camera_matrix", "distortion_coefficients")
    rvec, tvec, K, distortion = (file.getNode(name).mat() for name in names)
    is_fisheye = file.getNode("distortion_model").string() == "fisheye"
    function = cv2.fisheye.projectPoints if is_fisheye else cv2.projectPoints
    return np.asarray(function(case.points_lidar[:, None], rvec, tvec, K, distortion)[0].reshape(-1, 2))


def _mcap(case):
    """Read transforms and camera model; images and points must be those of the session."""
    name = f"{case.rig.name}_session"
    found = _messages(case.folder / name / f"{name}.mcap")
    (info,) = found[next(topic for topic in found if topic.endswith("/camera_info"))]
    (projected,) = found[next(topic for topic in found if topic.endswith("/projected/compressed"))]
    (cloud,) = (each for topic in found for each in found[topic] if hasattr(each, "point_step"))
    (image,) = (each for topic in found for each in found[topic] if hasattr(each, "encoding"))
    optical, lidar = case.frames
    if (cloud.header.frame_id, image.header.frame_id, info.header.frame_id) != (lidar, optical, optical):
        raise ValueError("messages in other frames")
    if (info.header.stamp.sec, info.header.stamp.nanosec) != (
        image.header.stamp.sec,
        image.header.stamp.nanosec,
    ):
        raise ValueError("an image and its camera model of different times")
    if not np.array_equal(np.frombuffer(image.data, np.uint8), session_image(case.rig, case.camera).ravel()):
        raise ValueError("another image")
    read = np.frombuffer(cloud.data, np.uint8).reshape(-1, cloud.point_step)[:, :12].copy().view("<f4")
    if not np.array_equal(read, case.points_lidar.astype(np.float32)):
        raise ValueError("other points")
    drawn = cv2.imdecode(np.frombuffer(projected.data, np.uint8), cv2.IMREAD_COLOR)
    if drawn.shape[:2] != (info.height, info.width):
        raise ValueError("a projected cloud of another size")
    lens = "fisheye" if info.distortion_model == "equidistant" else "radtan", np.reshape(info.k, (3, 3))
    T_cam_lidar = _chained(_joints(found["/tf_static"]), optical, lidar)
    return project(case.points_lidar, T_cam_lidar, (*lens, np.array(info.d)))


def _ply(case):
    """Read positions and colours; a colour says from which pixel it was taken.

    The image's blue and green are the column's and row's number. Where a colour is as the projection says,
    the pixel is that of the projection; elsewhere it is the one that the colour names.
    """
    import open3d

    cloud = open3d.t.io.read_point_cloud(str(case.folder / f"coloured_{case.camera}.ply"))
    positions, colours = cloud.point.positions.numpy(), cloud.point.colors.numpy().astype(int)
    wanted = project(case.points_lidar, case.calibration.T_cam_lidar, case.lens)
    order = [int(np.abs(positions - p).sum(axis=1).argmin()) for p in case.points_lidar.astype(np.float32)]
    if not np.array_equal(positions[order], case.points_lidar.astype(np.float32)):
        raise ValueError("other points")
    named = colours[order][:, [2, 1]]
    nearest = np.round(wanted).astype(int)
    return wanted + (named - nearest % 256)


def probe_points(calibration, rig):
    """List points (N, 3) m, frame LiDAR, that cover the camera's image at 1 to 10 m."""
    intrinsics = rig.cameras[calibration.camera].to_intrinsics()
    u = np.linspace(0.05, 0.95, 5) * (intrinsics.width_px - 1)
    v = np.linspace(0.05, 0.95, 5) * (intrinsics.height_px - 1)
    rays = intrinsics.unproject(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
    # A lens model may end before the image's corners.
    rays = rays[np.isfinite(rays).all(axis=1)]
    points_camera = (rays[:, None, :] * np.array([1.0, 3.0, 10.0])[:, None]).reshape(-1, 3)
    return transform(invert(calibration.T_cam_lidar), points_camera)


READERS: dict[tuple[str, str], Callable[[Case], Array]] = {
    ("extrinsics", "PyYAML, scipy"): _extrinsics,
    ("urdf", "yourdfpy"): _urdf,
    ("camera_info", "PyYAML, OpenCV"): _camera_info,
    ("static_tf", "shlex, scipy"): _static_tf,
    ("ros2_launch", "Python, stand-ins for `launch`"): _ros2_launch,
    ("tf_static_bag", "rosbags"): _tf_static_rosbags,
    ("kalibr", "PyYAML, OpenCV"): _kalibr,
    ("autoware", "PyYAML, scipy"): _autoware,
    ("fast_livo2", "PyYAML, OpenCV"): _fast_livo2,
    ("koide3", "json, OpenCV"): _koide3,
    ("opencv", "cv::FileStorage"): _opencv,
    ("mcap", "mcap, mcap-ros2-support"): _mcap,
    ("ply", "Open3D"): _ply,
}
"""By format and what reads it."""
FITTED = {"kalibr": "radtan4", "fast_livo2": "radtan4", "koide3": "radtan5"}
"""Formats with fewer radtan coefficients than the profile may have."""
MODELS = {"radtan": "k1 k2 p1 p2 k3", "fisheye": "equidistant", "rational": "k1 to k6"}
"""Kinds of lens, and their coefficients."""


def session_image(rig, camera):
    """Draw an image in which each pixel's blue, green and red are its column, its row (mod 256) and 7."""
    width, height = rig.cameras[camera].resolution_px
    image = np.full((height, width, 3), 7, np.uint8)
    image[..., 0] = np.arange(width)[None, :] % 256
    image[..., 1] = np.arange(height)[:, None] % 256
    return image


def outputs_case(rig_name, folder, *, model="radtan", seed=0):
    """Export all formats of a random result."""
    rig = load_rig(rig_name)
    (camera,), (lidar,) = rig.cameras, rig.lidars
    mount = Mount(parent="base_link", of=rig.lidars[lidar].frame, xyz_m=(0.2, -0.1, 0.9), rpy_deg=(1, 2, 30))
    settings = rig.cameras[camera]
    given = {
        "radtan": settings.intrinsics,
        "fisheye": settings.intrinsics.model_copy(
            update={"model": "equidistant", "distortion": (-0.02, 0.01, -0.005, 0.001)}
        ),
        "rational": settings.intrinsics.model_copy(
            update={"distortion": (-0.3, 0.1, 1e-3, -2e-5, 0.01, 0.02, -0.01, 0.003)}
        ),
    }[model]
    cameras = {camera: settings.model_copy(update={"intrinsics": given})}
    rig = rig.model_copy(update={"mount": mount, "cameras": cameras})
    rng = np.random.default_rng(seed)
    T_cam_lidar = pose(
        exp_so3(np.array([1.2, -1.2, 1.2]) + 0.1 * rng.normal(size=3)), 0.1 * rng.normal(size=3)
    )
    calibration = made_calibration(
        T_cam_lidar,
        1e-6 * np.eye(6),
        camera=camera,
        channels=(next(iter(settings.channels)),),
        lidar=lidar,
        metrics=Metrics(0.01, 0.01, 0.2),
        n_captures=1,
        n_detected=1,
    )
    intrinsics = cameras[camera].to_intrinsics()
    lens = "fisheye" if model == "fisheye" else model, intrinsics.matrix, np.array(intrinsics.distortion)
    points = probe_points(calibration, rig)[::3].astype(np.float32)  # 1 m away each: none hides another
    with Session.create(folder / "session", rig) as session:
        channel = next(iter(settings.channels))
        zeros = np.zeros(len(points), np.float32)
        scan = Scan(lidar, 10**18, points, zeros, (np.arange(len(points)) % 16).astype(np.int16), None)
        image = Image(camera, channel, 10**18 + 5, session_image(rig, camera))
        session.add_capture([image], [scan], {})
        write_exports([calibration], rig, folder / "out", formats=EXPORTS, session=session)
    return Case(folder / "out", rig, calibration, points.astype(np.float64), lens)


def off_px(case, name, reader):
    """Measure by how much the points that a reader draws miss those of the result, px, at most.

    A format with fewer coefficients holds the model that was fitted, and said to be so.
    """
    given = case.rig.cameras[case.camera].to_intrinsics()
    intrinsics = fit_lens(given, FITTED[name])[0] if name in FITTED else given
    wanted, is_seen = intrinsics.project(transform(case.calibration.T_cam_lidar, case.points_lidar))
    return float(np.abs(reader(case) - wanted)[is_seen].max())
