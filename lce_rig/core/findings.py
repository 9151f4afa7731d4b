"""Facts about a sensor, a capture or a result, and their texts.

A kind of finding is declared once, as a `Kind` in `findings.py` of the package that reports it:

    TOO_DARK = Kind("image.too_dark", "too dark: grey {grey_99:.0f}", "expose longer")

and called with its figures: `TOO_DARK("camera", grey_99=12.0)` is a `Finding`,
`TOO_DARK.refusal(grey_99=12.0)` a `Refusal`.
"""

import math
import shlex
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, cast

from typing_extensions import TypeAliasType

from lce_rig.core.phrasing import fill

Severity = Literal["note", "warning", "error"]
Figure = TypeAliasType("Figure", "float | int | bool | str | tuple[Figure, ...] | None")
Stage = Literal["read", "image", "lidar", "pair", "calibrate"]
STAGES: tuple[Stage, ...] = ("read", "image", "lidar", "pair", "calibrate")
Template = str | Callable[["Finding"], str]
_ORDER: tuple[Severity, ...] = ("note", "warning", "error")

KINDS: dict[str, "Kind"] = {}
"""Every declared kind by its code, as far as its module is imported."""


class Kind:
    """A kind of finding.

    Args:
        code: "family.name"; stable, listed in docs/findings.md.
        text: the fact, without an action: a template over subject and figures ({rms_m:mm}, {share:percent}),
            or a function of the finding, whose docstring is then the template shown in the docs. {session} is
            the session's path, if known, in commands.
        action: the action, in the imperative; "" for none.
        severity: the usual one.
        actions: alternative actions, by the name that `Finding.action` gives.
    """

    def __init__(
        self,
        code: str,
        text: Template,
        action: Template = "",
        *,
        severity: Severity = "error",
        actions: Mapping[str, Template] | None = None,
    ) -> None:
        if code in KINDS:
            raise ValueError(f"{code} is declared twice")
        self.code, self.text, self.action, self.severity = code, text, action, severity
        self.actions: Mapping[str, Template] = actions or {}
        KINDS[code] = self

    def __call__(
        self, subject: str = "", /, *, severity: Any = None, action: Any = "", **figures: Figure
    ) -> "Finding":
        """Make a finding of this kind; severity and action are typed loosely to allow `**figures`."""
        return Finding(self.code, severity or self.severity, subject, figures, action)

    def refusal(
        self, subject: str = "", /, *, severity: Any = None, action: Any = "", **figures: Figure
    ) -> "Refusal":
        """Make a refusal of this kind; the code begins with the stage."""
        return Refusal(self.code, severity or self.severity, subject, figures, action)


note_kind, warning_kind = partial(Kind, severity="note"), partial(Kind, severity="warning")


@dataclass(frozen=True)
class Finding:
    """One fact with its figures.

    Attributes:
        code: code of its kind, "family.name".
        severity: "note" changes nothing; "warning": usable, less well; "error": must not be used.
        subject: a sensor's or capture's name, a profile key or a file; "" if clear.
        figures: values by name with unit ("rms_m"), for the text and for programs.
        action: the name of an alternative action of the kind; "" for the usual one.
        follows: the code of the finding that this one follows from; "" for a cause.
        stored: text and action read from a file; None to render the kind's.
    """

    code: str
    severity: Severity = "error"
    subject: str = ""
    figures: Mapping[str, Figure] = field(default_factory=dict)
    action: str = ""
    follows: str = ""
    stored: tuple[str, str] | None = field(default=None, compare=False)

    @property
    def family(self) -> str:
        """Part of the code before the dot."""
        return self.code.partition(".")[0]

    def figure(self, name: str) -> float:
        """Return a figure as a number.

        Raises:
            KeyError: the finding has no such figure.
            TypeError: the figure is not a number.
        """
        value = self.figures[name]
        if not isinstance(value, float | int):
            raise TypeError(f"{self.code}: {name} is {value!r}")
        return float(value)

    @property
    def text(self) -> str:
        """The fact as text, without an action."""
        return self.stored[0] if self.stored else self._render(KINDS[self.code].text)

    @property
    def advice(self) -> str:
        """The action as text; "" if there is none."""
        if self.stored:
            return self.stored[1]
        kind = KINDS[self.code]
        return self._render(kind.actions[self.action] if self.action else kind.action)

    def advice_at(self, *sessions: str) -> str:
        """Return the action as text, with the paths of the sessions in its commands."""
        placed = replace(self, figures={**self.figures, "session": shlex.join(sessions)}, stored=None)
        try:
            return placed.advice
        except (KeyError, TypeError, ValueError, AssertionError):
            return self.advice  # from a file of another version, with other figures

    @property
    def sentence(self) -> str:
        """Fact and action in one line."""
        advice = self.advice
        return f"{self.text}: {advice}" if advice else self.text

    def as_json(self) -> dict[str, object]:
        """Return the finding as JSON; all fields but the texts are stable."""
        return {
            "code": self.code,
            "severity": self.severity,
            "subject": self.subject,
            "figures": {name: _finite(figure) for name, figure in self.figures.items()},
            "action_code": self.action,
            "follows": self.follows,
            "text": self.text,
            "action": self.advice,
        }

    def _render(self, template: Template) -> str:
        if callable(template):
            return template(self)
        return fill(template, {"subject": self.subject, "session": "SESSION", **self.figures})


@dataclass(frozen=True)
class Refusal(Finding):
    """The reason for refusing a capture; its code begins with the stage, such as "lidar.too_few_rings".

    Stages are "read", "image", "lidar", "pair" (the two sensors disagree) and "calibrate" (an outlier).
    """

    def __post_init__(self) -> None:
        if self.family not in STAGES:
            raise ValueError(f"{self.code} names no stage")

    @property
    def stage(self) -> Stage:
        """The stage that refuses the capture."""
        return cast(Stage, self.family)

    def as_json(self) -> dict[str, object]:
        """Return the refusal as JSON; stage, code, figures and the action's code are stable."""
        record = super().as_json()
        kept = {name: record[name] for name in ("code", "figures", "action_code")}
        return {"stage": self.stage, **kept, "cause": record["text"], "action": record["action"]}


def worst(findings: Iterable[Finding]) -> Severity:
    """Return the highest severity; "note" if there are no findings."""
    return max((finding.severity for finding in findings), key=_ORDER.index, default="note")


def ranked(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by severity, the worst first; equal ones keep their order."""
    return tuple(sorted(findings, key=lambda finding: -_ORDER.index(finding.severity)))


def _finite(figure: Figure) -> Figure:
    """Return None for a number that JSON cannot represent."""
    if isinstance(figure, tuple):
        return tuple(_finite(each) for each in figure)
    return None if isinstance(figure, float) and not math.isfinite(figure) else figure


@dataclass
class Losses:
    """Findings counted by code, subject and action; their figures do not matter."""

    _counts: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    _examples: dict[tuple[str, str, str], Finding] = field(default_factory=dict)

    def add(self, finding: Finding, n: int = 1, *, is_best: bool = False) -> None:
        """Add to the count of a finding's kind.

        Args:
            finding: an example of the kind.
            n: number to add.
            is_best: keep this one's figures as the example, instead of those of the first.
        """
        if n <= 0:
            return
        kind = finding.code, finding.subject, finding.action
        self._counts[kind] += n
        if is_best or kind not in self._examples:
            self._examples[kind] = finding

    def update(self, other: "Losses") -> None:
        """Add the counts of another."""
        for finding, n in other.counts():
            self.add(finding, n)

    def keep_more(self, other: "Losses") -> None:
        """Adopt larger counts from a more complete pass over the same data."""
        for kind, n in other._counts.items():
            if n >= self._counts[kind]:
                self._counts[kind], self._examples[kind] = n, other._examples[kind]

    def counts(self) -> list[tuple[Finding, int]]:
        """List an example of each kind with its count, most frequent first."""
        return [(self._examples[kind], n) for kind, n in self._counts.most_common()]

    def by_code(self) -> dict[str, int]:
        """Count by code."""
        counts: Counter[str] = Counter()
        for (code, _, _), n in self._counts.items():
            counts[code] += n
        return dict(sorted(counts.items()))

    def n(self, *codes: str) -> int:
        """Count the losses with one of these codes."""
        return sum(n for (code, _, _), n in self._counts.items() if code in codes)

    def findings(self) -> list[Finding]:
        """List each kind as one finding with its number as figure n, in order of the codes."""
        found: list[Finding] = []
        for kind, n in sorted(self._counts.items()):
            figures: dict[str, Figure] = {"n": n, **self._examples[kind].figures}
            found.append(replace(self._examples[kind], figures=figures))
        return found
