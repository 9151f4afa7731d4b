"""What an output is made from."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from lce_rig.core.calibration import Calibration
from lce_rig.core.findings import Finding
from lce_rig.export.frames import FrameTree, choose_channels
from lce_rig.export.robot_tree import RobotTree, build_trees
from lce_rig.rig import Rig

if TYPE_CHECKING:
    from lce_rig.session import Session


@dataclass(frozen=True, eq=False)
class ExportJob:
    """What an output is made from.

    Attributes:
        calibrations: what to write, one for each camera channel and LiDAR.
        rig: the profile the calibrations belong to.
        folder: for the files.
        robot: its own tree of frames; None where outputs hang from the profile's `mount` or root.
        session: with the images and scans; None where only results are at hand.
        findings: what was left out of the outputs or put into another form, and why; grows.
    """

    calibrations: Sequence[Calibration]
    rig: Rig
    folder: Path
    robot: RobotTree | None = None
    session: "Session | None" = None
    findings: list[Finding] = field(default_factory=list)

    @cached_property
    def chosen(self) -> list[Calibration]:
        """One calibration of each camera and LiDAR."""
        return choose_channels(self.calibrations, self.rig)

    @cached_property
    def trees(self) -> list[FrameTree]:
        """The trees of frames in which outputs place the sensors."""
        return build_trees(self.calibrations, self.rig, self.robot)

    def name_of(self, calibration: Calibration) -> str:
        """Name files of one camera and LiDAR: by the camera, and by the LiDAR too where there are several."""
        both = f"{calibration.camera}_{calibration.lidar}"
        return both if len(self.rig.lidars) > 1 else calibration.camera
