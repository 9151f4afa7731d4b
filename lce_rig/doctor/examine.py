"""Is this computer, with these sensors, fit to collect? Every check in a table, and how they are made."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from lce_rig.core import velodyne
from lce_rig.core.errors import SourceError
from lce_rig.core.findings import Figure, Finding, Severity, worst
from lce_rig.devices import sensors, source_of
from lce_rig.devices.velodyne_web import VelodyneWeb, WebReport
from lce_rig.doctor import checks
from lce_rig.doctor.observing import Examination, observe
from lce_rig.rig import Rig
from lce_rig.rig.sync_settings import BOARD

_WEB_TIMEOUT_S = 1.0

CHECKS: dict[str, dict[str, Callable[[Examination, str], Iterable[Finding]]]] = {
    "computer": {"disk": checks.check_disk, "clock": checks.check_computer_clock},
    "lidar": {
        "device": checks.check_device,
        "settings": checks.check_settings,
        "stream": checks.check_stream,
        "PPS": checks.check_pps,
    },
    "camera": {
        "device": checks.check_device,
        "stream": checks.check_stream,
        "clock": checks.check_clock,
        "pulses": checks.check_frames_of_pulses,
        "edges": checks.check_edges,
    },
    "sync": {
        "device": checks.check_device,
        "pulses": checks.check_pulses_sent,
        "clock": checks.check_clock,
    },
    "rig": {"clocks": checks.check_offsets, "sync": checks.check_sync},
}
"""Every check by its line's name; a line without findings is left out."""


@dataclass(frozen=True)
class Check:
    """One line: one thing looked at.

    Attributes:
        subject: "computer", a sensor's name in the profile, or "rig" for what concerns several.
        name: what was looked at, in a word.
        findings: of the check; those without a subject get the line's.
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


class DoctorOptions(NamedTuple):
    """How to examine: for how long, where sessions are to be written, port of a VLP-16's web server."""

    duration_s: float = 5.0
    folder: Path = Path()
    web_port: int = 80


def examine(rig: Rig, options: DoctorOptions | None = None) -> list[Check]:
    """Look at the computer and every sensor of a rig.

    What is absent or fails is an error; everything else is looked at all the same. Takes the duration, and
    what the sensors take to open.

    Args:
        rig: the profile.
        options: how to examine.

    Returns:
        A line for each thing looked at: the computer's, each sensor's, the rig's.
    """
    options = options or DoctorOptions()
    seen = observe({sensor: partial(source_of, rig, sensor) for sensor in sensors(rig)}, options.duration_s)
    exam = Examination(rig, options.folder, seen)
    web = {
        name: _read_web(rig, name, options.web_port) for name in rig.lidars if exam.driver(name) == "vlp16"
    }
    exam = replace(exam, web=web)
    subjects = [("computer", "computer"), *((name, "lidar") for name in rig.lidars)]
    subjects += [*((name, "camera") for name in rig.cameras), *([(BOARD, "sync")] if rig.sync else [])]
    lines = [
        Check(subject, name, tuple(check(exam, subject)))
        for subject, kind in (*subjects, ("rig", "rig"))
        for name, check in CHECKS[kind].items()
    ]
    return [line for line in lines if line.findings]


def _read_web(rig: Rig, lidar: str, port: int) -> WebReport | SourceError:
    """Ask the web page of a VLP-16; why it says nothing where it does not."""
    address = rig.lidars[lidar].driver.address or velodyne.FACTORY_ADDRESS
    try:
        return VelodyneWeb(address, port, _WEB_TIMEOUT_S).read()
    except SourceError as error:
        return error
