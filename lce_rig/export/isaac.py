"""isaac_calibration.urdf, as Isaac ROS and Isaac Perceptor read it from /etc/nova/calibration.

References:
    https://nvidia-isaac-ros.github.io/robots/isaac_urdf_requirements (base_link; body and optical frames)
"""

from pathlib import Path

from lce_rig.export.findings import NO_FRAME
from lce_rig.export.job import ExportJob
from lce_rig.export.urdf import write_urdf

FILE_NAME = "isaac_calibration.urdf"
_BASE = "base_link"


def export_isaac(job: ExportJob) -> list[Path]:
    """Write the tree below base_link and check it by reading it back; without one nothing is written.

    Raises:
        LceRigError: the file is not a tree or reads back differently.
    """
    paths = []
    for tree in job.trees:
        if tree.root == _BASE:
            paths.append(write_urdf(job.folder / FILE_NAME, tree, job))
        else:
            job.findings.append(
                NO_FRAME(tree.root, format="isaac", file=FILE_NAME, frame=_BASE, root=tree.root)
            )
    return paths
