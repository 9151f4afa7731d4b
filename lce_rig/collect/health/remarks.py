"""What drivers complain of, sorted to the line of the screen that it belongs to."""

from collections.abc import Iterable, Mapping
from typing import Literal

from lce_rig.core.findings import Finding, about
from lce_rig.sources.live.base import SourceStatus
from lce_rig.words import as_line, sentence

Topic = Literal["device", "stream", "clock", "buffer"]

# By the family of a problem's code.
_TOPICS: Mapping[str, Topic] = {
    "device": "device",
    "stream": "stream",
    "packet": "stream",
    "clock": "clock",
    "buffer": "buffer",
}


def remarks(status: SourceStatus, topic: Topic) -> tuple[Finding, ...]:
    """Give a driver's complaints of one topic."""
    found = [problem for problem in status.problems if _TOPICS[problem.family] == topic]
    return about(status.sensor, found)


def as_remedy(problems: Iterable[Finding]) -> str:
    """Write complaints as sentences, a line each."""
    return "\n".join(as_line(sentence(problem)) for problem in problems)
