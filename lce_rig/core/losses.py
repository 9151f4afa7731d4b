"""What was refused, dropped or repaired on the way from a sensor or a file to a capture."""

from collections import Counter
from dataclasses import dataclass, field, replace

from lce_rig.core.findings import Figure, Finding


@dataclass
class Losses:
    """Findings counted by code, subject and action; those that differ in their figures only are one kind."""

    _counts: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    _examples: dict[tuple[str, str, str], Finding] = field(default_factory=dict)

    def add(self, finding: Finding, n: int = 1, *, is_best: bool = False) -> None:
        """Count more of a kind.

        Args:
            finding: one of them.
            n: how many.
            is_best: keep this one's figures as the example, instead of those of the first.
        """
        if n <= 0:
            return
        kind = finding.code, finding.subject, finding.action
        self._counts[kind] += n
        if is_best or kind not in self._examples:
            self._examples[kind] = finding

    def update(self, other: "Losses") -> None:
        """Add what was counted elsewhere."""
        for finding, n in other.counts():
            self.add(finding, n)

    def keep_more(self, other: "Losses") -> None:
        """Take over the larger numbers of what a more complete pass over the same data found."""
        for kind, n in other._counts.items():
            if n >= self._counts[kind]:
                self._counts[kind], self._examples[kind] = n, other._examples[kind]

    def counts(self) -> list[tuple[Finding, int]]:
        """List an example of each kind with how many there were, most frequent first."""
        return [(self._examples[kind], n) for kind, n in self._counts.most_common()]

    def by_code(self) -> dict[str, int]:
        """Count by code."""
        counts: Counter[str] = Counter()
        for (code, _, _), n in self._counts.items():
            counts[code] += n
        return dict(sorted(counts.items()))

    def n(self, *codes: str) -> int:
        """Count what has one of these codes."""
        return sum(n for (code, _, _), n in self._counts.items() if code in codes)

    def findings(self) -> list[Finding]:
        """List each kind as one finding with its number as figure n, in order of the codes."""
        found: list[Finding] = []
        for kind, n in sorted(self._counts.items()):
            figures: dict[str, Figure] = {"n": n, **self._examples[kind].figures}
            found.append(replace(self._examples[kind], figures=figures))
        return found
