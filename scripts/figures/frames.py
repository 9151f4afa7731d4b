"""The frames of an exported URDF, as RViz draws them."""

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from lce_rig.core.geometry import Array
from lce_rig.export.urdf import read_robot_urdf

_COLOURS = ("#e5484d", "#2b9a3e", "#2f6fdb")
_CAMERA_FRAMES = ("camera_link", "camera_optical_frame")
_LENGTH_M = 0.1


def draw_frames(urdf: Path) -> Any:
    """Draw both frames of the camera of rig rlfs, each with the LiDAR's, from behind and above."""
    tree = read_robot_urdf(urdf)
    figure = plt.figure(figsize=(9.6, 4.4))
    (root,) = tree.frames - tree.above.keys()
    for column, name in enumerate(_CAMERA_FRAMES):
        axes: Any = figure.add_subplot(1, 2, 1 + column, projection="3d")
        _draw_axes(axes, tree.find_pose(root, "velodyne"), 1.4)
        _draw_axes(axes, tree.find_pose(root, name), 4)
        axes.set_title(f"thin: velodyne\nthick: {name}", fontsize=14)
        axes.set(xlim=(-0.05, 0.15), ylim=(-0.05, 0.2), zlim=(-0.17, 0.15))
        axes.set_box_aspect((0.2, 0.25, 0.32), zoom=1.4)
        axes.view_init(elev=20, azim=-120)
        axes.set_axis_off()
    figure.subplots_adjust(0, 0, 1, 0.92, wspace=0)
    return figure


def _draw_axes(axes: Any, T_root_frame: Array, width: float) -> None:
    start = T_root_frame[:3, 3]
    for colour, axis, direction in zip(_COLOURS, "xyz", T_root_frame[:3, :3].T, strict=True):
        axes.plot(*np.stack([start, start + _LENGTH_M * direction], axis=1), color=colour, lw=width)
        at = start + (_LENGTH_M + 0.014) * direction
        axes.text(*at, axis, color=colour, fontsize=15 if width > 2 else 11, ha="center", va="center")
