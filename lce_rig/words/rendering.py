"""Templates and functions that turn a finding's figures into words."""

import math
import re
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

FAMILIES = (
    *("detection", "drivers", "doctor", "exports", "extrinsics", "guidance", "recordings", "scene_drift"),
    *("fleet", "deployment"),
)
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


_LIMITS = ("limit_", "max_", "min_", "target_", "tolerance_")
_MOST_DIGITS = 4


def _format(value: Any, spec: str, more: int = 0) -> str:
    """Format a figure; {rms_m:mm}, {tilt_deg:1deg}, {share:percent} scale and add the unit.

    Args:
        value: the figure; those of a tuple are listed.
        spec: as in a template.
        more: digits beyond those of the spec.
    """
    if value is None:
        return "unknown"
    if isinstance(value, tuple):
        return ", ".join(_format(each, spec, more) for each in value)
    unit = next((unit for unit in _UNITS if spec.endswith(unit)), None)
    if unit is None:
        fixed = re.fullmatch(r"\.(\d)f", spec)
        return str(format(value, f".{int(fixed[1]) + more}f" if fixed else spec))
    factor, decimals, printed = _UNITS[unit]
    digits = spec.removesuffix(unit)
    number = factor * float(value)
    places = (int(digits) if digits else decimals) + more
    return (f"{number:.{places}f}" if math.isfinite(number) else "unknown") + printed


def _fill(template: str, figures: Mapping[str, Any]) -> str:
    """Fill in figures; one that differs from its limit is printed with as many digits as show it."""
    fields = [(text, name, spec or "") for text, name, spec, _ in string.Formatter().parse(template)]
    specs = {name: spec for _, name, spec in fields if name is not None}
    more = dict.fromkeys(specs, 0)
    for limit in filter(lambda name: name.startswith(_LIMITS), specs):
        unit = limit.rpartition("_")[2]
        for name in specs:
            if name.startswith(_LIMITS) or name.rpartition("_")[2] != unit:
                continue
            if isinstance(figures[name], float) and isinstance(figures[limit], float | int):
                more[name] = more[limit] = _more_digits(
                    (figures[name], specs[name]), (figures[limit], specs[limit])
                )
    return "".join(
        text + ("" if name is None else _format(figures[name], spec, more[name]))
        for text, name, spec in fields
    )


def _more_digits(figure: tuple[float, str], limit: tuple[float, str]) -> int:
    """Count the digits that two figures with their specs lack to print differently; 0 if they are equal."""
    for more in range(_MOST_DIGITS if figure[0] != limit[0] else 0):
        first, second = (_format(*each, more).split()[0] for each in (figure, limit))
        if "unknown" in (first, second) or float(first) != float(second):
            return more
    return 0


def figures_apart(value: float, limit: float) -> tuple[str, str]:
    """Print a figure and its limit with two significant digits, or as many as show that they differ."""
    for digits in range(2, 2 + _MOST_DIGITS):
        texts = [f"{x:.{digits}g}" if abs(x) < 10**digits else f"{x:.0f}" for x in (value, limit)]
        if texts[0] != texts[1]:
            break
    return texts[0], texts[1]


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
    return _fill(template, {"subject": finding.subject, **finding.figures})
