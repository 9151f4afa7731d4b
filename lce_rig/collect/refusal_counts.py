"""Why moments became no captures: counted by code, with one example's figures."""

from collections import Counter
from dataclasses import dataclass, field

from lce_rig.core.results import Refusal


@dataclass
class RefusalCounts:
    """Refusals counted by code and advice; those that differ in their figures only are one."""

    _counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    _examples: dict[tuple[str, str], Refusal] = field(default_factory=dict)

    def add(self, refusal: Refusal, n: int = 1) -> None:
        """Count more of a kind; the figures kept are those of its first."""
        kind = refusal.code, refusal.action
        self._counts[kind] += n
        self._examples.setdefault(kind, refusal)

    def update(self, other: "RefusalCounts") -> None:
        """Count what another tally has counted as well."""
        for refusal, n in other.counts():
            self.add(refusal, n)

    def counts(self) -> list[tuple[Refusal, int]]:
        """List the first refusal of each kind with how many there were, most frequent first."""
        return [(self._examples[kind], n) for kind, n in self._counts.most_common() if n]

    def by_code(self) -> dict[str, int]:
        """Count by code."""
        counts: Counter[str] = Counter()
        for (code, _), n in self._counts.items():
            counts[code] += n
        return dict(sorted(counts.items()))
