"""One line of the doctor's: what was looked at, and what was found."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from lce_rig.core.findings import Figure, Finding, Severity, worst
from lce_rig.devices.protocol import SourceStatus

Topic = Literal["device", "stream", "clock", "buffer"]

# To which line a driver's problem belongs, by the family of its code.
_TOPICS: Mapping[str, Topic] = {
    "device": "device",
    "stream": "stream",
    "packet": "stream",
    "clock": "clock",
    "buffer": "buffer",
}


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Attributes:
        subject: "computer", a sensor's name in the profile, or "rig" for what concerns several.
        name: what was looked at, in a word.
        findings: what was found; how it is first, as a note, then what is wrong: a warning where collecting
            works, less well, an error where it does not or its data are wrong.
    """

    subject: str
    name: str
    findings: tuple[Finding, ...]

    @staticmethod
    def of(subject: str, name: str, *findings: Finding | None) -> "Check":
        """Make a line of what was found; findings without a subject get the line's."""
        found = (each for each in findings if each is not None)
        named = tuple(each if each.subject else replace(each, subject=subject) for each in found)
        return Check(subject, name, named)

    @property
    def severity(self) -> Severity:
        """The worst of the findings."""
        return worst(self.findings)

    @property
    def figures(self) -> dict[str, Figure]:
        """The figures of all findings together."""
        return {name: figure for each in self.findings for name, figure in each.figures.items()}


def problems_of(status: SourceStatus, topic: Topic) -> list[Finding]:
    """Give a driver's problems of one topic."""
    return [problem for problem in status.problems if _TOPICS[problem.family] == topic]
