"""The input and output of a check: a rig's observed sensors, and one line of findings."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding, Severity, worst
from lce_rig.devices.opening import driver_type, open_live
from lce_rig.devices.reading import LiveSource
from lce_rig.devices.velodyne_web import WebReport
from lce_rig.doctor.observing import ObservedSensor
from lce_rig.rig import DriverSettings, Rig
from lce_rig.rig.sync_settings import BOARD

# What to add for each driver that needs the address of its sensor.
_LINES = {
    "v4l2": "driver: {type: v4l2, device: /dev/video0}",
    "ros2": "driver: {type: ros2}",
    "command": "driver: {type: command, command: [PROGRAM, ARGUMENT, ...]}",
}


@dataclass(frozen=True)
class Check:
    """One line: one thing looked at.

    Attributes:
        subject: "computer", a sensor's name in the profile, or "rig" for what concerns several.
        name: what was looked at, in a word.
        findings: how it is first, as a note, then what is wrong: a warning where collecting works, less
            well, an error where it does not or its data are wrong. Those without a subject get the line's.
    """

    subject: str
    name: str
    findings: tuple[Finding, ...]

    def __post_init__(self) -> None:
        named = (each if each.subject else replace(each, subject=self.subject) for each in self.findings)
        object.__setattr__(self, "findings", tuple(named))

    @property
    def severity(self) -> Severity:
        """The worst of the findings."""
        return worst(self.findings)

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures of all findings together."""
        return {name: figure for each in self.findings for name, figure in each.figures.items()}


@dataclass(frozen=True, eq=False)
class Examination:
    """Observations of a rig.

    Attributes:
        rig: the profile.
        folder: where sessions are to be written.
        seen: what was observed, by the sensor's name.
        web: what the web page of each VLP-16 says, or why it says nothing, by name.
        boards: the board as each sensor shows it, by (sensor, channel), a LiDAR's channel is "": a note with
            its figures, or why it is not there.
    """

    rig: Rig
    folder: Path = Path()
    seen: Mapping[str, ObservedSensor] = field(default_factory=dict)
    web: Mapping[str, WebReport | SourceError] = field(default_factory=dict)
    boards: Mapping[tuple[str, str], Finding] = field(default_factory=dict)

    def problems(self, sensor: str, *families: str) -> list[Finding]:
        """Return the problems that a sensor's driver names, of some families of codes."""
        status = self.seen[sensor].status
        return [] if status is None else [each for each in status.problems if each.family in families]


def sensors(rig: Rig) -> list[str]:
    """Name the sensors: LiDARs, cameras, then the sync board."""
    return [*rig.lidars, *rig.cameras, *([BOARD] if rig.sync is not None else [])]


def driver_of(rig: Rig, sensor: str) -> str:
    """Name the driver that reads a sensor; "" where none is known."""
    if sensor == BOARD:
        return "sync_board"
    kind, settings = (
        ("lidar", rig.lidars[sensor]) if sensor in rig.lidars else ("camera", rig.cameras[sensor])
    )
    try:
        return driver_type(kind, sensor, settings.model, settings.driver)
    except SourceError:
        return ""


def source_of(rig: Rig, sensor: str) -> LiveSource:
    """Build the source of one sensor; it is not open yet.

    Raises:
        SourceError: its driver is unknown, or the profile does not say where it is; with what to add.
    """
    if sensor in rig.cameras:
        driver, kind = rig.cameras[sensor].driver, driver_of(rig, sensor)
        if (kind == "v4l2" and driver.device is None) or (kind == "command" and not driver.command):
            missing = f"Add to cameras.{sensor}.driver: {_LINES[kind].partition('{')[2].rstrip('}')}"
            if driver == DriverSettings():
                choices = " or ".join((*_LINES.values(), "driver: {type: davis}"))
                missing = f"Add to cameras.{sensor}: {choices}"
            raise SourceError("the profile does not say how it is reached", missing)
    alone = {
        "lidars": {name: lidar for name, lidar in rig.lidars.items() if name == sensor},
        "cameras": {name: camera for name, camera in rig.cameras.items() if name == sensor},
        "sync": rig.sync if sensor == BOARD else None,
    }
    return open_live(rig.model_copy(update=alone))[0]
