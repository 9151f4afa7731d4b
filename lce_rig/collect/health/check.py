"""One line of the doctor's: what was looked at, how it is, and what to do about it."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

Severity = Literal["green", "yellow", "red"]
_ORDER: tuple[Severity, ...] = ("green", "yellow", "red")


@dataclass(frozen=True)
class Check:
    """One thing looked at.

    Attributes:
        group: "computer", a sensor's name in the profile, or "rig" for what concerns several.
        name: what was looked at, in a word.
        severity: green, yellow (collecting works, less well) or red (it does not, or its data are wrong).
        figure: what was seen, in words and figures.
        remedy: what to do, a line for each thing; "" where nothing is to be done.
        values: figures for machines, by name with units.
    """

    group: str
    name: str
    severity: Severity
    figure: str
    remedy: str = ""
    values: Mapping[str, float] = field(default_factory=dict)


def worst(severities: Iterable[Severity]) -> Severity:
    """Give the most severe; green where there is none."""
    return max(severities, key=_ORDER.index, default="green")
