"""Tables of phrases by code, until each room declares its own kinds of findings."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from lce_rig.core.errors import NotEnoughDataError
from lce_rig.core.findings import KINDS, Finding, Kind, Refusal, Template
from lce_rig.core.phrasing import as_line, figures_apart

__all__ = ["Phrase", "Template", "as_line", "figures_apart"]

FAMILIES = tuple(
    path.stem
    for path in sorted(Path(__file__).parent.glob("*.py"))
    if path.stem not in ("__init__", "rendering")
)
"""Modules of this package with a table PHRASES of their own."""


@dataclass(frozen=True)
class Phrase:
    """How one code reads; see `Kind`."""

    text: Template
    action: Template = ""
    actions: Mapping[str, Template] | None = None


def phrases() -> Mapping[str, Kind]:
    """Declare the tables of all families that are left."""
    for family in FAMILIES:
        for code, phrase in import_module(f"lce_rig.words.{family}").PHRASES.items():
            if code not in KINDS:
                Kind(code, phrase.text, phrase.action, actions=phrase.actions)
    return KINDS


def describe(finding: Finding) -> str:
    """Say what was found, without what to do."""
    phrases()
    return finding.text


def recommend(finding: Finding) -> str:
    """Say what to do; "" if nothing is to be done."""
    phrases()
    return finding.advice


def sentence(finding: Finding) -> str:
    """Say what was found and what to do, in one line."""
    phrases()
    return finding.sentence


def enumerated(finding: Finding, reasons: Iterable[Finding]) -> str:
    """Say what was found and the reasons, in one line."""
    return f"{describe(finding)}: {'; '.join(sentence(reason) for reason in reasons)}"


def not_enough(finding: Finding) -> NotEnoughDataError:
    """Make the error that says what data are lacking, of what."""
    phrases()
    return NotEnoughDataError.of(finding)


def as_json(finding: Finding) -> dict[str, object]:
    """Write a finding for programs; all but the texts is stable."""
    phrases()
    return finding.as_json()


def refusal_as_json(refusal: Refusal) -> dict[str, object]:
    """Write a refusal for programs."""
    phrases()
    return refusal.as_json()


def is_renderable(finding: Finding) -> bool:
    """Return whether a finding read from a file has a known code and action and all figures of its phrase."""
    try:
        sentence(finding)
    except (KeyError, TypeError, ValueError, AttributeError):
        return False
    return True
