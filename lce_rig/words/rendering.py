"""Templates and functions that turn a finding's figures into words."""

import math
import string
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import Figure, Finding

if TYPE_CHECKING:
    from lce_rig.core.results import Refusal

FAMILIES: tuple[str, ...] = ("detection", "drivers", "doctor", "extrinsics", "scene")
"""Modules of this package with a table PHRASES of their own."""

Template = str | Callable[[Finding], str]

# Suffix of a format spec -> (factor, decimals where none are given, unit as printed).
_UNITS: Mapping[str, tuple[float, int, str]] = {
    "mm": (1000.0, 0, " mm"),
    "cm": (100.0, 0, " cm"),
    "ms": (1000.0, 1, " ms"),
    "us": (1e6, 0, " us"),
    "deg": (1.0, 2, " deg"),
    "percent": (100.0, 0, " %"),
}


@dataclass(frozen=True)
class Phrase:
    """How one code reads.

    Attributes:
        text: what was found, with figures; no action.
        action: what to do, in the imperative; "" if nothing is to be done.
        actions: other actions by the name that `Finding.action` gives.
    """

    text: Template
    action: Template = ""
    actions: Mapping[str, Template] | None = None


class _Figures(string.Formatter):
    """Format figures; {rms_m:mm}, {tilt_deg:1deg}, {share:percent} scale and add the unit."""

    def format_field(self, value: Any, spec: str) -> str:
        if value is None:
            return "unknown"
        unit = next((unit for unit in _UNITS if spec.endswith(unit)), None)
        if unit is None:
            return str(format(value, spec))
        factor, decimals, printed = _UNITS[unit]
        digits = spec.removesuffix(unit)
        number = factor * float(value)
        shown = f"{number:.{int(digits) if digits else decimals}f}" if math.isfinite(number) else "unknown"
        return shown + printed


_FORMATTER = _Figures()


@cache
def phrases() -> Mapping[str, Phrase]:
    """Merge the tables of all families: code -> phrase."""
    table: dict[str, Phrase] = {}
    for family in FAMILIES:
        table |= import_module(f"lce_rig.words.{family}").PHRASES
    return table


def describe(finding: Finding) -> str:
    """Say what was found, without what to do."""
    return _render(phrases()[finding.code].text, finding)


def recommend(finding: Finding) -> str:
    """Say what to do; "" if nothing is to be done."""
    phrase = phrases()[finding.code]
    chosen = (phrase.actions or {})[finding.action] if finding.action else phrase.action
    return _render(chosen, finding)


def sentence(finding: Finding) -> str:
    """Say what was found and what to do, in one line."""
    action = recommend(finding)
    return f"{describe(finding)}: {action}" if action else describe(finding)


def as_line(text: str) -> str:
    """Write words as a sentence, with a capital and a full stop."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def enumerated(finding: Finding, reasons: Iterable[Finding]) -> str:
    """Say what was found and the reasons, in one line."""
    return f"{describe(finding)}: {'; '.join(sentence(reason) for reason in reasons)}"


def not_enough(finding: Finding) -> NotEnoughDataError:
    """Make the error that says what data are lacking, of what."""
    whose = f"{finding.subject}: " if finding.subject else ""
    action = recommend(finding)
    # Several causes, a line each, are no sentence.
    return NotEnoughDataError(
        whose + describe(finding), action if "\n" in action else as_line(action), finding
    )


def as_json(finding: Finding) -> dict[str, object]:
    """Write a finding for programs; all but the texts is stable."""
    return {
        "code": finding.code,
        "severity": finding.severity,
        "subject": finding.subject,
        "figures": {name: _finite(figure) for name, figure in finding.figures.items()},
        "action_code": finding.action,
        "text": describe(finding),
        "action": recommend(finding),
    }


def refusal_as_json(refusal: "Refusal") -> dict[str, object]:
    """Write a refusal for programs; stage, code, figures and the action's code are stable."""
    record = as_json(refusal)
    return {
        "stage": refusal.stage,
        "code": refusal.code,
        "figures": record["figures"],
        "action_code": refusal.action,
        "cause": record["text"],
        "action": record["action"],
    }


def is_renderable(finding: Finding) -> bool:
    """Return whether a finding read from a file has a known code and action and all figures of its phrase."""
    try:
        sentence(finding)
    except (KeyError, TypeError, ValueError, AttributeError):
        return False
    return True


def _finite(figure: Figure) -> Figure:
    """Return None for a number that JSON cannot represent."""
    if isinstance(figure, tuple):
        return tuple(_finite(each) for each in figure)
    return None if isinstance(figure, float) and not math.isfinite(figure) else figure


def _render(template: Template, finding: Finding) -> str:
    if callable(template):
        return template(finding)
    return _FORMATTER.vformat(template, (), {"subject": finding.subject, **finding.figures})
