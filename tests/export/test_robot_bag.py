"""Static transforms of recordings, written by rosbags, and the results fitted into them."""

from collections.abc import Callable

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from lce_rig.core.calibration import Calibration
from lce_rig.core.errors import LceRigError, SessionError, SourceError
from lce_rig.core.geometry import T_BODY_OPTICAL, Array, pose
from lce_rig.export import write_exports
from lce_rig.export.robot_tree import build_trees, fit_tree
from lce_rig.export.urdf import read_robot, read_robot_bag
from lce_rig.rig.profile import Mount

Make = Callable[..., Calibration]
Transform = tuple[str, str, Array]


def write_bag(path, batches, topic="/tf_static"):
    """Write messages of transforms: ROS 1 for .bag, ROS 2 sqlite3 for a name with db3, else mcap."""
    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.ROS2_HUMBLE)
    kind = "tf2_msgs/msg/TFMessage"
    if is_ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", kind))
    plugin = StoragePlugin.SQLITE3 if "db3" in path.name else StoragePlugin.MCAP
    writer = Ros1Writer(path) if is_ros1 else Ros2Writer(path, version=9, storage_plugin=plugin)
    with writer:
        connection = writer.add_connection(topic, kind, typestore=store)
        for time_ns, batch in enumerate(batches):
            message = store.types[kind](transforms=[stamped(store, each, is_ros1) for each in batch])
            serialize = store.serialize_ros1 if is_ros1 else store.serialize_cdr
            writer.write(connection, time_ns, serialize(message, kind))
    return path


def stamped(store, transform, is_ros1):
    parent, child, T = transform
    types = store.types
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    header = types["std_msgs/msg/Header"](
        **({"seq": 0} if is_ros1 else {}),
        stamp=types["builtin_interfaces/msg/Time"](sec=0, nanosec=0),
        frame_id=f"/{parent}" if is_ros1 else parent,
    )
    return types["geometry_msgs/msg/TransformStamped"](
        header=header,
        child_frame_id=child,
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](*map(float, T[:3, 3])),
            rotation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        ),
    )


def placed(x, yaw_deg=0.0):
    return pose(Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix(), np.array([x, 0.1, 0.2]))


ROBOT = [
    ("base_link", "mast", placed(0.5)),
    ("mast", "velodyne", placed(0.0, 90)),
    ("base_link", "davis_link", placed(9.0)),
    ("davis_link", "davis_optical_frame", T_BODY_OPTICAL),
    ("odom_wheel", "wheel", placed(1.0)),
]


@pytest.mark.parametrize("name", ["robot.bag", "robot_db3", "robot_mcap"])
def test_robot_bag_of_any_kind_fits_outputs(rles, make, tmp_path, name):
    # The camera comes in a second message, as from a second publisher, and an old one is published anew.
    path = write_bag(tmp_path / name, [[("base_link", "mast", placed(7.0)), *ROBOT[1:2]], ROBOT])
    robot = read_robot(path)
    assert robot.frames == {frame for parent, child, _ in ROBOT for frame in (parent, child)}
    np.testing.assert_allclose(robot.find_pose("base_link", "mast"), placed(0.5), atol=1e-12)
    (tree,) = build_trees([make()], rles, robot)
    assert tree.root == "base_link"
    joints = tree.above
    # The camera is nearer to the root and stays; the LiDAR keeps its parent.
    assert {child: (j.parent, j.is_given) for child, j in joints.items()} == {
        "davis_link": ("base_link", True),
        "davis_optical_frame": ("davis_link", True),
        "mast": ("base_link", True),
        "velodyne": ("mast", False),
    }
    T_base_lidar = placed(9.0) @ T_BODY_OPTICAL @ make().T_cam_lidar
    np.testing.assert_allclose(
        joints["velodyne"].T_parent_child, np.linalg.inv(placed(0.5)) @ T_base_lidar, atol=1e-9
    )
    write_exports([make()], rles, tmp_path / "out", formats=["static_tf", "urdf"], robot=robot)
    lines = (tmp_path / "out" / "static_transforms.txt").read_text().splitlines()
    published = [line.split()[-4:] for line in lines if line.startswith("ros2 run")]
    assert published == [["--frame-id", "mast", "--child-frame-id", "velodyne"]]


def test_robot_bag_lacking_optical_gets_one(rles, make, tmp_path):
    """Its axes are those of REP 103."""
    robot = read_robot_bag(write_bag(tmp_path / "robot_mcap", [ROBOT[:3]]))
    tree, changes, _ = fit_tree(robot, [make()], rles)
    assert [change.joint.child for change in changes] == ["velodyne", "davis_optical_frame"]
    np.testing.assert_allclose(
        tree.find_pose("davis_link", "davis_optical_frame"), T_BODY_OPTICAL, atol=1e-12
    )


def test_robot_bag_tree_starts_below_joint(rles, make, tmp_path):
    """The head's pose on the base is on /tf; static are only the transforms in the head."""
    head = [("head", child, T) for _, child, T in (ROBOT[0], ROBOT[2])]
    robot = read_robot_bag(write_bag(tmp_path / "robot_mcap", [[*head, *ROBOT[1:2], *ROBOT[3:]]]))
    (tree,) = build_trees([make()], rles, robot)
    assert tree.root == "head" and "wheel" not in tree.frames


@pytest.mark.parametrize(
    "batches",
    [
        pytest.param([ROBOT, [("base_link", "velodyne", placed(0.3))]], id="two parents"),
        pytest.param([[*ROBOT, ("velodyne", "base_link", placed(0.3))]], id="a loop"),
        pytest.param([[*ROBOT[:1], ("mast", "velodyne", placed(np.nan))]], id="not rigid"),
        pytest.param([ROBOT[:1]], id="none of the sensors"),
        pytest.param(
            [[*ROBOT[:3], ("base_link", "davis_optical_frame", T_BODY_OPTICAL)]], id="optical elsewhere"
        ),
    ],
)
def test_robot_bag_unfit_tree_is_refused(rles, make, tmp_path, batches):
    path = write_bag(tmp_path / "robot_mcap", batches)
    with pytest.raises(SessionError) as error:
        build_trees([make()], rles, read_robot_bag(path))
    assert str(path) in error.value.what


def test_a_recording_without_static_transforms_is_refused(tmp_path):
    with pytest.raises(SourceError):
        read_robot(write_bag(tmp_path / "robot_mcap", [ROBOT], topic="/tf"))


def test_the_mount_adds_a_sensor_and_never_a_second_parent(rles, make, tmp_path):
    robot = read_robot_bag(write_bag(tmp_path / "robot_mcap", [ROBOT[:1]]))
    mount = Mount(parent="mast", of="velodyne", xyz_m=(0.0, 0.0, 0.4))
    (tree,) = build_trees([make()], rles.model_copy(update={"mount": mount}), robot)
    assert (tree.above["velodyne"].parent, tree.above["velodyne"].is_given) == ("mast", False)
    other = rles.model_copy(update={"mount": mount.model_copy(update={"parent": "roof"})})
    with pytest.raises(SessionError):
        build_trees([make()], other, robot)
    whole = read_robot_bag(write_bag(tmp_path / "whole_mcap", [ROBOT]))
    elsewhere = rles.model_copy(update={"mount": mount.model_copy(update={"parent": "base_link"})})
    with pytest.raises(LceRigError):
        build_trees([make()], elsewhere, whole)


def test_autoware_kit_keeps_robot_frames(rles, make, tmp_path):
    import yaml

    housing = placed(0.0) * [[1, 1, 1, 0], [1, 1, 1, 0], [1, 1, 1, 1], [1, 1, 1, 1]]  # 0.2 m above its base
    robot = [
        ("base_link", "sensor_kit_base_link", placed(0.9)),
        ("sensor_kit_base_link", "top_base_link", placed(0.1)),
        ("top_base_link", "velodyne", housing),
        ("sensor_kit_base_link", "davis_link", placed(0.3)),
    ]
    read = read_robot_bag(write_bag(tmp_path / "robot_mcap", [robot]))
    paths = write_exports([make()], rles, tmp_path / "out", formats=["autoware"], robot=read)
    kit, base = (yaml.safe_load(path.read_text(encoding="utf-8")) for path in paths)

    def read_pose(block):
        R = Rotation.from_euler("xyz", [block["roll"], block["pitch"], block["yaw"]]).as_matrix()
        return pose(R, np.array([block["x"], block["y"], block["z"]]))

    np.testing.assert_allclose(read_pose(base["base_link"]["sensor_kit_base_link"]), placed(0.9), atol=1e-12)
    poses = {name: read_pose(block) for name, block in kit["sensor_kit_base_link"].items()}
    assert set(poses) == {"top_base_link", "davis_link"}
    T_cam_lidar = np.linalg.inv(poses["davis_link"] @ T_BODY_OPTICAL) @ poses["top_base_link"] @ housing
    np.testing.assert_allclose(T_cam_lidar, make().T_cam_lidar, atol=1e-9)
