"""Findings against a result, and the verdict that they amount to."""

from collections.abc import Iterable, Mapping
from typing import Literal

from lce_rig.core.findings import Figure, Finding, Severity, worst

Verdict = Literal["pass", "marginal", "fail"]
SURPRISING_CHI2 = 16.81
"""99 % of the chi-squared distribution of six freedoms: differences beyond it are no chance."""
_VERDICTS: Mapping[Severity, Verdict] = {"note": "pass", "warning": "marginal", "error": "fail"}


def doubt(
    code: str, figures: Mapping[str, Figure], *, is_fail: bool, subject: str = "", action: str = ""
) -> Finding:
    """Make a finding that allows no pass: an error where the result fails by it, else a warning."""
    return Finding(code, "error" if is_fail else "warning", subject, figures, action)


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that findings amount to."""
    return _VERDICTS[worst(findings)]
