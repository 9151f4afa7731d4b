"""One reason against a result, and how bad it is."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Verdict = Literal["pass", "marginal", "fail"]
SURPRISING_CHI2 = 16.81
"""99 % of the chi-squared distribution of six freedoms: differences beyond it are no chance."""
_ORDER: tuple[Verdict, ...] = ("pass", "marginal", "fail")


@dataclass(frozen=True)
class Doubt:
    """One reason, with its figure and what to do; a "pass" is a remark and does not count."""

    verdict: Verdict
    text: str


def weigh(doubts: Iterable[Doubt]) -> tuple[Verdict, tuple[str, ...]]:
    """Take the worst of all doubts, and list them worst first, otherwise in the order given."""
    ordered = sorted(doubts, key=lambda doubt: -_ORDER.index(doubt.verdict))
    return ordered[0].verdict if ordered else "pass", tuple(doubt.text for doubt in ordered)
