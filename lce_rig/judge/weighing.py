"""Findings against a result, and the resulting verdict."""

from collections.abc import Iterable, Mapping
from typing import Literal

from lce_rig.core.findings import Finding, Severity, worst

Verdict = Literal["pass", "marginal", "fail"]
SURPRISING_CHI2 = 16.81
"""99 % of the chi-squared distribution with six degrees of freedom: differences beyond it are significant."""
_VERDICTS: Mapping[Severity, Verdict] = {"note": "pass", "warning": "marginal", "error": "fail"}


def verdict_of(findings: Iterable[Finding]) -> Verdict:
    """Return the verdict that results from findings."""
    return _VERDICTS[worst(findings)]
