"""What drivers complain of, sorted to the line of the screen that it belongs to."""

from typing import Literal

from lce_rig.sources.live.base import SourceStatus

Topic = Literal["device", "stream", "clock", "buffer"]

# The first that fits decides; whatever fits nowhere is the device's.
_WORDS: tuple[tuple[Topic, tuple[str, ...]], ...] = (
    ("buffer", ("the receive buffer holds",)),
    (
        "stream",
        (
            "lost",
            "dropped",
            "never came",
            "damaged",
            "left out",
            "too slow",
            "pictures a second",
            "the rotor turns",
            "buffers",
            "no pulses for",
        ),
    ),
    (
        "clock",
        ("clock", "stamp", "pulse per second", "pulses per second", "UTC", "time requests", "the receiver"),
    ),
)


def remarks(status: SourceStatus, topic: Topic) -> list[str]:
    """Give a driver's complaints of one topic, each a sentence with what to do."""
    return [problem for problem in status.problems if _topic(problem) == topic]


def as_remedy(problems: list[str]) -> str:
    """Write complaints as sentences, a line each."""
    return "\n".join(f"{problem[0].upper()}{problem[1:].rstrip('.')}{_end(problem)}" for problem in problems)


def _end(problem: str) -> str:
    return "" if problem.endswith("?") else "."


def _topic(problem: str) -> Topic:
    return next(
        (topic for topic, words in _WORDS if any(word in problem for word in words)),
        "device",
    )
