"""Recordings by others, in the folder that LCE_RIG_DATA names, as sessions."""

import csv
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import lce_rig as lce
from lce_rig.core.geometry import Array, exp_so3, invert, pose
from lce_rig.detect.detection import Detections
from lce_rig.rig import Rig

RIGS = Path(__file__).resolve().parents[2] / "tests" / "rigs"


@dataclass(frozen=True)
class RecordedSet:
    """Folders of recordings, their profiles, and the channels of their images."""

    name: str
    rig: str
    folders: tuple[tuple[str, str], ...]

    @property
    def is_there(self) -> bool:
        """Whether all of its folders are there."""
        return all((recordings() / folder).is_dir() for folder, _ in self.folders)

    def collect(self, session: Path) -> None:
        """Build a session with the commands a user would type."""
        for folder, channel in self.folders:
            # Some profiles come with their recording.
            rig = recordings() / self.rig if (recordings() / self.rig).is_file() else self.rig
            words = ["collect", "--rig", rig, "--channel", channel, "--from", recordings() / folder]
            command = [sys.executable, "-m", "lce_rig", *map(str, words), str(session)]
            subprocess.run(command, check=True, stderr=subprocess.DEVNULL)

    def reference(self) -> Array | None:
        """Read the reference extrinsic that comes with it, if one does."""
        from lce_rig.export.extrinsics import read_reference

        folder = recordings() / self.folders[0][0]
        if (folder / "reference.json").exists():
            return read_reference(folder / "reference.json").of("", "")
        if not (folder / "reference_50_runs.csv").exists():
            return None
        # 50 runs of another tool, LiDAR <- camera: roll, pitch, yaw about fixed axes and a translation.
        with (folder / "reference_50_runs.csv").open() as file:
            runs = np.array([[float(cell) for cell in row] for row in list(csv.reader(file))[1:]])
        roll, pitch, yaw, *t = np.median(runs, axis=0)
        x, y, z = np.eye(3)
        return invert(pose(exp_so3(yaw * z) @ exp_so3(pitch * y) @ exp_so3(roll * x), np.array(t)))


SETS = (
    RecordedSet("rlfs01", "rlfs", (("rlfs01", "frames"),)),
    RecordedSet("rlfs02", "rlfs", (("rlfs02", "frames"),)),
    RecordedSet("rlfs03", "rlfs", (("rlfs03", "frames"),)),
    RecordedSet("sss_noise15mm", "sss", (("sss_noise15mm", "frames"),)),
    RecordedSet("rles01", "rles", (("rles01_lf", "frames"), ("rles01_le", "events"))),
    RecordedSet("rles02", str(RIGS / "rles02.yaml"), (("rles02_lf", "frames"), ("rles02_le", "events"))),
    RecordedSet("rles03", str(RIGS / "rles02.yaml"), (("rles03_lf", "frames"), ("rles03_le", "events"))),
    RecordedSet("acfr_vlp16", str(RIGS / "acfr.yaml"), (("acfr_vlp16", "frames"),)),
    RecordedSet("os1_64", str(RIGS / "os1_64.yaml"), (("os1_64", "frames"),)),
    RecordedSet("vlp32c_left", "vlp32c_stereo/left.yaml", (("vlp32c_stereo/left", "frames"),)),
    RecordedSet("vlp32c_right", "vlp32c_stereo/right.yaml", (("vlp32c_stereo/right", "frames"),)),
    RecordedSet("vlp16_tilted", "vlp16_tilted/rig.yaml", (("vlp16_tilted", "frames"),)),
    RecordedSet("os1_gen1", "os1_gen1/rig.yaml", (("os1_gen1", "frames"),)),
    RecordedSet("livox_avia", str(RIGS / "livox_avia.yaml"), (("livox_avia", "frames"),)),
)


def recordings() -> Path:
    """Find the recordings by others."""
    folder = os.environ.get("LCE_RIG_DATA")
    if not folder or not Path(folder).is_dir():
        sys.exit("LCE_RIG_DATA names no folder of recordings")
    return Path(folder)


def detect(path: Path) -> tuple[Rig, Detections]:
    """Detect the boards of a session."""
    from lce_rig.session import Session

    session = Session.open(path)
    return session.rig, lce.detect_boards(session)
