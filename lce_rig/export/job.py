"""The source of an output: calibrations, their rig and its frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.findings import Finding
from lce_rig.export.robot_tree import FrameTree, RobotTree, build_trees, choose_channels
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.session.durable import write_atomically


@dataclass(frozen=True, eq=False)
class ExportJob:
    """The source of an output.

    Attributes:
        calibrations: one for each camera channel and LiDAR.
        rig: the profile the calibrations belong to.
        folder: for the files.
        robot: its own tree of frames; None where outputs hang from the profile's `mount` or root.
        session: with the images and scans; None where only results are at hand.
        findings: content that was left out of the outputs or put into another form, and why; grows.
    """

    calibrations: Sequence[Calibration]
    rig: Rig
    folder: Path
    robot: RobotTree | None = None
    session: Session | None = None
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

    def image_topic(self, calibration: Calibration) -> str:
        """Name the topic of a calibration's images."""
        camera = self.rig.cameras[calibration.camera]
        return camera.channels[calibration.channels[0]].topic or f"/{calibration.camera}"

    def head(self, content: str, *calibrations: Calibration, of_one_camera: bool = False) -> list[str]:
        """List the lines at the head of a file: content, program, whether to use it.

        Args:
            content: of the file.
            calibrations: those in the file.
            of_one_camera: whether the file is for one camera; else the head names cameras that it lacks.
        """
        lines = [f"{content} of rig {self.rig.name}, written by {MADE_BY}"]
        for calibration in calibrations:
            pair = f"{calibration.camera}/{calibration.channel} and {calibration.lidar}"
            deg, mm = calibration.sigma_rotation_deg, 1e3 * calibration.sigma_translation_m
            lines.append(f"{pair}: {calibration.verdict}, standard deviation {deg:.3f} deg, {mm:.2f} mm")
            if calibration.verdict == "fail":
                reasons = "; ".join(finding.sentence for finding in calibration.findings)
                reasons = " ".join(reasons.split()) or "no reason given"
                lines.append(f"NOT FOR USE: the calibration of {pair} failed: {reasons}")
        present = {calibration.camera for calibration in calibrations}
        absent = [camera for camera in self.rig.cameras if camera not in present]
        if absent and not of_one_camera:
            lines.append(f"not in this file, without a usable result: {', '.join(absent)}")
        return lines

    def write(self, name: str, lines: Sequence[str]) -> Path:
        """Write a text file into the folder; it is there whole or not at all.

        Raises:
            SessionError: a full disk, no permission.
        """
        path = self.folder / name
        write_atomically(path, "\n".join(lines) + "\n")
        return path
