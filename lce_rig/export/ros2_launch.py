"""RIG.launch.py: a ROS 2 launch file that publishes the calibration."""

import ast
from pathlib import Path
from typing import Any

from lce_rig.core.errors import LceRigError
from lce_rig.export.files import header, reads_back
from lce_rig.export.frames import Joint
from lce_rig.export.job import ExportJob
from lce_rig.export.robot_tree import RobotJoint
from lce_rig.export.static_tf import check_published, publisher_options, read_options
from lce_rig.session.durable import write_atomically

_PACKAGE, _EXECUTABLE = "tf2_ros", "static_transform_publisher"


def export_ros2_launch(job: ExportJob) -> list[Path]:
    """Write RIG.launch.py, one static_transform_publisher a joint, and check it by reading it back.

    Transforms that the robot's own tree has like this are left to the robot.

    Raises:
        LceRigError: the file reads back differently.
    """
    lines = [f"# {line}" for line in header("ROS 2 launch file", job.rig, job.chosen)]
    lines += [
        "from launch import LaunchDescription",
        "from launch_ros.actions import Node",
        "",
        "",
        "def generate_launch_description():",
        "    return LaunchDescription(",
        "        [",
        *(line for tree in job.trees for joint in tree.joints if not joint.is_given for line in _node(joint)),
        "        ]",
        "    )",
    ]
    path = job.folder / f"{job.rig.name}.launch.py"
    write_atomically(path, "\n".join(lines) + "\n")
    _check(path, job)
    return [path]


def _node(joint: Joint) -> list[str]:
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in f"{joint.parent}_to_{joint.child}")
    words = publisher_options(joint)
    pairs = [f"                    {a!r}, {b!r}," for a, b in zip(words[::2], words[1::2], strict=True)]
    return [
        "            Node(",
        f"                package={_PACKAGE!r},",
        f"                executable={_EXECUTABLE!r},",
        f"                name={name!r},",
        "                arguments=[",
        *pairs,
        "                ],",
        "            ),",
    ]


@reads_back
def read_ros2_launch(path: Path) -> list[tuple[str, RobotJoint]]:
    """Read frames and the joints above them from the nodes of a launch file, which is parsed and not run.

    Raises:
        LceRigError: it does not parse, or has another node.
    """
    try:
        tree = ast.parse(path.read_text(encoding="utf-8"))
    except SyntaxError as error:
        raise LceRigError(f"{path}: not Python: {error}") from error
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    found = []
    for call in calls:
        if isinstance(call.func, ast.Name) and call.func.id == "Node":
            given: dict[str, Any] = {str(each.arg): ast.literal_eval(each.value) for each in call.keywords}
            if (given["package"], given["executable"]) != (_PACKAGE, _EXECUTABLE):
                raise LceRigError(f"{path}: starts {given['executable']}")
            found.append(read_options(given["arguments"]))
    return found


@reads_back
def _check(path: Path, job: ExportJob) -> None:
    check_published(path, "", read_ros2_launch(path), job)
