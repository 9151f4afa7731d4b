"""Report of a target."""

from dataclasses import dataclass, field


@dataclass
class Report:
    """Counts of a run.

    Attributes:
        n: kills or interrupts.
        wrong: faults, a line each.
        seconds: duration of the run.
    """

    n: int = 0
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def n_wrong(self) -> int:
        """Number of faults."""
        return len(self.wrong)
