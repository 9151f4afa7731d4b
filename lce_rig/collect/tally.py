"""Why moments became no captures: counted by cause, with one example's figures and what to do."""

import re
from collections import Counter
from dataclasses import dataclass, field

from lce_rig.core.results import Refusal


@dataclass
class Tally:
    """Refusals counted by cause; causes that differ in their figures only are one."""

    _counts: Counter[str] = field(default_factory=Counter)
    _examples: dict[str, Refusal] = field(default_factory=dict)

    def add(self, refusal: Refusal) -> None:
        """Count one more; the figures shown are those of the first of its kind."""
        kind = re.sub(r"[\d.]+", "#", f"{refusal.cause.split(':')[0]}: {refusal.action}")
        self._counts[kind] += 1
        self._examples.setdefault(kind, refusal)

    def counts(self) -> Counter[str]:
        """Count by "cause: what to do"."""
        said = {kind: f"{refusal.cause}: {refusal.action}" for kind, refusal in self._examples.items()}
        return Counter({said[kind]: n for kind, n in self._counts.items()})
