"""Facts about a sensor, a capture or a result; `words` renders them."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["note", "warning", "error"]
Figure = float | int | bool | str | None | tuple["Figure", ...]
_ORDER: tuple[Severity, ...] = ("note", "warning", "error")


@dataclass(frozen=True)
class Finding:
    """One fact with its figures.

    Attributes:
        code: what was found, "family.name"; stable, listed in docs/findings.md.
        severity: "note" changes nothing; "warning": usable, less well; "error": must not be used.
        subject: a sensor's or capture's name, a profile key or a file; "" if clear.
        figures: by name with units ("rms_m"), for the words and for programs.
        action: which of several actions applies, by its code in `words`; "" if the code has one only.
    """

    code: str
    severity: Severity = "error"
    subject: str = ""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    action: str = ""

    @property
    def family(self) -> str:
        """The part of the code before the point: what kind of thing was found."""
        return self.code.partition(".")[0]

    def figure(self, name: str) -> float:
        """Return a figure as a number.

        Raises:
            KeyError: the finding has no such figure.
            TypeError: it is not a number.
        """
        value = self.figures[name]
        if not isinstance(value, float | int):
            raise TypeError(f"{self.code}: {name} is {value!r}")
        return float(value)


def worst(findings: Iterable[Finding]) -> Severity:
    """Return the highest severity; "note" where nothing was found."""
    return max((finding.severity for finding in findings), key=_ORDER.index, default="note")


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """List findings, the worst first, otherwise in the order given."""
    return tuple(sorted(findings, key=lambda finding: -_ORDER.index(finding.severity)))
