"""What the targets that start programs of their own report in the same words."""

from dataclasses import dataclass, field


@dataclass
class Report:
    """What became of a run.

    Attributes:
        n: inputs: kills, interrupts or connections.
        wrong: what should not have happened.
        grown_bytes: by how much the process that was tried grew; 0 where each input has one of its own.
        seconds: how long all of it took.
    """

    n: int = 0
    wrong: list[str] = field(default_factory=list)
    grown_bytes: int = 0
    seconds: float = 0.0

    @property
    def n_wrong(self) -> int:
        """How much is wrong."""
        return len(self.wrong)
