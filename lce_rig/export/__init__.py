"""Write results as files for other programs."""

import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from pkgutil import resolve_name
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from lce_rig.core.calibration import MADE_BY, Calibration
from lce_rig.core.errors import ResultRefusedError, SessionError, UsageError, reading
from lce_rig.core.findings import Finding, Kind
from lce_rig.export.robot_tree import RobotTree, build_trees, require_known
from lce_rig.export.writing import yaml_text
from lce_rig.rig import Rig
from lce_rig.session import Session
from lce_rig.session.durable import write_atomically

LENS_FITTED = Kind(
    "export.lens_fitted",
    "{format} has {n_coefficients} distortion coefficients: those of camera {subject} are fitted, "
    "{rms_px:.3f} px rms, {max_px:.3f} px at most over the image",
    severity="note",
)
NO_FRAME = Kind(
    "export.no_frame",
    "{format}: {file} is not written: it needs the frame {frame} (profile: mount), and the root is {root}",
    "`lce-rig export {session} --formats {format} --tree URDF -o FOLDER`",
    severity="note",
)
NO_SESSION = Kind(
    "export.no_session",
    "{format} is not written: it needs the images and scans of a session",
    "export from the session",
    severity="warning",
)
NO_IMAGES = Kind(
    "export.no_images",
    "{format}: camera {subject} is skipped: the session has no images of it",
    severity="warning",
)


@dataclass(frozen=True, eq=False)
class ExportJob:
    """The source of an output.

    Attributes:
        calibrations: one for each camera and LiDAR.
        rig: the profile the calibrations belong to.
        folder: folder for the files.
        robot: the robot's own tree of frames; None if outputs hang from the profile's `mount` or root.
        session: source of images and scans; None if only results are available.
        findings: content that the outputs omit or change, and why; grows.
    """

    calibrations: Sequence[Calibration]
    rig: Rig
    folder: Path
    robot: RobotTree | None = None
    session: Session | None = None
    findings: list[Finding] = field(default_factory=list)

    @property
    def of_cameras(self) -> list[Calibration]:
        """The calibrations of a camera and a LiDAR."""
        return [c for c in self.calibrations if not c.is_of_peers]

    @property
    def by_camera(self) -> dict[str, Calibration]:
        """A calibration of each camera, preferably one with a LiDAR."""
        found = {c.camera: c for c in self.of_cameras}
        for c in self.calibrations:
            for name in (c.camera, c.lidar) if c.is_of_cameras else ():
                found.setdefault(name, c)
        return found

    @cached_property
    def trees(self) -> list[RobotTree]:
        """Frame trees in which outputs place the sensors."""
        return build_trees(self.calibrations, self.rig, self.robot)

    def name_of(self, calibration: Calibration) -> str:
        """Build a file name from the camera, and from the LiDAR in a rig with several."""
        both = f"{calibration.camera}_{calibration.lidar}"
        return both if len(self.rig.lidars) > 1 else calibration.camera

    def image_topic(self, calibration: Calibration) -> str:
        """Return the topic of a calibration's images."""
        camera = self.rig.cameras[calibration.camera]
        return camera.channels[calibration.channels[0]].topic or f"/{calibration.camera}"

    def points_topic(self, calibration: Calibration) -> str:
        """Return the topic of a calibration's point clouds."""
        return self.rig.lidars[calibration.lidar].topic or f"/{calibration.lidar}/points"

    def head(self, content: str, *calibrations: Calibration, of_one_camera: bool = False) -> list[str]:
        """Return the header lines of a file: content, program, whether to use it.

        Args:
            content: content of the file.
            calibrations: calibrations in the file.
            of_one_camera: whether the file is for one camera; else the head names cameras that it lacks.
        """
        lines = [f"{content} of rig {self.rig.name}, written by {MADE_BY}"]
        for calibration in calibrations:
            sensor = "/".join(filter(None, (calibration.camera, calibration.channel)))
            pair = f"{sensor} and {calibration.lidar}"
            deg, mm = calibration.sigma_rotation_deg, 1e3 * calibration.sigma_translation_m
            lines.append(f"{pair}: {calibration.verdict}, standard deviation {deg:.3f} deg, {mm:.2f} mm")
            if calibration.verdict == "fail":
                reasons = "; ".join(finding.sentence for finding in calibration.findings)
                reasons = " ".join(reasons.split()) or "no reason given"
                lines.append(f"NOT FOR USE: the calibration of {pair} failed: {reasons}")
        present = {name for calibration in calibrations for name in (calibration.camera, calibration.lidar)}
        absent = [camera for camera in self.rig.cameras if camera not in present]
        if absent and not of_one_camera:
            lines.append(f"not in this file, without a usable result: {', '.join(absent)}")
        return lines

    def write(self, name: str, lines: Sequence[str]) -> Path:
        """Write a text file into the folder atomically.

        Raises:
            SessionError: a full disk, no permission.
        """
        path = self.folder / name
        write_atomically(path, "\n".join(lines) + "\n")
        return path

    def write_yaml(self, name: str, head: Sequence[str], document: Mapping[str, Any]) -> Path:
        """Write a document as YAML into the folder, after `head` as comments; see `write`."""
        path = self.folder / name
        write_atomically(path, yaml_text(head, document))
        return path


Exporter = Callable[[ExportJob], list[Path]]


# Format -> module of this package and function, imported when used; its docstring names the files.
EXPORTS = {
    "extrinsics": "extrinsics:export_extrinsics",
    "urdf": "urdf:export_urdf",
    "camera_info": "ros_files:export_camera_info",
    "static_tf": "ros_files:export_static_tf",
    "ros2_launch": "ros_files:export_ros2_launch",
    "tf_static_bag": "ros_bag:export_tf_static_bag",
    "kalibr": "other_tools:export_kalibr",
    "autoware": "other_tools:export_autoware",
    "fast_livo2": "other_tools:export_fast_livo2",
    "koide3": "other_tools:export_koide3",
    "opencv": "other_tools:export_opencv",
    "mcap": "ros_bag:export_mcap",
    "ply": "coloured_cloud:export_ply",
}
USUAL = ("extrinsics", "urdf", "camera_info", "static_tf")
"""What is written unless others are named."""


def load_exporter(name: str) -> Exporter:
    """Import the function of a format, from `ExportJob` to the files written.

    Raises:
        UsageError: no such format.
    """
    if name not in EXPORTS:
        raise UsageError(f"no export format is called {name}", f"Choose one of: {', '.join(EXPORTS)}")
    exporter: Exporter = resolve_name(f"lce_rig.export.{EXPORTS[name]}")
    return exporter


def usual_formats(rig: Rig) -> tuple[str, ...]:
    """List the formats written by default: the profile's `exports`, else the standard ones."""
    return tuple(rig.exports) or USUAL


def write_exports(
    calibrations: Sequence[Calibration],
    rig: Rig,
    folder: Path | str,
    *,
    formats: Iterable[str] | None = None,
    is_forced: bool = False,
    session: Session | None = None,
    robot: RobotTree | None = None,
    findings: list[Finding] | None = None,
) -> list[Path]:
    """Write formats into a folder in one step; files of an earlier run are removed when all are written.

    Args:
        calibrations: one for each camera and LiDAR.
        rig: the profile the calibrations belong to.
        folder: usually the session's `calibration/`.
        formats: keys of EXPORTS; by default the profile's `exports`, else the usual ones.
        is_forced: write failed calibrations too; every file is then marked as failed.
        session: source of images and scans, for formats that contain them.
        robot: the robot's own tree of frames, into which the outputs are to fit.
        findings: receives those about omitted or changed content.

    Returns:
        The files in the order of the formats; those of a bag lie in a folder of their own.

    Raises:
        LceRigError: a calibration names sensors that the rig does not have.
        SessionError: the sensors do not fit into the robot's tree.
        ResultRefusedError: a verdict is "fail", or a pose is not finite; nothing is written or removed.
    """
    folder = Path(folder)
    for calibration in calibrations:
        require_known(calibration, rig)
        if not (np.isfinite(calibration.T_cam_lidar).all() and np.isfinite(calibration.cov).all()):
            raise ResultRefusedError(
                f"the pose of {calibration.camera} and {calibration.lidar} is not finite"
            )
    exporters = [load_exporter(name) for name in (usual_formats(rig) if formats is None else formats)]
    require_usable(calibrations, is_forced=is_forced)
    told = [] if findings is None else findings
    try:
        folder.mkdir(parents=True, exist_ok=True)
        holder = TemporaryDirectory(dir=folder, prefix=".draft-")
    except OSError as error:
        raise SessionError(f"{folder}: cannot be written: {error.strerror}") from error
    with holder as name:
        draft = Path(name)
        job = ExportJob(calibrations, rig.with_lenses(calibrations), draft, robot, session, told)
        paths = [path for exporter in exporters for path in exporter(job)]
        remove_exports(folder)
        for path in sorted(draft.iterdir()):
            try:
                path.replace(folder / path.name)
            except OSError as error:
                raise SessionError(
                    f"{folder / path.name}: cannot be replaced: {error.strerror}",
                    "Remove it, or choose another folder.",
                ) from error
    return [folder / path.relative_to(draft) for path in paths]


def require_usable(calibrations: Sequence[Calibration], *, is_forced: bool = False) -> None:
    """Check that no calibration failed, unless forced.

    Raises:
        ResultRefusedError: a verdict is "fail".
    """
    failed = [c for c in calibrations if c.verdict == "fail"]
    if failed and not is_forced:
        pairs = ", ".join(f"{c.camera}/{c.channel} and {c.lidar}" for c in failed)
        reasons = "; ".join(finding.sentence for c in failed for finding in c.findings)
        raise ResultRefusedError(f"not exported: the calibration of {pairs} failed", reasons)


def remove_exports(folder: Path) -> None:
    """Remove exports of earlier runs from a folder, recognised by their first lines.

    Raises:
        SessionError: a file cannot be removed.
    """
    for path in sorted(folder.glob("*")):
        if is_export(path):
            try:
                (shutil.rmtree if path.is_dir() else Path.unlink)(path)
            except OSError as error:
                raise SessionError(
                    f"{path}: an earlier export cannot be removed: {error.strerror}"
                ) from error


_SUFFIXES = (".yaml", ".urdf", ".txt", ".json", ".py", ".ply")
_SIGN = b", written by lce-rig "
_MOST_METADATA_BYTES = 1 << 20


def is_export(path: Path) -> bool:
    """Check whether lce-rig wrote a file, by its first lines, or a bag, by its metadata.

    Raises:
        SessionError: the file cannot be read.
    """
    if path.is_symlink():
        return False
    if path.is_dir():
        metadata = path / "metadata.yaml"
        return metadata.is_file() and _SIGN in _begin(metadata, _MOST_METADATA_BYTES)
    return path.suffix in _SUFFIXES and path.is_file() and _SIGN in _begin(path, 300)


def _begin(path: Path, n_bytes: int) -> bytes:
    with reading(path, SessionError), path.open("rb") as file:
        return b" ".join(file.read(n_bytes).split())  # YAML breaks long lines
