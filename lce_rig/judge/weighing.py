"""Findings against a result, and the resulting verdict."""

from collections.abc import Iterable, Mapping
from typing import Literal

from lce_rig.core.findings import Figure, Finding, Severity, worst

Verdict = Literal["pass", "marginal", "fail"]
SURPRISING_CHI2 = 16.81
"""99 % of the chi-squared distribution with six degrees of freedom: differences beyond it are significant."""
_VERDICTS: Mapping[Severity, Verdict] = {"note": "pass", "warning": "marginal", "error": "fail"}


def reason(
    code: str, figures: Mapping[str, Figure], *, is_fail: bool, subject: str = "", action: str = ""
) -> Finding:
    """Return a finding that prevents a pass: an error if the result fails by it, else a warning."""
    return Finding(code, "error" if is_fail else "warning", subject, figures, action)


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that results from findings."""
    return _VERDICTS[worst(findings)]
